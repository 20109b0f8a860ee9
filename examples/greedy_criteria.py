"""The greedy search of `nbv` with other criteria, as policies of your own: what should a next view be chosen for?

    cd examples
    maniskill-tomato benchmark --policies nbv,view_quality,greedy_criteria:entropy,greedy_criteria:coverage

All of them choose among the same views of the lattice, follow the same ways, leave out views that were taken, and pay
for the way there. They differ in what a view is worth: `nbv` takes the V_f that the occupancy map expects, and
`view_quality` the V_f that a network expects. The two here are what reconstruction asks for, round the target:

- `coverage`: the unknown voxels that the view would look through, each by how probably it is looked at;
- `entropy`: the entropy of the voxels' occupancy along the view's rays, likewise (map entropy).
"""

import math
from typing import Literal

import torch
from torch import Tensor

from maniskill_tomato.policies.lattice_planner import way_to
from maniskill_tomato.policies.next_best_view import NextBestView
from maniskill_tomato.policies.registry import PolicyContext
from maniskill_tomato.robot.look_at_move import MAX_MOVE
from maniskill_tomato.sensing.belief import Belief
from maniskill_tomato.sensing.occlusion_memory import CELL_SIZE, GRID_CELLS

Criterion = Literal["coverage", "entropy"]

REGION = 0.06
"""Rays go to points within this distance of the target's centre, in [m]."""
RAYS = 5
STEPS = 32
"""Samples along a ray, a voxel apart, from the target's region outwards: as far as the map reaches."""


class GreedyCriterion(NextBestView):
    """`nbv` with another criterion."""

    def __init__(self, criterion: Criterion, move_cost: float) -> None:
        """Begins without a view.

        Args:
            criterion: What views are chosen for.
            move_cost: What one move of the way costs, as a share of the best view's worth.
        """
        super().__init__(move_cost)
        self.name = criterion
        self._criterion = criterion

    def worth(self, belief: Belief, views: Tensor) -> Tensor:
        """The criterion, the best view's being 1, less the cost of the way. Shape (B, K)."""
        gain = self.gain(belief, views)
        best = gain.amax(dim=1, keepdim=True).clamp_min(1e-9)
        return gain / best - self.move_cost * (way_to(belief, views) / MAX_MOVE)

    def gain(self, belief: Belief, views: Tensor) -> Tensor:
        """What a view tells of the voxels that its rays meet before they are stopped, on the mean. Shape (B, K)."""
        density, known = belief.memory.density.flatten(1), belief.memory.known.flatten(1)
        row, view = belief.reachable.nonzero(as_tuple=True)
        outward = views[row, view] - belief.target_position[row]
        outward = outward / outward.norm(dim=-1, keepdim=True)
        along = torch.arange(STEPS, device=views.device).flip(0) * CELL_SIZE
        told = torch.zeros(len(row), device=views.device)
        for offset in _region().to(views):
            points = offset + outward[:, None] * along[:, None]
            voxel = (points / CELL_SIZE + GRID_CELLS / 2).floor().long()
            is_inside = ((voxel >= 0) & (voxel < GRID_CELLS)).all(dim=-1)
            x, y, z = voxel.clamp(0, GRID_CELLS - 1).unbind(-1)
            index = (x * GRID_CELLS + y) * GRID_CELLS + z
            is_known = known[row[:, None], index]
            occupied = 1.0 - torch.exp(-density[row[:, None], index] * CELL_SIZE)
            # Nothing is known of an unknown voxel, whatever foliage there is elsewhere.
            chance = torch.where(is_known, occupied, 0.5)
            news = _entropy(chance) if self._criterion == "entropy" else (~is_known).float()
            free = (1.0 - occupied[:, :-1]).cumprod(dim=1)
            reached = torch.cat([torch.ones_like(free[:, :1]), free], dim=1)
            told += (reached * news * is_inside).sum(dim=1) / RAYS
        gain = torch.zeros(views.shape[:2], device=views.device)
        gain[row, view] = told
        return gain


def _entropy(chance: Tensor) -> Tensor:
    """Of a voxel that is occupied with a chance, in [bit]."""
    chance = chance.clamp(1e-6, 1.0 - 1e-6)
    nats: Tensor = -(chance * chance.log() + (1.0 - chance) * (1.0 - chance).log())
    return nats / math.log(2.0)


def _region() -> Tensor:
    """The target's centre and the corners of a tetrahedron round it, as offsets in [m]. Shape (RAYS, 3)."""
    corners = torch.tensor([[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]])
    return torch.cat([torch.zeros(1, 3), corners * (REGION / math.sqrt(3.0))])


def coverage(context: PolicyContext) -> GreedyCriterion:
    """Looks at as much unknown space round the target as it can."""
    return GreedyCriterion("coverage", 0.1)


def entropy(context: PolicyContext) -> GreedyCriterion:
    """Looks where the map is least certain."""
    return GreedyCriterion("entropy", 0.1)
