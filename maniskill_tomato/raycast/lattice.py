"""Fixed points of the unit square that stand for equal areas."""

import math

import numpy as np
from numpy.typing import NDArray


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
