"""V_f from whole boxes that a segmenter learned to see, without depth.

A tomato is close to a spheroid, so that its silhouette is the ellipse in the box of the whole fruit.
"""

import math
from collections.abc import Sequence

import numpy as np

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.segmentation.instances import box_ellipse
from maniskill_tomato.segmentation.metrics.detection_metrics import mask_overlaps
from maniskill_tomato.segmentation.segmenter import Segmenter, make_segmenter
from maniskill_tomato.sensing.visible_fraction.estimate import Estimate, SegmentedImage

LEAST_OVERLAP = 0.3
"""Intersection over union of a given mask with that of a found fruit from which on they are the same fruit."""


class AmodalModel:
    """The given masks for V, and the ellipse in the whole box of the fruit that the segmenter finds there for T."""

    def __init__(self, segmenter: Segmenter | None = None) -> None:
        """Takes a segmenter that tells whole boxes; by default the one that ships, with a low threshold."""
        self.segmenter = segmenter or make_segmenter("light", score_threshold=0.1)

    def __call__(self, view: SegmentedImage) -> Sequence[Estimate]:
        """V and T of every mask; no estimate where the segmenter finds no fruit.

        Raises:
            InvalidInputError: The segmenter tells no whole boxes.
        """
        found = self.segmenter(view.rgb, view.depth_m.astype(np.float32))
        if found.amodal_boxes is None:
            raise InvalidInputError(
                "this segmenter tells no whole boxes; take one that was trained on rendered images"
            )
        height, width = view.rgb.shape[:2]
        given = np.array(view.masks, bool).reshape(-1, height, width)
        estimates = []
        for mask, overlaps in zip(view.masks, mask_overlaps(given, found.masks), strict=True):
            best = int(overlaps.argmax()) if len(found) else -1
            if best < 0 or overlaps[best] < LEAST_OVERLAP:
                estimates.append(Estimate.failed())
                continue
            box = found.amodal_boxes[best]
            inside = box_ellipse(box, height, width)
            ellipse = math.pi / 4 * float((box[2:] - box[:2]).prod())
            estimates.append(
                Estimate(
                    visible=float(mask.sum()),
                    # What is visible beyond the ellipse belongs to the fruit too.
                    total=ellipse + float((mask & ~inside).sum()),
                    whole=inside | mask,
                )
            )
        return estimates
