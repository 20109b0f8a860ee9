"""The nearest candidate of the lattice that truly shows the target: a cheap oracle, and a teacher for imitation."""

import torch
from torch import Tensor

from maniskill_tomato.policies.lattice_planner import LatticePlanner, way_to
from maniskill_tomato.policies.moves import moves_needed
from maniskill_tomato.policies.protocol import GroundTruth
from maniskill_tomato.robot.look_at import look_at_pose
from maniskill_tomato.robot.look_at_move import MAX_MOVE
from maniskill_tomato.sensing.belief import Belief


class LatticeOracle(LatticePlanner):
    """Goes to the reachable candidate above the threshold that the fewest moves reach, among those the nearest.

    It knows the true V_f of the candidates alone, where the oracle knows that of any place; what it needs beyond the
    oracle's moves is what the lattice costs. Where no candidate is good it goes to the best one.
    """

    name = "lattice_oracle"
    needs_truth = True

    def __init__(self, ground_truth: GroundTruth) -> None:
        super().__init__()
        self._truth = ground_truth
        self.seen = torch.zeros(0, 0)
        """True V_f of every candidate. Shape (B, K)."""

    def begin(self, belief: Belief, rows: Tensor) -> None:
        if self.seen.shape != belief.reachable.shape:
            self.seen = torch.zeros(belief.reachable.shape, device=belief.reachable.device)
        candidates = belief.lattice.positions(belief.target_position)
        for i in rows.tolist():
            poses = look_at_pose(candidates[i], belief.target_position[i])
            self.seen[i] = self._truth.visible_fraction(poses, i)
        super().begin(belief, rows)

    def worth(self, belief: Belief, views: Tensor) -> Tensor:
        """Nearness where the target shows, and little where it does not. Shape (B, K)."""
        way = way_to(belief, views)
        near = -moves_needed(way) - way / (1e3 * MAX_MOVE)
        return torch.where(self.seen > self._truth.threshold, near, self.seen - 1e3)
