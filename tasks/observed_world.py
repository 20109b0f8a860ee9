"""What a learner is shown of a world: its state vector, or a dictionary of state and images."""

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.sensing.image_layout import Sight
from maniskill_tomato.sensing.image_observation import PRIVILEGED, STATE, FrameStack, Observation
from maniskill_tomato.sensing.observation import ObservationLayout
from maniskill_tomato.tasks.world import World


@dataclass(frozen=True, kw_only=True)
class LearnerEyes(Sight):
    """What a learner sees."""

    privileged: bool = False
    """Whether the whole state vector is there too, for critics."""


class ObservedWorld:
    """Puts observations together."""

    def __init__(self, world: World, eyes: LearnerEyes | None) -> None:
        """Looks at a world.

        Args:
            world: Which.
            eyes: What is seen; None for the state vector alone.
        """
        self._world = world
        self._eyes = eyes
        self.frames = FrameStack(1 if eyes is None else eyes.frames)
        """The views that are stacked."""
        layout: ObservationLayout | None = getattr(world.game, "layout", None)
        self._parts: tuple[str, ...] | None = None
        size = whole = world.game.observation_size
        if eyes is not None and layout is not None:
            wanted = ObservationLayout(parts=eyes.state_parts)
            missing = set(wanted.parts) - set(layout.parts)
            if missing:
                layout_of_world = ", ".join(layout.parts)
                raise InvalidInputError(
                    f"state_parts names {', '.join(sorted(missing))}, and the task's layout holds {layout_of_world}"
                )
            self._parts, size = wanted.parts, wanted.size
        self.space: gym.Space[Any] = _vector(size)
        """Of one environment."""
        if eyes is not None:
            spaces: dict[str, gym.Space[Any]] = {STATE: _vector(size), **eyes.images.spaces(eyes.frames)}
            if eyes.privileged:
                spaces[PRIVILEGED] = _vector(whole)
            self.space = gym.spaces.Dict(spaces)

    def observe(self, begun: Tensor | None, *, moved: bool = False) -> Observation:
        """The present observation.

        Args:
            begun: The environments whose episode begins with it, none if None. Shape (b,).
            moved: Whether the others have moved since the last observation; else they see what they saw.
        """
        world, eyes = self._world, self._eyes
        if eyes is None:
            return world.observation()
        parts = world.game.observation()
        names = self._parts or tuple(parts)
        fresh = torch.zeros(world.num_envs, dtype=torch.bool, device=world.device)
        if begun is not None:
            fresh[begun] = True
        seen = {STATE: torch.cat([parts[name] for name in names], dim=-1)}
        seen |= self.frames.push(world.images(eyes.images), fresh, others_moved=moved)
        if eyes.privileged:
            seen[PRIVILEGED] = world.observation()
        return seen


def _vector(size: int) -> gym.spaces.Box:
    return gym.spaces.Box(-np.inf, np.inf, (size,), np.float32)
