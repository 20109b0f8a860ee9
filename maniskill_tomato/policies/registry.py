"""Policies by name, and where each is made. Nothing heavy is imported before one is made."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal

from maniskill_tomato.errors import PolicyError
from maniskill_tomato.extension_points import ExtensionPoint

if TYPE_CHECKING:
    import torch

    from maniskill_tomato.policies.protocol import GroundTruth, Policy

Need = Literal["seed", "device", "ground_truth", "contact_free"]


@dataclass(frozen=True, kw_only=True)
class PolicyContext:
    """What a policy may need to be made."""

    seed: int = 0
    """Of its random numbers."""
    device: "str | torch.device" = "cpu"
    """Where the beliefs' tensors are."""
    ground_truth: "GroundTruth | None" = None
    """The simulator's knowledge; None where there is no simulator."""
    contact_free: bool = False
    """Whether the oracle touches no plant."""


@dataclass(frozen=True)
class PolicyEntry:
    """A policy of this package that no file is needed for."""

    made_by: str
    """Module of this folder, and a callable in it."""
    needs: tuple[Need, ...] = ()
    """What it is called with."""


_PLANNERS: Mapping[str, PolicyEntry] = {
    "stay": PolicyEntry("baselines:Stay"),
    "random_step": PolicyEntry("baselines:RandomStep", ("seed",)),
    "random_viewpoint": PolicyEntry("baselines:RandomViewpoint", ("seed",)),
    "fixed_sweep": PolicyEntry("baselines:FixedSweep"),
    "look_at": PolicyEntry("baselines:LookAtServoing"),
    "3dmts_memory": PolicyEntry("move_to_see:MoveToSeeOnMemory", ("device",)),
    "gradient_nbv": PolicyEntry("gradient_view:GradientView", ("device",)),
    "nbv_direction": PolicyEntry("next_best_view:NextBestDirection"),
    "nbv": PolicyEntry("next_best_view:NextBestView"),
    "3dmts": PolicyEntry("move_to_see:MoveToSee", ("ground_truth", "device")),
    "greedy_truth": PolicyEntry("greedy_truth:GreedyTruth", ("ground_truth", "device")),
    "lattice_oracle": PolicyEntry("lattice_oracle:LatticeOracle", ("ground_truth",)),
    "oracle": PolicyEntry("oracle:Oracle.of", ("ground_truth", "device", "contact_free")),
}

SHIPPED_FILES: Final[Mapping[str, str]] = {
    "deep_3dmts": "policies/deep_3dmts.pt",
    "view_quality": "policies/TomatoViewpoint-v1.pt",
}
"""Policies whose networks ship with the package, and their files in `assets`."""

PRIVILEGED: Final = tuple(name for name, planner in _PLANNERS.items() if "ground_truth" in planner.needs)
"""Those that know the truth."""

PLANNERS: Final = (*(n for n in _PLANNERS if n not in PRIVILEGED), *SHIPPED_FILES, *PRIVILEGED)
"""All names of this package."""


POLICIES: Final = ExtensionPoint(
    "policy",
    "maniskill_tomato.policies",
    {
        name: f"maniskill_tomato.policies.{_PLANNERS[name].made_by}"
        if name in _PLANNERS
        else SHIPPED_FILES[name]
        for name in PLANNERS
    },
)
"""What another package adds is called with a `PolicyContext` and returns a `Policy`, or a `StatePolicy`."""


def policy_names() -> tuple[str, ...]:
    """All names, those of this package first."""
    return POLICIES.names()


def make_planner(name: str, context: PolicyContext) -> "Policy":
    """The policy of a name that is not among `SHIPPED_FILES`.

    Raises:
        InvalidInputError: There is none, or it cannot be imported.
        PolicyError: Another package's is no policy.
    """
    made_by = POLICIES.load(name)
    if name in _PLANNERS:
        policy: Policy = made_by(**{need: getattr(context, need) for need in _PLANNERS[name].needs})
        return policy
    from maniskill_tomato.policies.adapters import as_policy

    made: Any = made_by(context)
    if not callable(getattr(made, "act", None)):
        raise PolicyError(
            f"{name} must make a policy, an object with a method act(belief) or act(observations); "
            f"it made a {type(made).__name__}"
        )
    return as_policy(made)
