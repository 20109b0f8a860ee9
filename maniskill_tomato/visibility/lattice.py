"""Fixed points of the unit square that stand for equal areas."""

import math

import numpy as np
from numpy.typing import NDArray


def ray_lattice(per_side: int) -> NDArray[np.float32]:
    """A lattice with one point in each of `per_side`^2 equal strips along either axis.

    Rows and columns of a plain grid fall on a straight edge of a leaf or of the image all at once, and the
    covered share jumps; here no two points share a coordinate.

    Returns:
        Coordinates in (0, 1), row by row. Shape (per_side^2, 2).
    """
    count = per_side**2
    index = np.arange(count)
    y = (index + 0.5) / count
    x = np.mod(index * (math.sqrt(5) - 1) / 2 + 0.5 / count, 1.0)
    return np.stack([x, y], axis=1).astype(np.float32)
