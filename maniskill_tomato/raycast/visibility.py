"""How much of a target fruit a camera sees: V_f = V / T (Eq. 4-4 of the thesis).

T is the area of the target's whole silhouette in the image plane with nothing in front, also outside the
image. V is the part of it inside the image that no leaf, stem, other fruit or robot link hides. The camera
looks along the z axis of its optical frame, x points right and y down.

The target counts as not visible (V = 0) where its bounding sphere lies behind the camera's near plane or
holds the camera. It has no silhouette then, and T is that of such a sphere straight ahead.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Visibility:
    """What the camera of each environment sees of its target."""

    rows: Tensor
    """The answers below, one row each, float32. Shape (4, B)."""

    @property
    def visible_fraction(self) -> Tensor:
        """V_f = V / T (Eq. 4-4), in [0, 1]. Shape (B,)."""
        return self.rows[0]

    @property
    def visible(self) -> Tensor:
        """V: visible area of the target, in [px] of the configured camera. Shape (B,)."""
        return self.rows[1]

    @property
    def total(self) -> Tensor:
        """T: area of the target's whole silhouette, in [px] of the configured camera. Shape (B,)."""
        return self.rows[2]

    @property
    def any_visible(self) -> Tensor:
        """Whether the target or another ripe fruit of the plant is seen by any ray, bool. Shape (B,)."""
        return self.rows[3] > 0.5


def ray_lattice(per_side: int) -> NDArray[np.float32]:
    """A lattice that puts one point into each of `per_side`^2 equal strips.

    Rows and columns of a plain grid fall on a straight edge of a leaf or of the image all at once, and the
    covered share jumps; here no two points share a coordinate. Neighbours stand near each other in the order
    (a Z curve), because rays that take the same way through a mesh find it in the cache.

    Returns:
        Coordinates in (0, 1). Shape (per_side^2, 2).
    """
    count = per_side**2
    index = np.arange(count)
    y = (index + 0.5) / count
    x = np.mod(index * (math.sqrt(5) - 1) / 2 + 0.5 / count, 1.0)
    points = np.stack([x, y], axis=1)
    column, row = (points * 256).astype(np.int64).T
    along_curve = np.zeros(count, dtype=np.int64)
    for bit in range(8):
        along_curve |= ((column >> bit & 1) << 2 * bit) | ((row >> bit & 1) << 2 * bit + 1)
    return points[np.argsort(along_curve, kind="stable")].astype(np.float32)
