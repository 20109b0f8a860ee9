"""Moves of the camera towards places in the world, as actions of the `pd_look_at` control mode."""

import math

import torch
from torch import Tensor

from maniskill_tomato.robot.look_at import look_frame
from maniskill_tomato.robot.look_at_move import MAX_MOVE
from maniskill_tomato.sensing.belief import Belief

NEAR_ENOUGH = 0.01
"""A goal within this distance is reached, in [m]."""

TAKEN = 0.25 * MAX_MOVE
"""Cameras this near to each other, in [m], have the same view."""

REFUSED_ANGLE = math.radians(30.0)
"""Moves from one place within this angle of a refused one are taken to be refused too."""


def move_towards(position: Tensor, target: Tensor, goal: Tensor) -> Tensor:
    """The action that moves the camera straight to a goal, or a full move of the way there.

    Args:
        position: Where the camera stands, in the world frame, in [m]. Shape (B, 3).
        target: What it looks at. Shape (B, 3).
        goal: Where to go. Shape (B, 3).

    Returns:
        (right, up, forward) as shares of `MAX_MOVE`, not longer than 1. Shape (B, 3).
    """
    return in_look_frame(position, target, goal - position)


def in_look_frame(position: Tensor, target: Tensor, translation: Tensor) -> Tensor:
    """A translation in the world, in [m], as an action, shortened to a full move. Shape (B, 3)."""
    frame = look_frame(position, target)
    action = (frame.mT @ translation.unsqueeze(-1)).squeeze(-1) / MAX_MOVE
    shortened: Tensor = action / action.norm(dim=-1, keepdim=True).clamp_min(1.0)
    return shortened


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
        ended: Tensor = ~((left > NEAR_ENOUGH) & (left < self._before - 0.1 * MAX_MOVE))
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


class Candidates:
    """Which candidate of the lattice each environment goes to, and which ones are not tried any more.

    A view that was taken, or one within `TAKEN` of it, is not taken again: it was not enough. A candidate towards which
    the camera moved less than a tenth of a move is not tried again in the episode. Nor is, until the camera has moved,
    any other one that lies within `REFUSED_ANGLE` of that direction: the arm would refuse nearly the same move.
    """

    def __init__(self) -> None:
        self.refused = torch.zeros(0, 0, dtype=torch.bool)
        """Shape (B, K)."""
        self.chosen = torch.zeros(0, dtype=torch.int64)
        """Shape (B,)."""
        self._before = torch.zeros(0, 3)
        self._direction = torch.zeros(0, 3)
        self._refused_directions: list[list[Tensor]] = []

    def begin(self, belief: Belief, rows: Tensor) -> None:
        """Forgets the episodes of some environments."""
        if self.refused.shape != belief.reachable.shape:
            self.refused = torch.zeros_like(belief.reachable)
            self.chosen = torch.zeros_like(belief.reachable[:, 0], dtype=torch.int64)
            self._before = torch.full_like(belief.camera_position, math.nan)
            self._direction = torch.zeros_like(belief.camera_position)
            self._refused_directions = [[] for _ in range(len(self.chosen))]
        self.refused[rows] = False
        self._before[rows] = math.nan
        for i in rows.tolist():
            self._refused_directions[i].clear()

    def note_refusals(self, belief: Belief) -> None:
        """Looks whether the last moves were made; to be called before the next choice."""
        stuck = (belief.camera_position - self._before).norm(dim=-1) < 0.1 * MAX_MOVE
        for i, stayed in enumerate(stuck.tolist()):
            if stayed:
                self.refused[i, self.chosen[i]] = True
                self._refused_directions[i].append(self._direction[i].clone())
            else:
                self._refused_directions[i].clear()

    def move_to_best(self, belief: Belief, positions: Tensor, worth: Tensor, allowed: Tensor) -> Tensor:
        """The moves towards the best candidates that are allowed, were not taken and not refused.

        Args:
            belief: What is known.
            positions: Of the candidates, in the world frame, in [m]. Shape (B, K, 3).
            worth: Shape (B, K).
            allowed: Shape (B, K), bool.

        Returns:
            Shape (B, 3).
        """
        position = belief.camera_position
        directions = torch.nn.functional.normalize(positions - position[:, None], dim=-1)
        # A missing view is NaN.
        most = max(int(belief.memory.visits.max()), 1)
        gap = torch.cdist(positions, belief.memory.visited[:, :most]).nan_to_num(1.0e3).amin(dim=-1)
        allowed = allowed & ~self.refused & (gap > TAKEN)
        for i, refused in enumerate(self._refused_directions):
            if refused:
                near = (directions[i] @ torch.stack(refused).mT).amax(dim=-1) > math.cos(REFUSED_ANGLE)
                # Where all directions were refused, those of the other candidates are tried after all.
                if bool((allowed[i] & ~near).any()):
                    allowed[i] &= ~near
        self.chosen = torch.where(allowed, worth, -math.inf).argmax(dim=1)
        self._before = position.clone()
        rows = torch.arange(len(position), device=position.device)
        self._direction = directions[rows, self.chosen]
        return move_towards(position, belief.target_position, positions[rows, self.chosen])
