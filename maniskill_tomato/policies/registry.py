"""The planners by name."""

from collections.abc import Callable

import torch

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.policies.baselines import FixedSweep, LookAtServoing, RandomStep, RandomViewpoint, Stay
from maniskill_tomato.policies.deep_move_to_see import DeepMoveToSee
from maniskill_tomato.policies.gradient_view import GradientView
from maniskill_tomato.policies.greedy_truth import GreedyTruth
from maniskill_tomato.policies.lattice_oracle import LatticeOracle
from maniskill_tomato.policies.move_to_see import MoveToSee, MoveToSeeOnMemory
from maniskill_tomato.policies.next_best_view import NextBestDirection, NextBestView
from maniskill_tomato.policies.oracle import Oracle, OracleSearch
from maniskill_tomato.policies.planner_names import PLANNERS as PLANNERS
from maniskill_tomato.policies.planner_names import PRIVILEGED as PRIVILEGED
from maniskill_tomato.policies.protocol import GroundTruth, Planner
from maniskill_tomato.policies.view_quality import ViewQuality


class _Setting:
    """What a planner may need to be made."""

    def __init__(
        self,
        ground_truth: GroundTruth | None,
        contact_free: bool,
        seed: int,
        device: str | torch.device,
    ) -> None:
        self._truth = ground_truth
        self.contact_free = contact_free
        self.seed = seed
        self.device = device

    @property
    def truth(self) -> GroundTruth:
        if self._truth is None:
            raise InvalidInputError(
                "this planner knows the truth: give the ground_truth of the environment, env.unwrapped.ground_truth"
            )
        return self._truth


_MAKERS: dict[str, Callable[[_Setting], Planner]] = {
    Stay.name: lambda s: Stay(),
    RandomStep.name: lambda s: RandomStep(s.seed),
    RandomViewpoint.name: lambda s: RandomViewpoint(s.seed),
    FixedSweep.name: lambda s: FixedSweep(),
    LookAtServoing.name: lambda s: LookAtServoing(),
    MoveToSeeOnMemory.name: lambda s: MoveToSeeOnMemory(s.device),
    DeepMoveToSee.name: lambda s: DeepMoveToSee.shipped(s.device),
    GradientView.name: lambda s: GradientView(s.device),
    NextBestDirection.name: lambda s: NextBestDirection(s.device),
    NextBestView.name: lambda s: NextBestView(s.device),
    ViewQuality.name: lambda s: ViewQuality.shipped(s.device),
    MoveToSee.name: lambda s: MoveToSee(s.truth, s.device),
    GreedyTruth.name: lambda s: GreedyTruth(s.truth, s.device),
    LatticeOracle.name: lambda s: LatticeOracle(s.truth),
    Oracle.name: lambda s: Oracle(OracleSearch(s.truth, s.device, contact_free=s.contact_free)),
}


def make_planner(
    name: str,
    *,
    ground_truth: GroundTruth | None = None,
    contact_free: bool = False,
    seed: int = 0,
    device: str | torch.device = "cpu",
) -> Planner:
    """A planner with its default settings.

    Args:
        name: One of `PLANNERS`.
        ground_truth: The simulator's knowledge, for planners with `needs_truth`.
        contact_free: Whether the oracle touches no plant.
        seed: Of its random numbers.
        device: Where the environment's tensors are.

    Raises:
        InvalidInputError: The name is unknown, or the planner needs the truth and none is given.
    """
    if name not in _MAKERS:
        raise InvalidInputError.choice("the planner", name, PLANNERS)
    return _MAKERS[name](_Setting(ground_truth, contact_free, seed, device))
