"""Moves of the camera towards places in the world, as actions of the `pd_look_at` control mode."""

import math

import torch
from torch import Tensor

from maniskill_tomato.robot.look_at import look_frame
from maniskill_tomato.robot.look_at_move import MAX_MOVE
from maniskill_tomato.sensing.belief import Belief

NEAR_ENOUGH = 0.01
"""A goal within this distance is reached, in [m]."""

LEAST_MOVE = 0.1 * MAX_MOVE
"""A move that brings the camera less far counts as refused, in [m]."""


def move_towards(position: Tensor, target: Tensor, goal: Tensor) -> Tensor:
    """The action that moves the camera straight to a goal, or a full move of the way there.

    Args:
        position: Where the camera stands, in the world frame, in [m]. Shape (B, 3).
        target: What it looks at. Shape (B, 3).
        goal: Where to go. Shape (B, 3).

    Returns:
        (right, up, forward) as shares of `MAX_MOVE`, not longer than 1. Shape (B, 3).
    """
    in_look_frame = (look_frame(position, target).mT @ (goal - position).unsqueeze(-1)).squeeze(-1)
    return shortened(in_look_frame / MAX_MOVE)


def shortened(action: Tensor) -> Tensor:
    """Actions, those longer than a full move cut to one. Shape (B, 3)."""
    cut: Tensor = action / action.norm(dim=-1, keepdim=True).clamp_min(1.0)
    return cut


def moves_needed(distance: Tensor | float) -> Tensor:
    """How many moves a straight way takes, at least 1; rounding errors of a hundredth of a millimetre do not count."""
    return torch.ceil((torch.as_tensor(distance) - 1e-5) / MAX_MOVE).clamp_min(1.0)


def stops(start: Tensor, goal: Tensor) -> Tensor:
    """Where the camera stops on the straight way: equal moves, the goal last, the start left out.

    Args:
        start: In the world frame, in [m]. Shape (3,).
        goal: Shape (3,).

    Returns:
        Shape (n, 3) with n = `moves_needed`.
    """
    count = int(moves_needed((goal - start).norm()))
    shares = torch.arange(1, count + 1, dtype=start.dtype, device=start.device) / count
    return start + shares[:, None] * (goal - start)


class Goals:
    """A place to go to for each environment, kept over several moves.

    A goal ends where it is reached, or where a move towards it brought the camera less than a tenth of a move
    nearer: the arm refused, or the smallest distance from the target stands in the way.
    """

    def __init__(self) -> None:
        self._goal = torch.zeros(0, 3)
        self._before = torch.zeros(0)

    def begin(self, belief: Belief, rows: Tensor) -> None:
        """Drops the goals of some environments."""
        if len(self._goal) != len(belief.camera_position):
            self._goal = torch.full_like(belief.camera_position, math.nan)
            self._before = torch.full_like(belief.camera_position[:, 0], math.inf)
        self._goal[rows] = math.nan

    def ended(self, belief: Belief) -> Tensor:
        """Which environments need a new goal. Shape (B,), bool."""
        left = (self._goal - belief.camera_position).norm(dim=-1)
        # A missing goal is NaN, which compares false.
        ended: Tensor = ~((left > NEAR_ENOUGH) & (left < self._before - LEAST_MOVE))
        return ended

    def set(self, goal: Tensor, mask: Tensor) -> None:
        """New goals where `mask` is set.

        Args:
            goal: In the world frame, in [m]. Shape (B, 3).
            mask: Shape (B,), bool.
        """
        self._goal = torch.where(mask[:, None], goal, self._goal)
        self._before = torch.where(mask, torch.full_like(self._before, math.inf), self._before)

    def act(self, belief: Belief) -> Tensor:
        """The moves towards the goals. Shape (B, 3)."""
        position = belief.camera_position
        self._before = (self._goal - position).norm(dim=-1)
        return move_towards(position, belief.target_position, self._goal)
