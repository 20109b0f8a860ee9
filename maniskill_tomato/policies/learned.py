"""A trained policy as a viewpoint policy."""

from typing import Protocol

from torch import Tensor

from maniskill_tomato.policies.protocol import Planner
from maniskill_tomato.sensing.belief import Belief


class ObservationPolicy(Protocol):
    """Anything that turns observations into actions."""

    def act(self, observations: Tensor) -> Tensor:
        """Moves of shape (B, 3) for observations of shape (B, D)."""
        ...


class LearnedPolicy(Planner):
    """Moves as a trained policy says, from the observation alone."""

    name = "learned"

    def __init__(self, policy: ObservationPolicy) -> None:
        self.policy = policy

    def act(self, belief: Belief) -> Tensor:
        """The policy's move."""
        return self.policy.act(belief.observation)
