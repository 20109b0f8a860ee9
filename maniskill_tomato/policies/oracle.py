"""The oracle: fewest moves to a view that shows the target, found with the ground truth.

`OracleSearch` looks through places around the start in the order of the moves that they need. It is exact as far as
its samples go: places are drawn `SPACINGS` apart, a way is straight or has one bend, and the arm must reach every
stop. What it finds is a way that the control mode can take; a shorter one may exist between the samples.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from maniskill_tomato.policies.moves import NEAR_ENOUGH, move_towards, moves_needed, stops
from maniskill_tomato.policies.protocol import GroundTruth, Planner
from maniskill_tomato.robot.camera_reach import CameraReach
from maniskill_tomato.robot.look_at import look_at_pose
from maniskill_tomato.robot.look_at_move import MAX_MOVE, MIN_DISTANCE
from maniskill_tomato.sensing.belief import Belief

SPACINGS = (0.02, 0.03, 0.04, 0.05)
"""Distance of neighbouring samples after 1, 2, 3 and more moves, in [m]."""

SHOULDER = (0.0, 0.0, 0.36)
"""Centre of the arm's spherical shoulder, in the world frame, in [m]."""
FARTHEST = 1.05
"""No camera position farther from the shoulder is reachable, in [m]: upper arm 0.42, forearm 0.40, wrist to camera
0.20."""

BENDS = 128
"""Places tried as the bend of a way."""

_BLOCK = 192
"""Views cast at a time, nearest first, so that a near solution ends the search early."""

_BENT_WAYS = 6
"""Ways with a bend that may be turned down before the view is given up."""

