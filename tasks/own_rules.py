"""What a task of somebody else's may do its own way: the reward, the starts, what counts as a success."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError


@dataclass(frozen=True, kw_only=True, eq=False)
class Moved:
    """What came of a move in N environments at once; all tensors are on the world's device."""

    info: Mapping[str, Tensor]
    """The step's info; for a success rule, what the base says. Each of shape (N, ...)."""
    visible_fraction: Tensor
    """V_f of the target after the move, from 0 to 1. Shape (N,)."""
    previous_fraction: Tensor
    """V_f of the same target before it. Shape (N,)."""
    viewpoint: Tensor
    """Where the flange is: x, y, z [m], roll, pitch, yaw [rad], world frame. Shape (N, 6)."""
    qpos: Tensor
    """Joint positions, in [rad]. Shape (N, 7)."""
    camera_position: Tensor
    """Where the camera is, world frame, in [m]. Shape (N, 3)."""
    target_position: Tensor
    """Where the target is believed to be, world frame, in [m]. Shape (N, 3)."""


RewardFunction = Callable[[Moved], Tensor]
"""The reward of a move. Shape (N,), finite."""

SuccessRule = Callable[[Moved], Tensor]
"""Which episodes are a success after a move, and at the start. Shape (N,), bool."""

StartFunction = Callable[[np.random.RandomState, int, NDArray[np.float64]], NDArray[np.float64]]
"""Draws candidates for the start of one environment from its generator: how many, and where the target is, world frame,
in [m], of shape (3,). It gives, in the world frame, for the thesis's tasks viewpoints of the flange (x, y, z [m], roll,
pitch, yaw [rad]) of shape (count, 6), for the general ones positions of the camera, which looks at the target, in [m],
of shape (count, 3). The first that fits the task is taken: in reach, and in the general tasks free of contact and with
V_f in `start_visibility`."""


@dataclass(frozen=True, kw_only=True)
class OwnRules:
    """Own rules of a task; None where the base's hold."""

    env_id: str = ""
    """Whose they are, for messages."""
    reward: RewardFunction | None = None
    largest_reward: float = 1.0
    """The largest reward of one move."""
    starts: StartFunction | None = None
    success: SuccessRule | None = None

    def reward_of(self, moved: Moved) -> Tensor:
        """The reward of a move, of shape (N,), float32, where `reward` is not None.

        Raises:
            InvalidInputError: The function returned something else.
        """
        assert self.reward is not None
        reward = self._checked("reward", self.reward(moved), moved).float()
        finite = reward.isfinite()
        if not bool(finite.all()):
            raise InvalidInputError(
                f"the reward of {self.env_id} must be finite; got {float(reward[~finite][0])} in "
                f"{int((~finite).sum())} of {len(reward)} environments"
            )
        return reward

    def success_of(self, moved: Moved) -> Tensor:
        """Which episodes are a success, of shape (N,), bool, where `success` is not None.

        Raises:
            InvalidInputError: The function returned something else.
        """
        assert self.success is not None
        success = self._checked("success", self.success(moved), moved)
        if success.dtype != torch.bool:
            raise InvalidInputError(
                f"the success of {self.env_id} must return a tensor of bool; got {success.dtype}"
            )
        return success

    def _checked(self, what: str, values: object, moved: Moved) -> Tensor:
        wanted = moved.visible_fraction
        if not isinstance(values, Tensor) or values.shape != wanted.shape or values.device != wanted.device:
            got = (
                f"one of shape {tuple(values.shape)} on {values.device}"
                if isinstance(values, Tensor)
                else type(values).__name__
            )
            raise InvalidInputError(
                f"the {what} of {self.env_id} must return a tensor of shape {tuple(wanted.shape)} on {wanted.device}; "
                f"got {got}"
            )
        return values

    def draw_starts(
        self, rng: np.random.RandomState, count: int, target_position: NDArray[np.float64], size: int
    ) -> NDArray[np.float64]:
        """Candidates for a start, of shape (count, size), where `starts` is not None.

        Args:
            rng: The environment's generator.
            count: How many.
            target_position: World frame, in [m]. Shape (3,).
            size: Numbers of each.

        Raises:
            InvalidInputError: The function returned something else.
        """
        assert self.starts is not None
        drawn = np.asarray(self.starts(rng, count, target_position), dtype=np.float64)
        if drawn.shape != (count, size) or not np.isfinite(drawn).all():
            what = "x, y, z [m], roll, pitch, yaw [rad]" if size == 6 else "x, y, z [m]"
            raise InvalidInputError(
                f"the starts of {self.env_id} must be finite numbers of shape ({count}, {size}), {what}; "
                f"got shape {drawn.shape}"
            )
        return drawn
