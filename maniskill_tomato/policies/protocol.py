"""What a policy is, and what a policy that knows the truth may ask."""

from abc import ABC, abstractmethod
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor

from maniskill_tomato.sensing.belief import Belief


@runtime_checkable
class Policy(Protocol):
    """Decides where B environments look next; any object with these attributes is a policy."""

    name: str
    """In reports and on the command line."""
    needs_truth: bool
    """Whether it asks the simulator for what no camera could tell."""

    def begin(self, belief: Belief, rows: Tensor) -> None:
        """Forgets the last episode of some environments.

        Args:
            belief: Of all environments; those in `rows` are at the start view of an episode.
            rows: Which environments begin an episode. Shape (b,).
        """

    def act(self, belief: Belief) -> Tensor:
        """The next moves.

        Args:
            belief: What the robot knows now, in all environments.

        Returns:
            Moves of the `pd_look_at` control mode: right, up, forward in the look frame, as shares of the longest move.
            Shape (B, 3).
        """
        ...


class StatePolicy(Protocol):
    """Decides from state vectors; `adapters.ObservationPolicy` makes it a `Policy`."""

    def act(self, observations: Tensor) -> Tensor:
        """Actions of shape (B, A) for observations of shape (B, D), both as the task has them."""
        ...


class GroundTruth(Protocol):
    """The simulator's knowledge, for policies with `needs_truth` only."""

    @property
    def threshold(self) -> float:
        """V_f above which the task counts the target as fully visible."""
        ...

    def visible_fraction(
        self, T_world_camera: Tensor, env_index: int = 0, qpos: Tensor | None = None
    ) -> Tensor:
        """True V_f of the target of one environment from other viewpoints.

        Args:
            T_world_camera: Poses of the optical frame, translation in [m]. Shape (K, 4, 4).
            env_index: Which environment.
            qpos: Joint positions at each viewpoint, in [rad], if the arm shall hide what it hides; None for no arm.
                Shape (K, 7).

        Returns:
            Shape (K,).
        """
        ...

    def clearance(self, start_qpos: Tensor, end_qpos: Tensor, env_index: int = 0) -> Tensor:
        """How near the arm comes to the plants of one environment on K moves.

        Args:
            start_qpos: Joint positions, in [rad]. Shape (K, 7).
            end_qpos: Likewise. Shape (K, 7).
            env_index: Which environment.

        Returns:
            In [m], negative in contact. Shape (K,).
        """
        ...

    def can_follow(
        self, start: Tensor, way: Tensor, target: Tensor, env_index: int = 0, *, contact_free: bool = False
    ) -> bool:
        """Whether the arm, from where it stands, can make every move of a way and sees the target at its end.

        Args:
            start: Where the camera stands, in the world frame, in [m]. Shape (3,).
            way: Stops of the camera. Shape (n, 3).
            target: What it looks at. Shape (3,).
            env_index: Which environment.
            contact_free: Whether no move may touch the plants.
        """
        ...


class Planner(ABC):
    """A policy without a memory of its own and without the truth, unless a subclass says otherwise."""

    name: str
    """As `opening.open_policy` knows it."""
    needs_truth: bool = False

    def reseed(self, seed: int) -> None:  # noqa: B027
        """Begins its random numbers anew, so that an episode does not depend on the ones before it."""

    def begin(self, belief: Belief, rows: Tensor) -> None:  # noqa: B027
        """See `Policy.begin`."""

    @abstractmethod
    def act(self, belief: Belief) -> Tensor:
        """See `Policy.act`."""

    def describe(self) -> dict[str, Any]:
        """Its kind and where it comes from, for reports: numbers and strings."""
        return {"kind": self.name}


def reseed(policy: Policy | StatePolicy, seed: int) -> None:
    """Begins the random numbers of a policy anew, if it draws any and says so by a method `reseed`."""
    if (begin_anew := getattr(policy, "reseed", None)) is not None:
        begin_anew(seed)


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
