"""Touching tomatoes told apart (6-2): by a watershed, or by a classifier of pixel coordinates."""

from collections.abc import Sequence
from typing import Final, Literal, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.segmentation.masks import BinaryMask
from maniskill_tomato.sensing.visible_fraction.estimate import Float64

Separation = Literal["watershed", "linear", "polynomial"]
"""A watershed, or a classifier of degree 1 or 2."""

MOST_SAMPLES: Final = 400
"""Pixels of a group that a classifier is fitted to; more do not move a border that few numbers describe."""


def check_separation(how: Separation) -> None:
    """Accepts a way to tell tomatoes apart.

    Raises:
        InvalidInputError: There is none of this name.
    """
    if how not in get_args(Separation):
        raise InvalidInputError.choice("separation", how, get_args(Separation))


def separated(how: Separation, region: BinaryMask, groups: Sequence[BinaryMask]) -> NDArray[np.int64]:
    """Which group each pixel of a region belongs to.

    Args:
        how: By what they are told apart.
        region: What is to be divided. Shape (H, W).
        groups: Pixels of the region whose group is known, at least one of each. Each of shape (H, W).

    Returns:
        Index of the group, -1 for none. Shape (H, W).
    """
    if how == "watershed":
        return flooded(region, groups)
    return classified(region, groups, 1 if how == "linear" else 2)


def classified(region: BinaryMask, groups: Sequence[BinaryMask], degree: int) -> NDArray[np.int64]:
    """Which group each pixel of a region belongs to, by a polynomial classifier of the pixels' coordinates.

    One least-squares polynomial for each group is 1 on its pixels and 0 on those of the others, every group weighing
    the same; a pixel whose group is not known belongs to that whose polynomial is largest there. Of two groups and
    degree 1 the border is a straight line.

    Args:
        region: What is to be divided. Shape (H, W).
        groups: Pixels whose group is known, at least one of each. Each of shape (H, W).
        degree: Of the polynomials: 1 is a linear classifier.

    Returns:
        Index of the group, -1 outside the region. Shape (H, W).
    """
    told = np.full(region.shape, -1, np.int64)
    rows, columns = np.nonzero(region)
    if not len(rows):
        return told
    centre = np.array([rows.mean(), columns.mean()])
    scale = max(float(np.ptp(rows)), float(np.ptp(columns)), 1.0) / 2
    features, targets, weights = [], [], []
    for k, group in enumerate(groups):
        pixels = np.argwhere(group)
        pixels = pixels[:: -(-len(pixels) // MOST_SAMPLES)]
        features.append(_powers((pixels - centre) / scale, degree))
        targets.append(np.eye(len(groups))[np.full(len(pixels), k)])
        weights.append(np.full((len(pixels), 1), len(pixels) ** -0.5))
    weight = np.concatenate(weights)
    solution, *_ = np.linalg.lstsq(
        weight * np.concatenate(features), weight * np.concatenate(targets), rcond=None
    )
    here = _powers((np.stack([rows, columns], axis=1) - centre) / scale, degree)
    told[rows, columns] = (here @ solution).argmax(axis=1)
    for k, group in enumerate(groups):
        told[group] = k
    return told


def flooded(region: BinaryMask, groups: Sequence[BinaryMask]) -> NDArray[np.int64]:
    """Which group each pixel of a region belongs to, by a watershed that floods it from the groups; see `separated`.

    The colours have no say: between the groups they are those of what hides the tomatoes.
    """
    # A step round the region keeps the flood inside until it is full; a border takes the ridge that OpenCV leaves.
    surface = np.pad(np.where(region, 0, 255).astype(np.uint8), 1, constant_values=255)
    markers = np.zeros(surface.shape, np.int32)
    for k, group in enumerate(groups):
        markers[1:-1, 1:-1][group] = k + 1
    cv2.watershed(cv2.cvtColor(surface, cv2.COLOR_GRAY2RGB), markers)
    told = markers[1:-1, 1:-1].astype(np.int64) - 1
    return np.where(region & (told >= 0), told, -1)


def _powers(points: Float64, degree: int) -> Float64:
    """All products of the two coordinates up to a degree. Shape (N, 2) to (N, (degree + 1) (degree + 2) / 2)."""
    x, y = points.T
    return np.stack([x**i * y**j for i in range(degree + 1) for j in range(degree + 1 - i)], axis=1)
