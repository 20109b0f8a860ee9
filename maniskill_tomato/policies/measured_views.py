"""What views like a candidate have shown: V_f that was measured, by how alike the views are."""

import math
from typing import Final

import torch
from torch import Tensor

from maniskill_tomato.sensing.belief import Belief

SIMILAR_ANGLE: Final = math.radians(8.0)
"""Views within about this angle, seen from the target, show the same, in [rad]."""

SIMILAR_DISTANCE: Final = 0.1
"""And within about this difference of distance, in [m]."""


def most_similar(belief: Belief, views: Tensor) -> tuple[Tensor, Tensor]:
    """The view taken so far that is most like each candidate.

    Args:
        belief: Its memory knows the views.
        views: Positions of the candidates, in the world frame, in [m]. Shape (B, K, 3).

    Returns:
        How alike they are, from 0 to 1, and V_f that was measured there, 0 where nothing was. Shapes (B, K).
    """
    memory, target = belief.memory, belief.target_position
    most = max(int(memory.visits.clamp_max(memory.visited.shape[1]).max()), 1)
    offsets, taken = views - target[:, None], memory.visited[:, :most] - target[:, None]
    seen = memory.fractions[:, :most]
    distance, taken_distance = offsets.norm(dim=-1), taken.norm(dim=-1)
    cosine = (offsets @ taken.mT) / (distance[:, :, None] * taken_distance[:, None]).clamp_min(1e-9)
    angle = torch.acos(cosine.clamp(-1.0, 1.0)) / SIMILAR_ANGLE
    nearer = (distance[:, :, None] - taken_distance[:, None]) / SIMILAR_DISTANCE
    # A missing view is NaN, as is what was not measured.
    similar = torch.exp(-0.5 * (angle.square() + nearer.square())).where(seen[:, None].isfinite(), 0.0)
    weight, which = similar.nan_to_num(0.0).max(dim=-1)
    return weight, seen.gather(1, which).nan_to_num(0.0)
