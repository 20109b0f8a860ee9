"""Anchors from the boxes of the data: k-means with 1 - IoU as the distance (Redmon and Farhadi, 2017, YOLO9000)."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.segmentation.datasets.annotations import AnnotatedImage, ignored_fruit
from maniskill_tomato.segmentation.detector_configs import MaskRcnnConfig

Sizes = NDArray[np.float64]

ROUNDS = 300
"""After as many rounds the clusters are taken as they are."""


def clustered_sizes(sizes: NDArray[np.floating[Any]], count: int) -> Sizes:
    """Widths and heights that stand for many boxes, from the smallest area to the largest.

    The clusters begin at quantiles of the area, so that the same boxes always give the same answer.

    Args:
        sizes: Widths and heights. Shape (N, 2).
        count: How many clusters.

    Returns:
        The mean width and height of each cluster. Shape (count, 2).

    Raises:
        InvalidInputError: There are fewer different sizes than clusters.
    """
    sizes = np.asarray(sizes, np.float64).reshape(-1, 2)
    if len(np.unique(sizes, axis=0)) < count:
        raise InvalidInputError(f"{count} anchors need at least {count} boxes of different sizes")
    by_area = np.unique(sizes, axis=0)
    by_area = by_area[np.argsort(by_area.prod(axis=1), kind="stable")]
    centres = by_area[np.linspace(0, len(by_area) - 1, 2 * count + 1).round().astype(int)[1::2]]
    own = np.full(len(sizes), -1)
    for _ in range(ROUNDS):
        nearest = shape_overlaps(sizes, centres).argmax(axis=1)
        if (nearest == own).all():
            break
        own = nearest
        # A cluster that has lost its boxes stays where it was.
        centres = np.stack(
            [sizes[own == k].mean(axis=0) if (own == k).any() else centres[k] for k in range(count)]
        )
    found: Sizes = centres[np.argsort(centres.prod(axis=1), kind="stable")]
    return found


def shape_overlaps(sizes: Sizes, others: Sizes) -> Sizes:
    """Intersection over union of boxes laid on one corner. Shapes (N, 2) and (M, 2) to (N, M)."""
    both = np.minimum(sizes[:, None], others[None]).prod(axis=-1)
    whole = sizes.prod(axis=1)[:, None] + others.prod(axis=1)[None] - both
    overlaps: Sizes = both / whole
    return overlaps


def anchor_sides(images: Iterable[AnnotatedImage], config: MaskRcnnConfig) -> tuple[int, ...]:
    """Sides of anchors for Mask R-CNN as the fruits of a data set ask for: the roots of five clusters' areas.

    Args:
        images: What is trained on; fruits that are set aside (`ignored_fruit`) do not count.
        config: Says to which size images are brought.

    Returns:
        In [px] of the network's input, one for each level of the pyramid, from the smallest.

    Raises:
        InvalidInputError: There are too few fruits, or two sides are alike.
    """
    sizes = []
    for image in images:
        longer, shorter = max(image.width, image.height), min(image.width, image.height)
        scale = min(config.shortest_side / shorter, config.longest_side / longer)
        sizes += [
            (scale * fruit.box_xywh[2], scale * fruit.box_xywh[3])
            for fruit in image.fruits
            if not ignored_fruit(fruit, longer)
        ]
    centres = clustered_sizes(np.array(sizes, np.float64), len(config.anchor_sides))
    sides = tuple(round(float(side)) for side in np.sqrt(centres.prod(axis=1)))
    if len(set(sides)) < len(sides):
        raise InvalidInputError(
            f"the fruits are too alike for anchors of their own: {sides} px; use the preset's"
        )
    return sides
