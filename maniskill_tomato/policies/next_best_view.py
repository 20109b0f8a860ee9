"""Volumetric next-best view: the view of a lattice that the occlusion map says most for, less the way there.

Views are judged by ray casting in an occupancy map, as in Zaenker et al. (2021, arXiv 2011.00275) and Burusa et al.
(2022, arXiv 2206.10274), with the gain and the cost of `gain - cost * distance` as there. Deviations: the gain is the
expected V_f of the target (the transmittance to its disc in `OcclusionMemory`), not an information gain, because the
target's position is known and only its visibility counts; views are those of `ViewLattice` that the arm can reach, so
that nothing is sampled; a new plan is made after every move, and a move goes at most `MAX_MOVE` of the way. Views like
those already taken are worth what was measured there, not what the map says.

`NextBestDirection` plans on the view sphere through the camera alone: it chooses among directions and keeps its
distance.
"""

import math

import torch
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.policies.lattice_planner import LatticePlanner, way_to
from maniskill_tomato.robot.look_at_move import MAX_MOVE
from maniskill_tomato.sensing.belief import Belief

SIMILAR_ANGLE = math.radians(8.0)
"""Views within about this angle, seen from the target, show the same, in [rad]."""

SIMILAR_DISTANCE = 0.1
"""And within about this difference of distance, in [m]."""


class MeasuredViews:
    """V_f as it was measured so far, to correct predictions of similar views."""

    def __init__(self, most: int = 64) -> None:
        """Keeps up to `most` views per environment."""
        self._most = most
        self._offset = torch.zeros(0, most, 3)
        self._seen = torch.zeros(0, most)

    def begin(self, belief: Belief, rows: Tensor) -> None:
        """Forgets the views of some environments."""
        position = belief.camera_position
        if len(self._offset) != len(position):
            self._offset = position.new_full((len(position), self._most, 3), math.nan)
            self._seen = position.new_zeros(len(position), self._most)
            self._count = torch.zeros(len(position), dtype=torch.int64, device=position.device)
        self._offset[rows] = math.nan
        self._count[rows] = 0

    def add(self, belief: Belief) -> None:
        """Takes in the present views."""
        rows = torch.arange(len(self._count), device=self._count.device)
        at = self._count % self._most
        self._offset[rows, at] = belief.camera_position - belief.target_position
        self._seen[rows, at] = belief.visible_fraction.to(self._seen)
        self._count += 1

    def correct(self, predicted: Tensor, offsets: Tensor) -> Tensor:
        """Predictions moved towards the measurement of the most similar view.

        Args:
            predicted: Expected V_f. Shape (B, K).
            offsets: The candidates' positions relative to the target, in [m]. Shape (B, K, 3).

        Returns:
            Shape (B, K).
        """
        most = int(self._count.max())
        taken, seen = self._offset[:, :most], self._seen[:, :most]
        distance, taken_distance = offsets.norm(dim=-1), taken.norm(dim=-1)
        cosine = (offsets @ taken.mT) / (distance[:, :, None] * taken_distance[:, None]).clamp_min(1e-9)
        angle = torch.acos(cosine.clamp(-1.0, 1.0)) / SIMILAR_ANGLE
        nearer = (distance[:, :, None] - taken_distance[:, None]) / SIMILAR_DISTANCE
        similar = torch.exp(-0.5 * (angle.square() + nearer.square())).nan_to_num(0.0)
        weight, which = similar.max(dim=-1)
        measured = seen.gather(1, which)
        corrected: Tensor = predicted + weight * (measured - predicted)
        return corrected


class NextBestView(LatticePlanner):
    """Chooses direction and distance."""

    name = "nbv"

    def __init__(self, move_cost: float = 0.1) -> None:
        """Begins without a view.

        Args:
            move_cost: Expected V_f that one move of the way is worth; tuned on validation plants (`docs/planners.md`).

        Raises:
            InvalidInputError: The cost is not a finite number.
        """
        if not math.isfinite(move_cost):
            raise InvalidInputError(f"move_cost must be a finite number, got {move_cost}")
        super().__init__()
        self.move_cost = move_cost
        self._measured = MeasuredViews()

    def begin(self, belief: Belief, rows: Tensor) -> None:
        self._measured.begin(belief, rows)
        super().begin(belief, rows)

    def act(self, belief: Belief) -> Tensor:
        """Towards the best view."""
        self._measured.add(belief)
        return super().act(belief)

    def worth(self, belief: Belief, views: Tensor) -> Tensor:
        """Expected V_f less the cost of the way. Shape (B, K)."""
        expected, _ = belief.memory.predict(views).unbind(-1)
        expected = self._measured.correct(expected, views - belief.target_position[:, None])
        worth: Tensor = expected - self.move_cost * (way_to(belief, views) / MAX_MOVE)
        return worth


class NextBestDirection(NextBestView):
    """Chooses the direction and keeps the distance: greedy on the view sphere."""

    name = "nbv_direction"

    def __init__(self, move_cost: float = 0.05) -> None:
        """Begins with its own tuned cost of a move."""
        super().__init__(move_cost)

    def views(self, belief: Belief) -> Tensor:
        offsets, distance = self._offsets(belief)
        on_sphere = offsets * (distance[:, None] / offsets.norm(dim=-1))[..., None]
        views: Tensor = belief.target_position[:, None] + on_sphere
        return views

    def allowed(self, belief: Belief) -> Tensor:
        # Of the views in one direction, which now stand on each other, the one whose own distance is nearest.
        offsets, distance = self._offsets(belief)
        gap = (offsets.norm(dim=-1) - distance[:, None]).abs()
        nearest: Tensor = gap <= gap.min(dim=1, keepdim=True).values + 1e-3
        return belief.reachable & nearest

    def _offsets(self, belief: Belief) -> tuple[Tensor, Tensor]:
        """The lattice's views relative to the target, and the camera's distance from it. Shapes (B, K, 3) and (B,)."""
        target = belief.target_position
        return super().views(belief) - target[:, None], (belief.camera_position - target).norm(dim=-1)
