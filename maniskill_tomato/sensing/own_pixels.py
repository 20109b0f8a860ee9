"""Which pixels of a segmenter's mask are the fruit's own: those at the depth of one surface.

A mask spills over to a neighbour, nearer or farther, and where it does the fruit seems fuller, larger or elsewhere than
it is. The depth of a fruit's visible surface spans no more than a radius.
"""

from typing import Final

import cv2
import numpy as np

from maniskill_tomato.segmentation.masks import BinaryMask
from maniskill_tomato.sensing.visible_fraction.estimate import (
    LEAST_MEASURED_SHARE,
    Float64,
)

SURFACE_SPAN: Final = 1.2
"""Depths of one fruit's surface differ by less than so many radii, noise included."""

SMALLEST_PATCH: Final = 3
"""Strips thinner than this stay: masks and depth disagree by a pixel or two at edges, in [px]."""


def own_pixels(masks: tuple[BinaryMask, ...], depth_m: Float64, radius_m: float) -> tuple[BinaryMask, ...]:
    """The pixels of each mask that lie at the depth of most of it, and those that have none.

    A leaf's stereo shadow falls on the fruit behind it: where nothing was measured, the depth beside it says nothing.

    Args:
        masks: A segmenter's. Each of shape (H, W).
        depth_m: In [m], 0 where there is no measurement. Shape (H, W).
        radius_m: Of a large fruit, in [m].

    Returns:
        As many masks; one of which too little is measured is left as it is. Each of shape (H, W).
    """
    kept = []
    for mask in masks:
        left, top, width, height = cv2.boundingRect(mask.view(np.uint8))
        # A margin, so that the edge of the window is no edge of the mask.
        window = (
            slice(max(top - SMALLEST_PATCH, 0), top + height + SMALLEST_PATCH),
            slice(max(left - SMALLEST_PATCH, 0), left + width + SMALLEST_PATCH),
        )
        own = mask.copy()
        own[window] = _own(mask[window], depth_m[window], SURFACE_SPAN * radius_m)
        kept.append(own)
    return tuple(kept)


def _own(mask: BinaryMask, depth_m: Float64, span: float) -> BinaryMask:
    values = np.sort(depth_m[mask])
    values = values[values > 0]
    if not len(values) or len(values) < LEAST_MEASURED_SHARE * np.count_nonzero(mask):
        return mask
    ends = values if values[-1] - values[0] > span else values[:1]
    held = np.searchsorted(values, ends + span, side="right") - np.arange(len(ends))
    near = float(ends[int(np.argmax(held))])
    others = mask & (depth_m > 0) & ((depth_m < near) | (depth_m > near + span))
    patch = np.ones((SMALLEST_PATCH, SMALLEST_PATCH), np.uint8)
    own: BinaryMask = mask & (cv2.morphologyEx(others.view(np.uint8), cv2.MORPH_OPEN, patch) == 0)
    return own
