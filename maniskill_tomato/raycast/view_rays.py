"""What a view tells about the surroundings of its target: a pattern of rays with labels and distances.

The rays cross the plane through the target's centre, perpendicular to the line from the camera to it, in a square
of +-0.28 m, most of them near the middle. Their order is row by row from the upper left, where right and up are those
of `robot.look_at.look_frame`: the pattern does not turn with the camera about its optical axis.

`RayScene.view_rays` casts them, `sensing.view_pattern.sample_view` reads them from a depth image and masks, which is
what a robot has. Neither knows more than a D435 could say: outside the image, nearer than its stereo
matching reaches, or where the robot stands in the way, a ray has no answer.
"""

from dataclasses import dataclass
from enum import IntEnum
from typing import Final

import numpy as np
import numpy.typing as npt
from torch import Tensor

from maniskill_tomato.robot.d435 import depth_intrinsics

RAYS_PER_SIDE: Final = 16
"""The pattern has this number of rays squared."""

PATTERN_HALF_WIDTH: Final = 0.28
"""The pattern's square on the plane through the target reaches this far from its centre, in [m]."""

RANGE: Final = 1.5
"""What lies farther than this along a ray counts as nothing, in [m]."""

DEPTH_MODE: Final = depth_intrinsics(424, 240)
"""The D435's smallest depth mode, which measures nearest: leaves close to the camera matter more than fine detail."""

NEAREST_DEPTH: Final = 0.1
"""Depth below which that mode measures nothing, in [m]: 84 mm by `d435.min_depth`, and a sixth more, as the data sheet
has it in the other modes (195 mm for the formula's 168 at 848 x 480)."""


class RayLabel(IntEnum):
    """What a ray met."""

    OUTSIDE = 0
    """No answer: outside the image, no valid depth, or the robot itself."""
    FREE = 1
    """Nothing within `RANGE`."""
    TARGET = 2
    """The target fruit."""
    OTHER = 3
    """A leaf, a stem or another fruit."""


@dataclass(frozen=True, eq=False)
class ViewRays:
    """The answers of B views along N rays each."""

    direction_c: Tensor
    """Unit directions in the optical frame. Shape (B, N, 3)."""
    distance: Tensor
    """Distance along the ray, in [m]: 0 where OUTSIDE, `RANGE` where FREE. Shape (B, N)."""
    label: Tensor
    """Values of `RayLabel`. Shape (B, N), int8."""


def ray_pattern() -> npt.NDArray[np.float32]:
    """Where the rays cross the plane through the target: to the right and up from its centre, in [m].

    With u evenly spaced in (-1, 1), a coordinate is 0.28 m times u / 4 + 3 u^3 / 4: near the middle neighbours are
    9 mm apart, so that a dozen rays meet a whole tomato, at the edge 69 mm.

    Returns:
        Row by row from the upper left. Shape (N, 2).
    """
    u = (np.arange(RAYS_PER_SIDE) + 0.5) / RAYS_PER_SIDE * 2.0 - 1.0
    coordinate = PATTERN_HALF_WIDTH * (0.25 * u + 0.75 * u**3)
    right, down = np.meshgrid(coordinate, coordinate)
    return np.stack([right.ravel(), -down.ravel()], axis=-1).astype(np.float32)
