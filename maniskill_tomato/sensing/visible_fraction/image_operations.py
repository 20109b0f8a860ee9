"""Operations on images of which the thesis's occlusion model (4-2-4) consists.

Binary images are uint8, 0 or 255, as OpenCV takes them; shapes are (height, width) unless said otherwise.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.segmentation.masks import BinaryMask
from maniskill_tomato.sensing.visible_fraction.estimate import Float64, UInt8

Contour = NDArray[np.int32]
Ellipse = tuple[tuple[float, float], tuple[float, float], float]


def combine_masks(masks: Sequence[BinaryMask], shape: tuple[int, int]) -> UInt8:
    """All tomatoes in one binary image, I_tom_masks."""
    combined = np.zeros(shape, dtype=np.uint8)
    for mask in masks:
        combined[mask] = 255
    return combined


def leaf_image(rgb: UInt8, threshold: int) -> UInt8:
    """Leaves, I_leaves: where green exceeds red by more than `threshold` of 255."""
    difference = cv2.subtract(rgb[..., 1], rgb[..., 0])
    return np.asarray((difference > threshold).astype(np.uint8) * 255)


def inpaint(rgb: UInt8, leaves: UInt8, radius: float) -> UInt8:
    """The image with its leaves painted over from their surroundings, I_inpaint (Telea 2004). Shape (H, W, 3)."""
    return np.asarray(cv2.inpaint(rgb, leaves, radius, cv2.INPAINT_TELEA), dtype=np.uint8)


def red_image(rgb: UInt8) -> UInt8:
    """I_bin: where red exceeds green."""
    return np.asarray((rgb[..., 0] > rgb[..., 1]).astype(np.uint8) * 255)


def clean(binary: UInt8, erosion: int, dilation: int) -> UInt8:
    """Erodes noise away, dilates to fill holes, and erodes back.

    Args:
        binary: What to clean.
        erosion: Width of the first kernel, in [px].
        dilation: Width of the second, in [px]; the last erosion takes back what it added beyond the first.
    """
    small, large = _disc(erosion), _disc(dilation)
    grown = cv2.dilate(cv2.erode(binary, small), large)
    return np.asarray(cv2.erode(grown, _disc(max(dilation - erosion + 1, 1))), dtype=np.uint8)


def _disc(width: int) -> UInt8:
    return np.asarray(
        cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (max(width, 1), max(width, 1))), dtype=np.uint8
    )


def remove_deeper(binary: UInt8, depth_m: Float64, limit_m: Float64 | float) -> UInt8:
    """Takes pixels away that lie deeper than a limit; those without a measurement stay.

    Args:
        binary: What to filter.
        depth_m: In [m], 0 where there is no measurement.
        limit_m: One depth, or one for each pixel, in [m].
    """
    return np.asarray(np.where(depth_m > limit_m, 0, binary), dtype=np.uint8)


def outlines(binary: UInt8, smallest: float) -> list[Contour]:
    """The outer contours of at least an area in [px]. Each of shape (N, 1, 2)."""
    found, _ = cv2.findContours(binary, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return [np.asarray(c, dtype=np.int32) for c in found if cv2.contourArea(c) >= smallest]


def fit_ellipse(contour: Contour) -> Ellipse | None:
    """The least-squares ellipse of a contour (Fitzgibbon et al. 1999); None if there is no sensible one."""
    if len(contour) < 6:
        return None
    (x, y), (a, b), turn = cv2.fitEllipseDirect(contour)
    ellipse: Ellipse = (float(x), float(y)), (float(a), float(b)), float(turn)
    if not np.isfinite([x, y, a, b]).all() or min(a, b) < 2 or max(a, b) > 10 * min(a, b):
        return None
    return ellipse


def fill_ellipse(ellipse: Ellipse, shape: tuple[int, int]) -> UInt8:
    """An ellipse's inside as a binary image."""
    image = np.zeros(shape, dtype=np.uint8)
    cv2.ellipse(image, ellipse, 255, cv2.FILLED)
    return image
