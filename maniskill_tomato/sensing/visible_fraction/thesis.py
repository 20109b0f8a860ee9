"""The thesis's occlusion model: the ten steps of 4-2-4, with constants for all images."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.segmentation.masks import BinaryMask
from maniskill_tomato.sensing.visible_fraction import image_operations as operations
from maniskill_tomato.sensing.visible_fraction.estimate import (
    Estimate,
    SegmentedImage,
    UInt8,
    filled_depth,
    fruit_depth,
)
from maniskill_tomato.sensing.visible_fraction.image_operations import Contour, Ellipse
from maniskill_tomato.sensing.visible_fraction.separation import Separation, check_separation, separated


@dataclass(frozen=True, kw_only=True)
class ThesisConfig:
    """The constants; except for the first the thesis does not give them. They are for images 640 pixels wide."""

    leaf_threshold: int = 0
    """By how much green must exceed red for a leaf, of 255. The thesis takes every positive difference. Where the
    background is not exactly grey or the pictures have noise, 10 keeps it from being taken for leaves."""
    inpaint_radius: float = 3.0
    """Neighbourhood that the inpainting draws from, in [px]."""
    erosion: int = 5
    """Kernel that removes noise, in [px]."""
    dilation: int = 9
    """Kernel that fills holes, in [px]."""
    behind_m: float = 0.04
    """How far behind the tomatoes' own depth a pixel is taken for background, in [m]."""
    smallest: float = 60.0
    """Smallest contour, in [px]."""
    separation: Separation | None = None
    """What divides a contour with several tomatoes in it (6-2); None leaves it whole, as section 4-2-4 does."""

    def __post_init__(self) -> None:
        if self.separation is not None:
            check_separation(self.separation)
        if not 0 <= self.leaf_threshold < 255:
            raise InvalidInputError(f"leaf_threshold must be from 0 to 254, got {self.leaf_threshold}")
        for name in ("inpaint_radius", "erosion", "dilation", "behind_m", "smallest"):
            if not getattr(self, name) > 0:
                raise InvalidInputError(f"{name} must be positive, got {getattr(self, name)}")


@dataclass(frozen=True, kw_only=True)
class ThesisSteps:
    """Every image of Fig. 4-28."""

    tomatoes: UInt8
    """(b) I_tom_masks."""
    leaves: UInt8
    """(c) I_leaves."""
    inpainted: UInt8
    """(d) I_inpaint, RGB."""
    binary: UInt8
    """(e) I_bin."""
    contours: tuple[Contour, ...]
    """(f) of I_bin, divided if that is asked for."""
    seen: tuple[BinaryMask, ...]
    """Which visible pixels count for each: those of all tomatoes, or of its own if it was divided."""
    ellipses: tuple[Ellipse, ...]
    """(g) fitted to them."""
    whole: tuple[UInt8, ...]
    """(h) the ellipses without background, one binary image each."""
    fractions: tuple[float, ...]
    """(h) V / T of each."""


class ThesisModel:
    """Inpainting, red minus green, ellipses, depth: works for red tomatoes that do not touch."""

    def __init__(self, config: ThesisConfig | None = None) -> None:
        """Keeps the constants."""
        self.config = config or ThesisConfig()

    def run(self, view: SegmentedImage) -> ThesisSteps:
        """All steps of one image."""
        c = self.config
        shape = view.rgb.shape[:2]
        tomatoes = operations.combine_masks(view.masks, shape)
        leaves = operations.leaf_image(view.rgb, c.leaf_threshold)
        inpainted = operations.inpaint(view.rgb, leaves, c.inpaint_radius)
        binary = operations.clean(operations.red_image(inpainted), c.erosion, c.dilation)
        depths = [d for mask in view.masks if np.isfinite(d := fruit_depth(view.depth_m, mask))]
        farthest = max(depths) + c.behind_m if depths else np.inf
        # A camera's holes lie beside what is near and show what is behind it; the thesis's simulated one had none.
        depth_m = filled_depth(view.depth_m)
        binary = operations.remove_deeper(binary, depth_m, farthest)
        contours, visible, ellipses, whole, fractions = [], [], [], [], []
        for contour, seen in self._divided(operations.outlines(binary, c.smallest), view):
            ellipse = operations.fit_ellipse(contour)
            if ellipse is None:
                continue
            inside = operations.fill_ellipse(ellipse, shape)
            own = fruit_depth(view.depth_m, (inside > 0) & seen)
            if not np.isfinite(own):
                continue
            # Only the largest of the new contours is the tomato; the depth filter leaves crumbs.
            filtered = operations.remove_deeper(inside, depth_m, own + c.behind_m)
            pieces = operations.outlines(filtered, c.smallest)
            if not pieces:
                continue
            new = np.zeros(shape, dtype=np.uint8)
            cv2.drawContours(new, [max(pieces, key=cv2.contourArea)], -1, 255, -1)
            total = int(np.count_nonzero(new))
            contours.append(contour)
            visible.append(seen)
            ellipses.append(ellipse)
            whole.append(new)
            fractions.append(int(np.count_nonzero((new > 0) & seen)) / total)
        return ThesisSteps(
            tomatoes=tomatoes,
            leaves=leaves,
            inpainted=inpainted,
            binary=binary,
            contours=tuple(contours),
            seen=tuple(visible),
            ellipses=tuple(ellipses),
            whole=tuple(whole),
            fractions=tuple(fractions),
        )

    def _divided(
        self, contours: Sequence[Contour], view: SegmentedImage
    ) -> Iterator[tuple[Contour, BinaryMask]]:
        """Each contour with the pixels that count as visible in it; one that holds several tomatoes gives several."""
        how = self.config.separation
        tomatoes = operations.combine_masks(view.masks, view.rgb.shape[:2]) > 0
        for contour in contours:
            left, top, width, height = cv2.boundingRect(contour)
            window = (slice(top, top + height), slice(left, left + width))
            filled = np.zeros((height, width), np.uint8)
            cv2.drawContours(filled, [contour], -1, 255, -1, offset=(-left, -top))
            groups = [(mask, own) for mask in view.masks if (own := mask[window] & (filled > 0)).any()]
            if how is None or len(groups) < 2:
                yield contour, tomatoes
                continue
            told = separated(how, filled > 0, [own for _, own in groups])
            for k, (mask, _) in enumerate(groups):
                part = np.zeros(tomatoes.shape, np.uint8)
                part[window] = (told == k) * 255
                pieces = operations.outlines(part, self.config.smallest)
                if pieces:
                    yield max(pieces, key=cv2.contourArea), mask

    def __call__(self, view: SegmentedImage) -> list[Estimate]:
        """Each mask gets V and T of the contour that holds most of it; masks that no contour holds have failed."""
        result = self.run(view)
        estimates = []
        for mask in view.masks:
            shares = [
                int(np.count_nonzero(whole[mask & seen]))
                for whole, seen in zip(result.whole, result.seen, strict=True)
            ]
            if not shares or max(shares) < 0.25 * np.count_nonzero(mask):
                estimates.append(Estimate.failed())
                continue
            k = int(np.argmax(shares))
            total = int(np.count_nonzero(result.whole[k]))
            estimates.append(
                Estimate(visible=result.fractions[k] * total, total=total, whole=result.whole[k] > 0)
            )
        return estimates
