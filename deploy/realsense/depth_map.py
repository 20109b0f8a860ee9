"""Converts aligned depth counts to metres along the colour camera's axis."""

import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.deploy.interface import Float64
from maniskill_tomato.robot.d435 import CameraIntrinsics


class DepthMap:
    """The SDK's alignment moves pixels but leaves their values, which are distances along the depth camera's axis."""

    def __init__(self, color: CameraIntrinsics, T_color_depth: Float64, depth_units: float) -> None:
        """Computes each pixel's scale once.

        Args:
            color: Of the colour camera, to which depth is aligned.
            T_color_depth: From the depth camera's optical frame to the colour camera's. Shape (4, 4).
            depth_units: Metres that one count stands for.
        """
        ones = np.ones((color.height, color.width, 1))
        focal, centre = np.array([color.fx, color.fy]), np.array([color.cx, color.cy])
        rays = np.concatenate([(color.pixel_centres() - centre) / focal, ones], axis=-1)
        depth_axis = T_color_depth[:3, 2]
        # A point z ray lies at z (ray . axis) - t . axis along the depth camera's axis.
        self._scale = (1.0 / (rays @ depth_axis)).astype(np.float32)
        self._offset = np.float32(T_color_depth[:3, 3] @ depth_axis)
        self._units = np.float32(depth_units)

    def __call__(self, aligned: NDArray[np.uint16]) -> NDArray[np.float32]:
        """Depth seen from the colour camera, in [m], 0 where there is none.

        Args:
            aligned: Counts, as the SDK aligned them. Shape (H, W).

        Returns:
            Shape (H, W).
        """
        depth = (aligned * self._units + self._offset) * self._scale
        return np.where(aligned > 0, depth, np.float32(0.0)).astype(np.float32)
