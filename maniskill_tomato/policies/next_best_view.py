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

from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.policies.lattice_planner import LatticePlanner, way_to
from maniskill_tomato.policies.measured_views import most_similar
from maniskill_tomato.robot.look_at_move import MAX_MOVE
from maniskill_tomato.sensing.belief import Belief


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
        self.move_cost = self.move_worth = move_cost

    def worth(self, belief: Belief, views: Tensor) -> Tensor:
        """Expected V_f less the cost of the way. Shape (B, K)."""
        expected, _ = belief.memory.predict(views).unbind(-1)
        weight, measured = most_similar(belief, views)
        expected = expected + weight * (measured - expected)
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
