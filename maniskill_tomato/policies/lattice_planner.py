"""Planners that choose from the candidate views of the lattice, and what they do not try again."""

import math
from abc import abstractmethod
from dataclasses import dataclass

import torch
from torch import Tensor

from maniskill_tomato.policies.followed_ways import SAME_PLACE, WayFollower
from maniskill_tomato.policies.moves import LEAST_MOVE, move_towards, moves_needed
from maniskill_tomato.policies.protocol import Planner
from maniskill_tomato.sensing.belief import Belief

REFUSED_ANGLE = math.radians(30.0)
"""Moves from one place within this angle of a refused one are taken to be refused too."""

FOLLOWED = 8
"""Candidates to which the way is followed at most, once the arm gets to one of them."""


def distance_to_taken(belief: Belief, positions: Tensor) -> Tensor:
    """How far places are from the nearest view that was taken.

    Args:
        belief: Its memory knows the views.
        positions: In the world frame, in [m]. Shape (B, K, 3).

    Returns:
        In [m]. Shape (B, K).
    """
    most = max(int(belief.memory.visits.max()), 1)
    # A missing view is NaN.
    return torch.cdist(positions, belief.memory.visited[:, :most]).nan_to_num(1.0e3).amin(dim=-1)


class Candidates:
    """Which candidate of the lattice each environment goes to, and which ones are not tried any more.

    A view that was taken, or one within `SAME_PLACE` of it, is not taken again: it was not enough. A candidate
    towards which the camera moved less than a tenth of a move is not tried again in the episode. Nor is, until the
    camera has moved, any other one that lies within `REFUSED_ANGLE` of that direction: the arm would refuse nearly
    the same move.
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
        stuck = (belief.camera_position - self._before).norm(dim=-1) < LEAST_MOVE
        for i, stayed in enumerate(stuck.tolist()):
            if stayed:
                self.refused[i, self.chosen[i]] = True
                self._refused_directions[i].append(self._direction[i].clone())
            else:
                self._refused_directions[i].clear()

    def untried(self, belief: Belief, positions: Tensor, allowed: Tensor) -> Tensor:
        """Which candidates are allowed, show another view than those taken and were not refused. Shape (B, K), bool."""
        untried: Tensor = allowed & ~self.refused & (distance_to_taken(belief, positions) > SAME_PLACE)
        return untried

    def choosable(self, belief: Belief, positions: Tensor, allowed: Tensor) -> Tensor:
        """`untried` less those in the directions that the arm refused from here. Shape (B, K), bool."""
        allowed = self.untried(belief, positions, allowed)
        directions = _directions(belief, positions)
        for i, refused in enumerate(self._refused_directions):
            if refused:
                near = (directions[i] @ torch.stack(refused).mT).amax(dim=-1) > math.cos(REFUSED_ANGLE)
                # Where all directions were refused, those of the other candidates are tried after all.
                if bool((allowed[i] & ~near).any()):
                    allowed[i] &= ~near
        return allowed

    def move_to_best(self, belief: Belief, positions: Tensor, worth: Tensor) -> Tensor:
        """The moves towards the best candidates.

        Args:
            belief: What is known.
            positions: Of the candidates, in the world frame, in [m]. Shape (B, K, 3).
            worth: Negative infinity where one may not be chosen. Shape (B, K).

        Returns:
            Shape (B, 3).
        """
        position = belief.camera_position
        self.chosen = worth.argmax(dim=1)
        self._before = position.clone()
        rows = torch.arange(len(position), device=position.device)
        self._direction = _directions(belief, positions)[rows, self.chosen]
        return move_towards(position, belief.target_position, positions[rows, self.chosen])


def _directions(belief: Belief, positions: Tensor) -> Tensor:
    """From the cameras to each candidate. Shapes (B, K, 3)."""
    return torch.nn.functional.normalize(positions - belief.camera_position[:, None], dim=-1)


@dataclass(frozen=True, eq=False, kw_only=True)
class JudgedViews:
    """What a decision was made from: the views to choose from, and what the planner thought of them."""

    positions: Tensor
    """Of the cameras, in the world frame, in [m]. Shape (B, K, 3)."""
    worth: Tensor
    """In the planner's own unit, by the straight way; negative infinity where one may not be chosen. Shape (B, K)."""
    chosen: Tensor
    """The views that the cameras move towards, by the ways that the arm really takes. Shape (B,), int64."""


