"""A real camera's picture as a simulated one would have taken it: another size and field of view, the same axis."""

import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.deploy.interface import Frame
from maniskill_tomato.robot.d435 import CameraIntrinsics


def fit_color(frame: Frame, wanted: CameraIntrinsics) -> NDArray[np.uint8]:
    """The colour picture for other intrinsics, averaged where it shrinks; black outside the real picture.

    Args:
        frame: The real picture.
        wanted: Of the simulated camera.

    Returns:
        RGB. Shape (H, W, 3) of `wanted`.
    """
    have = frame.intrinsics
    if have == wanted:
        return frame.color.copy()
    # Sampled so finely that no pixel of the real picture is left out, then averaged.
    finer = max(1, math.ceil(max(have.fx / wanted.fx, have.fy / wanted.fy)))
    large = wanted.scaled(finer * wanted.width, finer * wanted.height)
    picture = _warped(frame.color, have, large, cv2.INTER_LINEAR)
    if finer > 1:
        picture = cv2.resize(picture, (wanted.width, wanted.height), interpolation=cv2.INTER_AREA)
    return np.asarray(picture, dtype=np.uint8)


def fit_depth(frame: Frame, wanted: CameraIntrinsics) -> NDArray[np.float32]:
    """The depth picture for other intrinsics by the nearest pixel; 0 outside the real picture.

    Args:
        frame: The real picture.
        wanted: Of the simulated camera.

    Returns:
        In [m]. Shape (H, W) of `wanted`.
    """
    return np.asarray(_warped(frame.depth, frame.intrinsics, wanted, cv2.INTER_NEAREST), dtype=np.float32)


def depth_in_mm(depth: NDArray[np.float32]) -> NDArray[np.int16]:
    """Depth in whole [mm] as ManiSkill has it; what is beyond 32.767 m counts as no depth. Any shape."""
    millimetres = np.rint(1000.0 * depth)
    return np.where(millimetres <= np.iinfo(np.int16).max, millimetres, 0.0).astype(np.int16)


def _warped(
    picture: NDArray[Any], have: CameraIntrinsics, wanted: CameraIntrinsics, interpolation: int
) -> NDArray[Any]:
    # Both cameras look along the same axis, so that columns and rows are stretched and shifted. OpenCV counts from the
    # centre of the first pixel.
    sx, sy = have.fx / wanted.fx, have.fy / wanted.fy
    matrix = np.array(
        [
            [sx, 0.0, have.cx - 0.5 - sx * (wanted.cx - 0.5)],
            [0.0, sy, have.cy - 0.5 - sy * (wanted.cy - 0.5)],
        ]
    )
    warped = cv2.warpAffine(
        picture, matrix, (wanted.width, wanted.height), flags=interpolation | cv2.WARP_INVERSE_MAP
    )
    result: NDArray[Any] = warped
    return result
