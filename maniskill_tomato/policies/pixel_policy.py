"""A trained actor that sees images, as a policy of beliefs."""

from typing import Any, Protocol

import torch
from torch import Tensor

from maniskill_tomato.errors import PolicyError
from maniskill_tomato.policies.protocol import Planner
from maniskill_tomato.sensing.belief import Belief
from maniskill_tomato.sensing.image_layout import Sight
from maniskill_tomato.sensing.image_observation import STATE, FrameStack, Observation


class SeeingActor(Protocol):
    """Decides from state vectors and images."""

    @property
    def sight(self) -> Sight | None:
        """What it observes."""
        ...

    def act(self, observations: Observation) -> Tensor:
        """Actions of shape (B, A), in the task's units."""
        ...

    def describe(self) -> dict[str, Any]:
        """Where it comes from, for reports."""
        ...


class PixelPolicy(Planner):
    """Asks the belief for the images that its actor sees, and keeps the last ones if that sees several."""

    def __init__(self, actor: SeeingActor, sight: Sight, name: str = "learned") -> None:
        """Keeps the actor.

        Args:
            actor: Decides.
            sight: What it observes.
            name: In reports.
        """
        self.actor = actor
        self.sight = sight
        self.name = name
        self._frames = FrameStack(sight.frames)
        self._fresh: Tensor | None = None

    def begin(self, belief: Belief, rows: Tensor) -> None:
        """See `Policy.begin`."""
        if self._fresh is None:
            self._fresh = torch.zeros(
                len(belief.observation), dtype=torch.bool, device=belief.observation.device
            )
        self._fresh[rows] = True

    def act(self, belief: Belief) -> Tensor:
        """See `Policy.act`.

        Raises:
            PolicyError: The belief comes without images.
            InvalidInputError: The belief lacks a part of the observation, or the camera has no colours.
        """
        if belief.images is None:
            raise PolicyError("this policy sees images, and nothing delivers them here")
        state = torch.cat([belief.part(name) for name in self.sight.state_parts], dim=-1)
        images = self._frames.push(belief.images(self.sight.images), self._fresh)
        self._fresh = None
        return self.actor.act({STATE: state, **images})

    def describe(self) -> dict[str, Any]:
        """The actor's own account."""
        return self.actor.describe()


class PixelFollower:
    """The same in a task that keeps no belief: the state vectors are the task's observations."""

    def __init__(self, policy: PixelPolicy, env: Any) -> None:
        """Ties a policy to an environment whose episodes begin now.

        Args:
            policy: Decides.
            env: Its `unwrapped` delivers `images`.
        """
        self._policy = policy
        self._world: Any = env.unwrapped
        self._frames = FrameStack(policy.sight.frames)

    def act(self, observations: Tensor) -> Tensor:
        """The policy's actions. Shape (B, A)."""
        images = self._frames.push(self._world.images(self._policy.sight.images))
        return self._policy.actor.act({STATE: observations, **images})