class LatticePlanner(Planner):
    """Moves towards the view of the lattice that is worth most, among those worth trying that the arm gets to."""

    move_worth = 1.0
    """What a move more costs, in the unit of `worth`."""

    def __init__(self) -> None:
        self.tried = Candidates()
        self.judged: JudgedViews | None = None
        """What the last `act` decided from; None before the first."""
        self._ways: WayFollower | None = None

    def begin(self, belief: Belief, rows: Tensor) -> None:
        self.tried.begin(belief, rows)

    def act(self, belief: Belief) -> Tensor:
        """Towards the best view."""
        self.tried.note_refusals(belief)
        views = self.views(belief)
        allowed = self.tried.choosable(belief, views, self.allowed(belief))
        worth = torch.where(allowed, self.worth(belief, views), -math.inf)
        move = self.tried.move_to_best(belief, views, self._by_ways(belief, views, worth))
        self.judged = JudgedViews(positions=views, worth=worth, chosen=self.tried.chosen)
        return move

    def _by_ways(self, belief: Belief, views: Tensor, worth: Tensor) -> Tensor:
        """What views are worth by the moves that the arm really needs, as far as that decides which is best.

        The ways to the best ones are followed, until one of these is worth more than any other could be. Where the arm
        gets to none, they are worth what they were.
        """
        if belief.qpos is None:
            return worth
        if self._ways is None:
            self._ways = WayFollower(worth.device, belief.lattice.model)
        straight = moves_needed(way_to(belief, views))
        followed, rest = torch.full_like(worth, -math.inf), worth.clone()
        for count in range(views.shape[1]):
            hope, best = rest.max(dim=1)
            found = followed.amax(dim=1)
            rows = ((hope > found) & ((found == -math.inf) | (count < FOLLOWED))).nonzero()[:, 0]
            if not len(rows):
                break
            chosen = best[rows]
            moves = self._ways.moves_along(
                belief.qpos[rows],
                belief.camera_position[rows],
                belief.target_position[rows],
                views[rows, chosen],
            )
            extra = moves - straight[rows, chosen]
            followed[rows, chosen] = worth[rows, chosen] - self.move_worth * extra
            rest[rows, chosen] = -math.inf
        gets_there = followed.isfinite().any(dim=1, keepdim=True)
        return torch.where(gets_there, followed, worth)

    def ranked(self, belief: Belief) -> list[int]:
        """The candidates of the first environment that are worth trying, the best first."""
        views = self.views(belief)
        untried = self.tried.untried(belief, views, self.allowed(belief))[0]
        order = torch.where(untried, self.worth(belief, views)[0], -math.inf).argsort(descending=True)
        best: list[int] = order[: int(untried.sum())].tolist()
        return best

    @abstractmethod
    def worth(self, belief: Belief, views: Tensor) -> Tensor:
        """What each view is worth now, in the planner's own unit. Shapes (B, K, 3) to (B, K)."""

    def views(self, belief: Belief) -> Tensor:
        """Positions of the views to choose from, in the world frame, in [m]. Shape (B, K, 3)."""
        positions: Tensor = belief.lattice.positions(belief.target_position)
        return positions

    def allowed(self, belief: Belief) -> Tensor:
        """Which of them may be chosen. Shape (B, K), bool."""
        return belief.reachable


def way_to(belief: Belief, views: Tensor) -> Tensor:
    """Straight distance from the camera to each view, in [m]. Shapes (B, K, 3) to (B, K)."""
    way: Tensor = (views - belief.camera_position[:, None]).norm(dim=-1)
    return way
