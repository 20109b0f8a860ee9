"""Depth in whole millimetres, as cameras, viewers and data sets have it."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

FARTHEST_MM: Final = 65535
"""What 16 bits hold; depth beyond is 0 there, as if there were none, in [mm]."""


def in_millimetres(depth: NDArray[np.float32]) -> tuple[NDArray[np.uint16], bool]:
    """Depth in 16 bits, and whether nothing is lost by it.

    Args:
        depth: In [m], 0 where there is none. Shape (H, W).

    Returns:
        In whole [mm], shape (H, W); and whether that is the very same depth.
    """
    rounded = np.round(depth.astype(np.float64) * 1000.0)
    rounded[~((rounded >= 0.0) & (rounded <= FARTHEST_MM))] = 0.0
    whole = rounded.astype(np.uint16)
    return whole, bool(np.array_equal((whole / 1000.0).astype(np.float32), depth))