_WAYS = 12
"""Good views for which ways are tried before the next block."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Solution:
    """A way to a view that shows the target."""

    stops: Tensor
    """Where the camera stops, the good view last, in the world frame, in [m]. Shape (n, 3)."""
    visible_fraction: float
    """V_f of the last view."""

    @property
    def moves(self) -> int:
        """Number of moves n."""
        return len(self.stops)


class OracleSearch:
    """Searches for the fewest moves."""

    def __init__(
        self,
        ground_truth: GroundTruth,
        device: str | torch.device = "cpu",
        *,
        contact_free: bool = False,
        reachable: Callable[[Tensor, Tensor], Tensor] | None = None,
    ) -> None:
        """Keeps what it asks.

        Args:
            ground_truth: Gives V_f of any view, and the last word on a way.
            device: Of all tensors.
            contact_free: Whether no move may touch the plant.
            reachable: Which positions (N, 3) can be taken when looking at a target (3,); the arm's if None.
        """
        self._truth = ground_truth
        self._contact_free = contact_free
        self._reachable = reachable or CameraReach(device).reachable

    def solve(
        self,
        start: Tensor,
        target: Tensor,
        env_index: int = 0,
        most_moves: int = 20,
        excluded: Tensor | None = None,
    ) -> Solution | None:
        """The way with the fewest moves, among those the shortest; None if there is none.

        Args:
            start: Where the camera stands, in the world frame, in [m]. Shape (3,).
            target: What it looks at. Shape (3,).
            env_index: Which environment of the ground truth.
            most_moves: Longest way to look for.
            excluded: Places that did not hold what they promised, as stop or as view. Shape (N, 3).
        """
        if excluded is None:
            excluded = start.new_zeros(0, 3)
        reached: list[Tensor] = []
        for moves in range(1, most_moves + 1):
            places = self._shell(start, target, moves)
            places = places[_apart(places, excluded)]
            if not len(places):
                if (moves - 1) * MAX_MOVE > 2 * FARTHEST + float((start - target).norm()):
                    return None
                continue
            places = places[self._reachable(places, target)]
            reached.append(places)
            solution = self._solve_shell(
                start, target, env_index, moves, places, torch.cat(reached), excluded
            )
            if solution is not None:
                return solution
        return None

    def _solve_shell(
        self,
        start: Tensor,
        target: Tensor,
        env_index: int,
        moves: int,
        places: Tensor,
        reached: Tensor,
        excluded: Tensor,
    ) -> Solution | None:
        """A solution that needs this number of moves, with its view among `places`."""
        for block in torch.split(places, _BLOCK):
            seen = self._truth.visible_fraction(look_at_pose(block, target), env_index)
            good = torch.nonzero(seen > self._truth.threshold)[:, 0]
            for index in good[:_WAYS].tolist():
                way = self._way(start, block[index], target, env_index, moves, reached, excluded)
                if way is not None:
                    return Solution(stops=way, visible_fraction=float(seen[index]))
        return None

    def _way(
        self,
        start: Tensor,
        goal: Tensor,
        target: Tensor,
        env_index: int,
        moves: int,
        reached: Tensor,
        excluded: Tensor,
    ) -> Tensor | None:
        """Stops of a straight way or of one with a bend that needs no more moves."""
        straight = stops(start, goal)
        if self._free(straight, target, excluded) and self._holds(start, straight, target, env_index):
            return straight
        tried = 0
        first, second = (reached - start).norm(dim=1), (reached - goal).norm(dim=1)
        fits = torch.nonzero(moves_needed(first) + moves_needed(second) <= moves)[:, 0]
        fits = fits[(first + second)[fits].argsort()][:BENDS]
        for bend in reached[fits]:
            way = torch.cat([stops(start, bend), stops(bend, goal)])
            if self._free(way, target, excluded):
                if self._holds(start, way, target, env_index):
                    return way
                tried += 1
                if tried == _BENT_WAYS:
                    break
        return None

    def _holds(self, start: Tensor, way: Tensor, target: Tensor, env_index: int) -> bool:
        """Whether the arm can make every move of a way and sees the target at its end."""
        return self._truth.can_follow(start, way, target, env_index, contact_free=self._contact_free)

    def _free(self, way: Tensor, target: Tensor, excluded: Tensor) -> bool:
        """Whether the camera can stop at every place of a way; its end is known to be reachable."""
        before = way[:-1]
        if not len(before):
            return True
        if bool(((before - target).norm(dim=1) < MIN_DISTANCE).any()):
            return False
        return bool(_apart(before, excluded).all()) and bool(self._reachable(before, target).all())

    def _shell(self, start: Tensor, target: Tensor, moves: int) -> Tensor:
        """Samples that need this number of moves on a straight way, nearest first. Shape (N, 3)."""
        outer, inner = moves * MAX_MOVE, (moves - 1) * MAX_MOVE
        spacing = SPACINGS[min(moves, len(SPACINGS)) - 1]
        count = math.ceil(4.0 / 3.0 * math.pi * (outer**3 - inner**3) / spacing**3)
        points = start + shell_points(count, inner, outer).to(start)
        shoulder = points.new_tensor(SHOULDER)
        kept = (
            ((points - target).norm(dim=1) >= MIN_DISTANCE)
            & ((points - shoulder).norm(dim=1) <= FARTHEST)
            & (points[:, 2] > 0.0)
        )
        points = points[kept]
        return points[(points - start).norm(dim=1).argsort()]


class Oracle(Planner):
    """Follows the way of `OracleSearch`, and searches again where a move or a view is not what it promised."""

    name = "oracle"
    needs_truth = True

    def __init__(self, search: OracleSearch) -> None:
        """Keeps the search; see `of`."""
        self._search = search
        self._ways: dict[int, Tensor] = {}
        self._excluded: dict[int, list[Tensor]] = {}

    @classmethod
    def of(
        cls, ground_truth: GroundTruth, device: str | torch.device = "cpu", contact_free: bool = False
    ) -> "Oracle":
        """With a search among the places that the arm reaches."""
        return cls(OracleSearch(ground_truth, device, contact_free=contact_free))

    def begin(self, belief: Belief, rows: Tensor) -> None:
        for i in rows.tolist():
            self._excluded[i] = []
            self._ways.pop(i, None)

    def act(self, belief: Belief) -> Tensor:
        """Towards the next stop; no move where there is no way."""
        goal = belief.camera_position.clone()
        for i in range(len(goal)):
            way = self._way_from_here(belief, i)
            if len(way):
                goal[i] = way[0]
        return move_towards(belief.camera_position, belief.target_position, goal)

    def _way_from_here(self, belief: Belief, i: int) -> Tensor:
        position = belief.camera_position[i]
        if i not in self._ways:
            self._plan(belief, i)
        elif len(self._ways[i]):
            aimed_at, rest = self._ways[i][0], self._ways[i][1:]
            arrived = bool((aimed_at - position).norm() <= NEAR_ENOUGH)
            self._ways[i] = rest
            # The episode goes on: the arm did not get there, or the last view was not good.
            if not arrived or not len(rest):
                self._excluded[i].append(aimed_at)
                self._plan(belief, i)
        return self._ways[i]

    def _plan(self, belief: Belief, i: int) -> None:
        position = belief.camera_position[i]
        solution = self._search.solve(
            position,
            belief.target_position[i],
            i,
            max(int(belief.moves_left[i]), 1),
            torch.stack(self._excluded[i]) if self._excluded[i] else None,
        )
        self._ways[i] = position.new_zeros(0, 3) if solution is None else solution.stops


def _apart(places: Tensor, excluded: Tensor) -> Tensor:
    """Which places are not among the excluded ones. Shape (N,), bool."""
    return (torch.cdist(places, excluded) > NEAR_ENOUGH).all(dim=1)


def shell_points(count: int, inner: float, outer: float) -> Tensor:
    """Points of even density between two spheres about the origin, the same ones every time.

    A Kronecker sequence of three coordinates (the R_3 sequence of Roberts 2018, whose base is the root of
    g^4 = g + 1) is laid over volume, height and angle. Shape (count, 3).
    """
    index = torch.arange(count, dtype=torch.float64)
    g = 1.2207440846057596
    u = torch.stack([torch.remainder(0.5 + index / g**k, 1.0) for k in (1, 2, 3)], dim=1)
    radius = (inner**3 + u[:, 0] * (outer**3 - inner**3)) ** (1.0 / 3.0)
    height = 2.0 * u[:, 1] - 1.0
    level = torch.sqrt(1.0 - height**2)
    angle = 2.0 * math.pi * u[:, 2]
    direction = torch.stack([level * torch.cos(angle), level * torch.sin(angle), height], dim=1)
    return (radius[:, None] * direction).float()
