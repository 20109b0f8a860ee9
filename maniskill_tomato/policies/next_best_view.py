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
from dataclasses import dataclass

import torch
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.policies.moves import Candidates
from maniskill_tomato.policies.protocol import Planner
from maniskill_tomato.robot.look_at_move import MAX_MOVE
from maniskill_tomato.sensing.belief import Belief


@dataclass(frozen=True, kw_only=True)
class NextBestViewConfig:
    """What a view is worth."""

    move_cost: float = 0.1
    """Expected V_f that one move of the way is worth; tuned on validation plants (`docs/planners.md`)."""
    unknown_gain: float = 0.0
    """Worth of a way from target to view that is wholly unknown."""
    similar_angle: float = math.radians(8.0)
    """Views within about this angle, seen from the target, show the same, in [rad]."""
    similar_distance: float = 0.1
    """And within about this difference of distance, in [m]."""

    def __post_init__(self) -> None:
        for name in ("move_cost", "unknown_gain"):
            if not math.isfinite(getattr(self, name)):
                raise InvalidInputError(f"{name} must be a finite number, got {getattr(self, name)}")
        for name in ("similar_angle", "similar_distance"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise InvalidInputError(f"{name} must be a positive number, got {getattr(self, name)}")


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

    def correct(self, predicted: Tensor, offsets: Tensor, config: NextBestViewConfig) -> Tensor:
        """Predictions moved towards the measurement of the most similar view.

        Args:
            predicted: Expected V_f. Shape (B, K).
            offsets: The candidates' positions relative to the target, in [m]. Shape (B, K, 3).
            config: What is similar.

        Returns:
            Shape (B, K).
        """
        most = int(self._count.max())
        taken, seen = self._offset[:, :most], self._seen[:, :most]
        distance, taken_distance = offsets.norm(dim=-1), taken.norm(dim=-1)
        cosine = (offsets @ taken.mT) / (distance[:, :, None] * taken_distance[:, None]).clamp_min(1e-9)
        angle = torch.acos(cosine.clamp(-1.0, 1.0)) / config.similar_angle
        nearer = (distance[:, :, None] - taken_distance[:, None]) / config.similar_distance
        similar = torch.exp(-0.5 * (angle.square() + nearer.square())).nan_to_num(0.0)
        weight, which = similar.max(dim=-1)
        measured = seen.gather(1, which)
        corrected: Tensor = predicted + weight * (measured - predicted)
        return corrected


class NextBestView(Planner):
    """Chooses direction and distance."""

    name = "nbv"

    def __init__(self, config: NextBestViewConfig | None = None) -> None:
        self.config = config or NextBestViewConfig()
        self._measured = MeasuredViews()
        self.tried = Candidates()

    def begin(self, belief: Belief, rows: Tensor) -> None:
        self._measured.begin(belief, rows)
        self.tried.begin(belief, rows)

    def act(self, belief: Belief) -> Tensor:
        """Towards the best view."""
        self._measured.add(belief)
        self.tried.note_refusals(belief)
        candidates = self._candidates(belief)
        utility = self.utility(belief, candidates)
        return self.tried.move_to_best(belief, candidates, utility, self._allowed(belief))

    def utility(self, belief: Belief, candidates: Tensor) -> Tensor:
        """What views are worth now.

        Args:
            belief: What is known.
            candidates: Positions in the world frame, in [m]. Shape (B, K, 3).

        Returns:
            Shape (B, K).
        """
        expected, unknown = belief.memory.predict(candidates).unbind(-1)
        offsets = candidates - belief.target_position[:, None]
        worth = self._measured.correct(expected, offsets, self.config)
        way = (candidates - belief.camera_position[:, None]).norm(dim=-1) / MAX_MOVE
        utility: Tensor = worth + self.config.unknown_gain * unknown - self.config.move_cost * way
        return utility

    def _candidates(self, belief: Belief) -> Tensor:
        """Positions of the views to choose from. Shape (B, K, 3)."""
        positions: Tensor = belief.lattice.positions(belief.target_position)
        return positions

    def _allowed(self, belief: Belief) -> Tensor:
        """Which of them may be chosen. Shape (B, K), bool."""
        return belief.reachable


class NextBestDirection(NextBestView):
    """Chooses the direction and keeps the distance: greedy on the view sphere."""

    name = "nbv_direction"

    def __init__(self, config: NextBestViewConfig | None = None) -> None:
        """Begins with its own tuned cost of a move, 0.05."""
        super().__init__(config or NextBestViewConfig(move_cost=0.05))

    def _candidates(self, belief: Belief) -> Tensor:
        offsets = super()._candidates(belief) - belief.target_position[:, None]
        distance = (belief.camera_position - belief.target_position).norm(dim=-1)
        on_sphere = offsets * (distance[:, None] / offsets.norm(dim=-1))[..., None]
        candidates: Tensor = belief.target_position[:, None] + on_sphere
        return candidates

    def _allowed(self, belief: Belief) -> Tensor:
        # Of the views in one direction, which now stand on each other, the one whose own distance is nearest.
        offsets = super()._candidates(belief) - belief.target_position[:, None]
        distance = (belief.camera_position - belief.target_position).norm(dim=-1)
        gap = (offsets.norm(dim=-1) - distance[:, None]).abs()
        nearest: Tensor = gap <= gap.min(dim=1, keepdim=True).values + 1e-3
        return belief.reachable & nearest
