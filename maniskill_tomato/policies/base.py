"""What every planner offers, and what a planner that knows the truth may ask."""

from abc import ABC, abstractmethod
from typing import Protocol

import torch
from torch import Tensor

from maniskill_tomato.sensing.belief import Belief


class GroundTruth(Protocol):
    """The simulator's knowledge, for planners with `needs_truth` only."""

    def visible_fraction(self, T_world_camera: Tensor, env_index: int) -> Tensor:
        """True V_f of the target of one environment, seen from other poses.

        Args:
            T_world_camera: Poses of the optical frame. Shape (K, 4, 4).
            env_index: Which environment.

        Returns:
            Shape (K,).
        """
        ...


class Planner(ABC):
    """A `ViewpointPolicy` for environments that may start their episodes at different times."""

    name: str
    """As in `registry.PLANNERS`."""
    needs_truth: bool = False
    """Whether it knows what no camera could tell it."""

    def reseed(self, seed: int) -> None:  # noqa: B027
        """Begins its random numbers anew, so that an episode does not depend on the ones before it."""

    def begin(self, belief: Belief, env_idx: Tensor) -> None:  # noqa: B027
        """Forgets the last episode of some environments.

        Args:
            belief: All environments, those in `env_idx` at their start view.
            env_idx: Which environments begin an episode. Shape (b,).
        """

    @abstractmethod
    def act(self, belief: Belief) -> Tensor:
        """The next moves.

        Args:
            belief: What the robot knows now, in all environments.

        Returns:
            Moves (right, up, forward) in the look frame, as shares of the longest move. Shape (B, 3).
        """


class RandomPlanner(Planner):
    """A planner that draws random numbers."""

    def __init__(self, seed: int = 0) -> None:
        self._generator = torch.Generator().manual_seed(seed)

    def reseed(self, seed: int) -> None:
        self._generator.manual_seed(seed)

    def _normal(self, *shape: int) -> Tensor:
        return torch.randn(*shape, generator=self._generator)

    def _uniform(self, *shape: int) -> Tensor:
        return torch.rand(*shape, generator=self._generator)
