"""One-step greedy with the ground truth: the best of 26 moves by the V_f that it leads to."""

from collections.abc import Callable

import torch
from torch import Tensor

from maniskill_tomato.policies.protocol import GroundTruth, Planner
from maniskill_tomato.robot.camera_reach import CameraReach
from maniskill_tomato.robot.look_at import look_at_pose, look_frame
from maniskill_tomato.robot.look_at_move import MAX_MOVE, MIN_DISTANCE
from maniskill_tomato.sensing.belief import Belief


def greedy_directions() -> Tensor:
    """The 26 directions to the neighbours in a 3x3x3 grid, as full moves. Shape (26, 3)."""
    steps = torch.tensor([-1.0, 0.0, 1.0])
    grid = torch.cartesian_prod(steps, steps, steps)
    grid = grid[grid.abs().sum(dim=1) > 0]
    directions: Tensor = grid / grid.norm(dim=1, keepdim=True)
    return directions


class GreedyTruth(Planner):
    """Takes the full move to the view with the largest true V_f, also where that is less than now.

    What one move of foresight is worth, however good. Moves that the arm cannot take, or that end nearer to the
    target than allowed, are left out. Among equals, as where nothing of the target shows anywhere near, it goes on in
    the direction of its last move as far as it can.
    """

    name = "greedy_truth"
    needs_truth = True

    def __init__(
        self,
        ground_truth: GroundTruth,
        device: str | torch.device = "cpu",
        reachable: Callable[[Tensor, Tensor], Tensor] | None = None,
    ) -> None:
        self._truth = ground_truth
        self._reachable = reachable or CameraReach(device).reachable
        self._directions = greedy_directions().to(device)
        self._last: dict[int, Tensor] = {}

    def begin(self, belief: Belief, rows: Tensor) -> None:
        for i in rows.tolist():
            self._last.pop(i, None)

    def act(self, belief: Belief) -> Tensor:
        """The best move of each environment."""
        moves = torch.zeros_like(belief.camera_position)
        for i in range(len(moves)):
            position, target = belief.camera_position[i], belief.target_position[i]
            shifts = self._directions @ look_frame(position, target).mT
            places = position + MAX_MOVE * shifts
            allowed = ((places - target).norm(dim=1) >= MIN_DISTANCE) & self._reachable(places, target)
            if not bool(allowed.any()):
                continue
            seen = self._truth.visible_fraction(look_at_pose(places, target), i)
            # A tie-break smaller than the caster's resolution of one ray in 256.
            inertia = shifts @ self._last[i] if i in self._last else torch.zeros_like(seen)
            best = int(torch.where(allowed, seen + 1e-3 * inertia, -1.0).argmax())
            moves[i] = self._directions[best]
            self._last[i] = shifts[best]
        return moves
