"""The thesis's own proposals (6-2) on its occlusion model.

Each tomato is handled in a window of its own, with kernels from its size in pixels; only leaves in front of it count;
touching tomatoes are separated by a watershed from their masks.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.segmentation.masks import BinaryMask
from maniskill_tomato.sensing.visible_fraction import image_operations as operations
from maniskill_tomato.sensing.visible_fraction.crop import USUAL_RADIUS
from maniskill_tomato.sensing.visible_fraction.estimate import (
    Estimate,
    Float64,
    SegmentedImage,
    UInt8,
    filled_depth,
    fruit_depth,
)
from maniskill_tomato.sensing.visible_fraction.separation import Separation, check_separation, separated


@dataclass(frozen=True, kw_only=True)
class ImprovedConfig:
    """Sizes relative to the tomato's own, in place of pixels."""

    diameter_m: float = 2 * USUAL_RADIUS
    """Diameter of a tomato, in [m]; with its depth it gives the size in pixels that all kernels follow."""
    kernel_share: float = 0.5
    """Width of the kernel that bridges occluders over that size."""
    margin: float = 0.75
    """The window reaches so many diameters beyond the mask."""
    behind_share: float = 0.5
    """How far behind the tomato's own depth a pixel is background, in diameters."""
    separation: Separation = "watershed"
    """What tells touching tomatoes apart."""

    def __post_init__(self) -> None:
        check_separation(self.separation)
        for name in ("diameter_m", "kernel_share", "margin", "behind_share"):
            if not getattr(self, name) > 0:
                raise InvalidInputError(f"{name} must be positive, got {getattr(self, name)}")


class ImprovedModel:
    """The thesis's chain with kernels by size, occluders by depth and a watershed."""

    def __init__(self, config: ImprovedConfig | None = None) -> None:
        """Keeps the constants."""
        self.config = config or ImprovedConfig()

    def __call__(self, view: SegmentedImage) -> list[Estimate]:
        """Estimates V and T of every mask; one without depth has failed."""
        depth = filled_depth(view.depth_m)
        return [self._one(view, depth, k) for k in range(len(view.masks))]

    def _one(self, view: SegmentedImage, depth: Float64, k: int) -> Estimate:
        c, mask = self.config, view.masks[k]
        own = fruit_depth(view.depth_m, mask)
        if not np.isfinite(own):
            return Estimate.failed()
        size = c.diameter_m * view.intrinsics.fx / own
        rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
        reach = int(np.ceil(c.margin * size))
        window = (
            slice(max(rows[0] - reach, 0), rows[-1] + reach + 1),
            slice(max(columns[0] - reach, 0), columns[-1] + reach + 1),
        )
        here, z = mask[window], depth[window]
        others = [m[window] for j, m in enumerate(view.masks) if j != k and m[window].any()]
        in_front = (z > 0) & (z < own + 0.1 * c.diameter_m) & ~here
        allowed = here | in_front
        grown = self._bridged(here, allowed, size)
        beside = cv2.dilate(grown, np.ones((3, 3), np.uint8)) > 0
        touching = [other for other in others if (other & beside).any()]
        if touching:
            region = np.any([grown > 0, *touching], axis=0)
            told = separated(c.separation, region, [here, *touching])
            grown = np.asarray(((told == 0) | here).astype(np.uint8) * 255)
        pieces = operations.outlines(grown, 1.0)
        if not pieces:
            return Estimate.failed()
        ellipse = operations.fit_ellipse(np.asarray(cv2.convexHull(np.concatenate(pieces)), np.int32))
        inside = operations.fill_ellipse(ellipse, here.shape) if ellipse is not None else grown
        inside = operations.remove_deeper(inside, z, own + c.behind_share * c.diameter_m)
        for other in others:
            # A touching tomato is not part of this one unless it is the nearer of the two.
            theirs = fruit_depth(depth[window], other)
            if not theirs < own:
                inside[other] = 0
        whole = np.zeros(mask.shape, dtype=bool)
        whole[window] = (inside > 0) | here
        return Estimate(visible=int(np.count_nonzero(mask)), total=int(np.count_nonzero(whole)), whole=whole)

    def _bridged(self, here: BinaryMask, allowed: BinaryMask, size: float) -> UInt8:
        width = max(3, round(self.config.kernel_share * size) | 1)
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (width, width))
        padded = cv2.copyMakeBorder(
            here.astype(np.uint8) * 255, width, width, width, width, cv2.BORDER_CONSTANT
        )
        closed = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, kernel)[width:-width, width:-width]
        return np.asarray(np.where(allowed, closed, 0), dtype=np.uint8)
