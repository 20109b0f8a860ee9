"""Policies that plan nothing: stay, random step, random viewpoint, fixed sweep, look-at servoing.

Sather and Zhang (2019, arXiv 1903.02074) compare with random motions and visual servoing, Burusa et al. (2022,
arXiv 2206.10274) with predefined views and random ones.
"""

import math

import torch
from torch import Tensor

from maniskill_tomato.policies.layout import EPSILON_GREEDY_HIGH, EPSILON_GREEDY_LOW
from maniskill_tomato.policies.moves import Goals
from maniskill_tomato.policies.protocol import Planner, RandomPlanner
from maniskill_tomato.raycast.view_rays import RayLabel, ray_pattern
from maniskill_tomato.robot.look_at_move import MAX_MOVE
from maniskill_tomato.sensing.belief import Belief

SWEEP_AZIMUTHS = (-40.0, 0.0, 40.0)
"""Columns of the fixed sweep as seen from the target, about the direction to the robot base, in [deg]."""
SWEEP_ELEVATIONS = (-20.0, 10.0, 40.0)
"""Its rows, in [deg]."""
SWEEP_DISTANCE = 0.45
"""Its distance from the target, in [m]."""

SERVO_DISTANCE = 0.3
"""Distance at which look-at servoing stops to approach, in [m]."""
SMALLEST_OFFSET = 0.002
"""A smaller offset of what is seen of the target counts as none, in [m]."""


class Stay(Planner):
    """Never moves: what the start view is worth."""

    name = "stay"

    def act(self, belief: Belief) -> Tensor:
        """No move."""
        return torch.zeros_like(belief.camera_position)


class RandomStep(RandomPlanner):
    """A full move in a new random direction every time."""

    name = "random_step"

    def act(self, belief: Belief) -> Tensor:
        """Uniform on the sphere of full moves."""
        position = belief.camera_position
        direction = self._normal(*position.shape).to(position)
        full: Tensor = direction / direction.norm(dim=-1, keepdim=True).clamp_min(1e-6)
        return full


class RandomIncrements:
    """A state policy of the thesis's tasks: uniformly random actions from the ranges of Eq. 5-6.

    One stream of random numbers runs through all episodes, so that an episode depends on those before it.
    """

    def __init__(self, seed: int, device: torch.device | str = "cpu") -> None:
        self._generator = torch.Generator(device=device).manual_seed(seed)
        self._low = torch.tensor(EPSILON_GREEDY_LOW, device=device)
        self._range = torch.tensor(EPSILON_GREEDY_HIGH, device=device) - self._low

    def act(self, observations: Tensor) -> Tensor:
        """Random actions, [m] and [rad]. Shape (B, 6)."""
        uniform = torch.rand(len(observations), 6, generator=self._generator, device=self._low.device)
        return self._low + uniform * self._range


class RandomViewpoint(RandomPlanner):
    """Moves to a random reachable viewpoint of the lattice, then to the next one."""

    name = "random_viewpoint"

    def __init__(self, seed: int = 0) -> None:
        super().__init__(seed)
        self._goals = Goals()

    def begin(self, belief: Belief, rows: Tensor) -> None:
        self._goals.begin(belief, rows)

    def act(self, belief: Belief) -> Tensor:
        """Towards the goal; a new one where the last is reached or blocked."""
        ended = self._goals.ended(belief)
        if bool(ended.any()):
            scores = self._uniform(*belief.reachable.shape).to(belief.camera_position)
            chosen = torch.where(belief.reachable, scores, -1.0).argmax(dim=1)
            self._goals.set(candidate_positions(belief, chosen), ended)
        return self._goals.act(belief)


