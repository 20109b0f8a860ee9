"""The policies of a benchmark: planners by name, trained policies by file."""

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.experiments.viewpoint_policy import open_viewpoint_policy
from maniskill_tomato.policies.deep_move_to_see import DeepMoveToSee, load_move_network
from maniskill_tomato.policies.protocol import Planner
from maniskill_tomato.policies.registry import PLANNERS, make_planner


@dataclass(frozen=True, kw_only=True)
class PolicySpec:
    """One policy as the command line names it."""

    label: str
    """Its name in tables and files."""
    planner: str | None = None
    """One of `PLANNERS`; None for a trained policy."""
    path: Path | None = None
    """File of a trained policy, or of the planner's network."""

    @classmethod
    def parse(cls, text: str) -> "PolicySpec":
        """Reads `PLANNER`, `FILE`, `LABEL=FILE` or `deep_3dmts=FILE`.

        Raises:
            InvalidInputError: It is none of these.
        """
        label, _, file = text.rpartition("=")
        if not label:
            label = file
            if file in PLANNERS:
                return cls(label=label, planner=label)
        path = Path(file)
        if not path.is_file():
            raise InvalidInputError(
                f"{text!r} is no policy: give the name of a planner ({', '.join(PLANNERS)}), the file of a trained "
                "policy (.pt or .onnx), or LABEL=FILE"
            )
        planner = DeepMoveToSee.name if label == DeepMoveToSee.name else None
        if planner is None and label in PLANNERS:
            raise InvalidInputError(f"{label!r} is a planner's name; give the policy {file} another label")
        if label == file:
            label = path.parent.name if path.stem == "policy" and path.parent.name else path.stem
        return cls(label=label, planner=planner, path=path.resolve())

    def fingerprint(self) -> str:
        """Says whether stored episodes are of this policy: its planner, and the hash of its file."""
        content = b"" if self.path is None else self.path.read_bytes()
        return f"{self.planner or 'policy'}:{hashlib.sha256(content).hexdigest()[:16]}"

    def make(self, env: gym.Env[Any, Any], contact_free: bool = False) -> Planner:
        """The policy for an environment.

        Args:
            env: Where it acts.
            contact_free: Whether the oracle avoids the plant.

        Raises:
            CheckpointError: Its file cannot be used.
        """
        device = getattr(env.unwrapped, "device", "cpu")
        if self.planner is not None and self.path is not None:
            return DeepMoveToSee(load_move_network(self.path, device))
        if self.path is not None:
            spec: Any = env.unwrapped.spec
            return open_viewpoint_policy(self.path, None if spec is None else spec.id)
        assert self.planner is not None
        return make_planner(
            self.planner,
            ground_truth=getattr(env.unwrapped, "ground_truth", None),
            contact_free=contact_free,
            device=device,
        )


def parse_policies(text: str) -> list[PolicySpec]:
    """Reads a list with commas.

    Raises:
        InvalidInputError: It is empty, one of them cannot be used, or two have the same label.
    """
    specs = [PolicySpec.parse(part.strip()) for part in text.split(",") if part.strip()]
    if not specs:
        raise InvalidInputError(
            f"give one policy or more, with commas between them, such as {', '.join(PLANNERS)}"
        )
    labels = [spec.label for spec in specs]
    for label in labels:
        if labels.count(label) > 1:
            raise InvalidInputError(f"two policies are called {label!r}; name them as LABEL=FILE")
    return specs
