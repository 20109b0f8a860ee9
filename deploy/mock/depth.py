"""What a D435 makes of exact depths: noise that grows with the square, whole millimetres, nothing nearby."""

import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.robot.d435 import depth_noise_std
from maniskill_tomato.visibility.view_rays import DEPTH_MODE, NEAREST_DEPTH

CORRELATION = 2
"""Neighbouring pixels err together in squares of this size, in [px]: stereo matching compares windows."""


def measured_depth(exact: NDArray[np.float32], noise: float, rng: np.random.Generator) -> NDArray[np.float32]:
    """The depth image of the D435's 424 x 240 mode, seen from the colour camera.

    Args:
        exact: True depths, in [m], 0 for none. Shape (H, W).
        noise: Standard deviation in multiples of `depth_noise_std`; 0 gives exact depths, not rounded, with nothing
            left out but what is too near.
        rng: Draws the errors.

    Returns:
        In [m], 0 for none. Shape (H, W).
    """
    depth = exact.astype(np.float64)
    if noise > 0.0:
        rows, columns = depth.shape
        coarse = rng.standard_normal((-(-rows // CORRELATION), -(-columns // CORRELATION)))
        errors = coarse.repeat(CORRELATION, axis=0).repeat(CORRELATION, axis=1)[:rows, :columns]
        depth = depth + noise * depth_noise_std(depth, DEPTH_MODE) * errors
        depth = np.round(depth, 3)
    valid = (exact > 0.0) & (depth >= NEAREST_DEPTH)
    return np.where(valid, depth, 0.0).astype(np.float32)
