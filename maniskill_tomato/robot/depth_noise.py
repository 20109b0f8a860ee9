"""What a D435 makes of a true depth image: stereo noise, holes, smeared edges.

The image is the depth aligned to the colour stream, as `rs.align` gives it. Seen from the colour camera, both infrared
imagers sit to the right, 15 and 65 mm away; a point is measured only if both see it.
"""

from dataclasses import dataclass, replace
from typing import Final

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from maniskill_tomato.robot.d435 import (
    STEREO_BASELINE,
    SUBPIXEL_RMS,
    CameraIntrinsics,
    T_color_optical_depth_optical,
    depth_intrinsics,
    min_depth,
)

Float64 = NDArray[np.float64]

COLOR_TO_DEPTH: Final = float(T_color_optical_depth_optical[0, 3])
"""How far right of the colour camera the left infrared imager sits, in [m]."""

DISPARITY_STEP: Final = 1 / 32
"""Resolution of a disparity, in [px]."""


@dataclass(frozen=True, kw_only=True)
class DepthNoise:
    """How strong each fault is."""

    subpixel_rms: float = SUBPIXEL_RMS
    """RMS error of a disparity, in [px] of the depth stream; 0.08 typical, 0.032 at best."""
    correlation_px: float = 1.6
    """Standard deviation of the kernel that smooths the errors: neighbours share their matching window."""
    flying_share: float = 0.5
    """Share of the pixels at an edge of depth that get a value between its two sides."""
    edge_step_m: float = 0.02
    """Difference between neighbours that counts as an edge, in [m]."""
    hole_share: float = 0.01
    """Share of the image that is lost in blobs, where nothing matches."""
    max_depth_m: float = 6.0
    """Beyond it nothing is measured, in [m]."""

    def times(self, factor: float) -> "DepthNoise":
        """Errors, flying pixels and holes so many times as strong; shares end at 1."""
        return replace(
            self,
            subpixel_rms=factor * self.subpixel_rms,
            flying_share=min(1.0, factor * self.flying_share),
            hole_share=min(1.0, factor * self.hole_share),
        )


def measure_depth(
    depth_m: Float64,
    intrinsics: CameraIntrinsics,
    noise: DepthNoise,
    rng: Generator,
    *,
    stereo: CameraIntrinsics | None = None,
) -> Float64:
    """A measurement of a true depth image.

    Args:
        depth_m: True depths along the optical axis of the colour camera, in [m]; infinite or 0 where nothing is. Shape
            (height, width).
        intrinsics: The colour camera's.
        noise: The strength of the faults.
        rng: Their random numbers.
        stereo: The depth stream's mode, 848 x 480 if None; a smaller one measures nearer and less finely.

    Returns:
        Depths in [m], whole millimetres, 0 where there is no measurement. Shape (height, width).
    """
    valid = np.isfinite(depth_m) & (depth_m > 0)
    true = np.where(valid, depth_m, noise.max_depth_m * 2)
    stereo = stereo or depth_intrinsics()
    scale = stereo.fx * STEREO_BASELINE
    z = _smeared(true, noise, rng)
    error = rng.standard_normal(z.shape)
    if noise.correlation_px > 0:
        error = cv2.GaussianBlur(error, (0, 0), noise.correlation_px)
        error *= 2 * np.sqrt(np.pi) * noise.correlation_px  # The smoothed noise has unit variance again.
    disparity = scale / z + noise.subpixel_rms * error
    disparity = np.round(disparity / DISPARITY_STEP) * DISPARITY_STEP
    measured = scale / np.maximum(disparity, 1e-6)
    seen = _seen_from(true, intrinsics.fx * COLOR_TO_DEPTH) & _seen_from(
        true, intrinsics.fx * (COLOR_TO_DEPTH + STEREO_BASELINE)
    )
    ok = valid & seen & (true >= min_depth(stereo)) & (measured <= noise.max_depth_m)
    ok &= _inside_both(true, intrinsics, stereo)
    if noise.hole_share > 0:
        blobs = cv2.GaussianBlur(rng.standard_normal(z.shape), (0, 0), 4.0)
        ok &= blobs < np.quantile(blobs, 1 - noise.hole_share)
    return np.asarray(np.where(ok, np.round(measured * 1000) / 1000, 0.0))


def _seen_from(z: Float64, shift: float) -> NDArray[np.bool_]:
    """Whether a camera to the right sees each pixel's point.

    Args:
        z: Depths, in [m]. Shape (height, width).
        shift: Focal length times the distance to that camera, in [px m].
    """
    # A point moves left by shift / z; one that a nearer point right of it reaches or passes is hidden.
    column = np.arange(z.shape[1])[None] - shift / z
    later = np.minimum.accumulate(column[:, ::-1], axis=1)[:, ::-1]
    hidden = np.zeros(z.shape, dtype=bool)
    hidden[:, :-1] = column[:, :-1] > later[:, 1:] + 0.5
    return ~hidden


def _inside_both(z: Float64, color: CameraIntrinsics, stereo: CameraIntrinsics) -> NDArray[np.bool_]:
    """Whether each pixel's point lies in the pictures of both infrared imagers; at the left edge it does not."""
    x = (np.arange(color.width) + 0.5 - color.cx)[None] / color.fx * z
    inside = np.ones(z.shape, dtype=bool)
    for offset in (COLOR_TO_DEPTH, COLOR_TO_DEPTH + STEREO_BASELINE):
        u = stereo.fx * (x - offset) / z + stereo.cx
        inside &= (u >= 0) & (u < stereo.width)
    return inside


def _smeared(z: Float64, noise: DepthNoise, rng: Generator) -> Float64:
    """Flying pixels: beside an edge of depth, some values lie between its two sides."""
    kernel = np.ones((3, 3), np.uint8)
    low, high = cv2.erode(z, kernel), cv2.dilate(z, kernel)
    edge = (high - low > noise.edge_step_m) & (rng.random(z.shape) < noise.flying_share)
    # The window that is matched holds both sides, so that the nearer one spreads.
    weight = rng.random(z.shape) ** 2
    return np.asarray(np.where(edge, low + weight * (np.minimum(high, low + 0.6) - low), z))
