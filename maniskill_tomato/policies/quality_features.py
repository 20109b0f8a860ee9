"""What the view-quality network sees: the memory's answers as maps over the candidate directions."""

from typing import Final

import torch
from torch import Tensor

from maniskill_tomato.policies.lattice_planner import distance_to_taken, way_to
from maniskill_tomato.policies.measured_views import most_similar
from maniskill_tomato.robot.look_at_move import MAX_MOVE
from maniskill_tomato.sensing.belief import Belief
from maniskill_tomato.sensing.observation import WORKSPACE_HALF_SIZE, WORKSPACE_MIDDLE
from maniskill_tomato.sensing.view_lattice import AZIMUTHS, DISTANCES, ELEVATIONS

FEATURES: Final = ("expected", "unknown", "looked_from", "reachable", "moves", "measured", "alike")
"""Of every candidate: the visible share that the memory expects, the unknown share of the way, how near a view was
already taken, whether the arm reaches it, the moves that the straight way takes, by 10, V_f that was measured in the
most similar view, times how alike they are, and that itself."""

MAP_CHANNELS: Final = len(FEATURES) * DISTANCES
SCALARS: Final = 9
"""V_f, distance to the target, direction from it (3), target in the base frame (3), share of the moves left."""

SAME_VIEW: Final = 0.06
"""Cameras this far apart see much the same, in [m]."""


def quality_features(belief: Belief, max_moves: int = 20) -> tuple[Tensor, Tensor]:
    """The network's input.

    Args:
        belief: What is known.
        max_moves: Moves of an episode.

    Returns:
        Maps of shape (B, 28, 13, 9), the distances of each feature side by side, and scalars of shape (B, 9).
    """
    position, target = belief.camera_position, belief.target_position
    candidates = belief.lattice.positions(target)
    expected, unknown = belief.memory.predict(candidates).unbind(-1)
    looked_from = torch.exp(-(distance_to_taken(belief, candidates) / SAME_VIEW).square())
    moves = way_to(belief, candidates) / (10.0 * MAX_MOVE)
    alike, measured = most_similar(belief, candidates)
    reachable = belief.reachable.float()
    values = torch.stack([expected, unknown, looked_from, reachable, moves, alike * measured, alike], dim=1)
    batch = len(position)
    maps = values.view(batch, len(FEATURES), AZIMUTHS, ELEVATIONS, DISTANCES).permute(0, 1, 4, 2, 3)
    offset = position - target
    distance = offset.norm(dim=-1, keepdim=True)
    middle, half_size = target.new_tensor(WORKSPACE_MIDDLE), target.new_tensor(WORKSPACE_HALF_SIZE)
    scalars = torch.cat(
        [
            belief.visible_fraction[:, None].to(distance),
            distance,
            offset / distance.clamp_min(1e-6),
            (target - middle) / half_size,
            belief.moves_left[:, None].to(distance) / max_moves,
        ],
        dim=1,
    )
    return maps.reshape(batch, MAP_CHANNELS, AZIMUTHS, ELEVATIONS), scalars