class FixedSweep(Planner):
    """Nine predefined viewpoints in a 3x3 pattern round the target, row by row, from the nearest corner.

    Burusa et al. (2022) move a camera over a predefined zig-zag. Here each viewpoint is replaced by the reachable
    viewpoint of the lattice nearest to it, the way begins at the corner nearest to the start and turns back at the
    end of each row, and the rows are repeated where moves are left.
    """

    name = "fixed_sweep"

    def __init__(self) -> None:
        self._goals = Goals()
        self._route = torch.zeros(0, 9, 3)
        self._next = torch.zeros(0, dtype=torch.int64)

    def begin(self, belief: Belief, rows: Tensor) -> None:
        position, target = belief.camera_position, belief.target_position
        if len(self._route) != len(position):
            self._route = position.new_zeros(len(position), 9, 3)
            self._next = torch.zeros(len(position), dtype=torch.int64, device=position.device)
        self._goals.begin(belief, rows)
        candidates = belief.lattice.positions(target)
        for i in rows.tolist():
            views = target[i] + sweep_offsets(target[i])
            allowed = candidates[i][belief.reachable[i]]
            if len(allowed):
                views = allowed[torch.cdist(views, allowed).argmin(dim=1)]
            self._route[i] = _from_the_nearest_corner(views.view(3, 3, 3), position[i])
        self._next[rows] = 0

    def act(self, belief: Belief) -> Tensor:
        """Towards the next view of the pattern."""
        ended = self._goals.ended(belief)
        rows = torch.arange(len(ended), device=ended.device)
        self._goals.set(self._route[rows, self._next % 9], ended)
        self._next = self._next + ended.long()
        return self._goals.act(belief)


class LookAtServoing(Planner):
    """Moves to the side on which the target shows, and nearer: visual servoing.

    Sather and Zhang (2019) name visual servoing as their best baseline: it turns the camera to the berry and
    approaches it. The control mode turns the camera here, so that the servoing error is the offset between the
    middle of what is seen of the target and its centre, which pulls the camera away from what covers the other
    side. A part of the move goes along it, a part forward until `SERVO_DISTANCE`. With nothing of the target in view it
    only approaches.
    """

    name = "look_at"

    def __init__(self) -> None:
        self._pattern = torch.from_numpy(ray_pattern())

    def act(self, belief: Belief) -> Tensor:
        """Along the offset of the visible part, and forward."""
        seen = (belief.rays.label == int(RayLabel.TARGET)).to(belief.camera_position)
        count = seen.sum(dim=1, keepdim=True)
        offset = seen @ self._pattern.to(seen) / count.clamp_min(1.0)
        length = offset.norm(dim=-1, keepdim=True)
        shown = (count > 0) & (length > SMALLEST_OFFSET)
        lateral = torch.where(shown, 0.7 * offset / length.clamp_min(1e-6), torch.zeros_like(offset))
        distance = (belief.target_position - belief.camera_position).norm(dim=-1)
        forward = ((distance - SERVO_DISTANCE) / MAX_MOVE).clamp(-0.7, 0.7)
        return torch.cat([lateral, forward[:, None]], dim=-1)


def candidate_positions(belief: Belief, index: Tensor) -> Tensor:
    """Positions of one viewpoint of the lattice per environment.

    Args:
        belief: Where the targets are.
        index: Which viewpoint. Shape (B,).

    Returns:
        In the world frame, in [m]. Shape (B, 3).
    """
    positions: Tensor = belief.lattice.positions(belief.target_position)
    return positions[torch.arange(len(index), device=index.device), index]


def sweep_offsets(target: Tensor) -> Tensor:
    """The pattern of the sweep, relative to the target, row by row from below.

    Args:
        target: In the world frame, in [m]. Shape (3,).

    Returns:
        In [m]. Shape (9, 3).
    """
    towards_base = math.atan2(-float(target[1]), -float(target[0]))
    azimuth = towards_base + torch.deg2rad(torch.tensor(SWEEP_AZIMUTHS)).repeat(3)
    elevation = torch.deg2rad(torch.tensor(SWEEP_ELEVATIONS)).repeat_interleave(3)
    level = torch.cos(elevation)
    offsets = torch.stack([level * torch.cos(azimuth), level * torch.sin(azimuth), torch.sin(elevation)], -1)
    return SWEEP_DISTANCE * offsets.to(target)


def _from_the_nearest_corner(views: Tensor, position: Tensor) -> Tensor:
    """A 3x3 pattern as a way that starts at the corner nearest to a position and turns back after each row."""
    corners = views[::2, ::2].reshape(4, 3)
    corner = int((corners - position).norm(dim=-1).argmin())
    if corner >= 2:
        views = views.flip(0)
    if corner % 2:
        views = views.flip(1)
    views = torch.stack([views[0], views[1].flip(0), views[2]])
    return views.reshape(9, 3)
