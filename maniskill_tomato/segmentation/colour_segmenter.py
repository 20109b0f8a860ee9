"""A segmenter without weights: ripe fruits by their colour, apart by watershed, near by their depth."""

import cv2
import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.segmentation.instances import FRUIT_CATEGORIES, Image, Instances, check_image

RIPE_HUES = ((0, 14), (168, 180))
"""Hues of red and orange fruit, as OpenCV counts them: half degrees."""


class ColourSegmenter:
    """A `Segmenter` for ripe fruits: green ones look like leaves to it.

    Red pixels (hue, saturation, value) are cleaned, split where the distance to their edge has separate summits
    (watershed), and, with depth, where it jumps. The score is the overlap with the ellipse of the same moments: a fruit
    in full view is close to one.
    """

    def __init__(
        self,
        least_saturation: int = 110,
        least_value: int = 45,
        smallest_area: int = 60,
        summit: float = 0.6,
        farthest_m: float = 3.0,
        depth_jump_m: float = 0.03,
    ) -> None:
        """Sets the thresholds.

        Args:
            least_saturation: Of a fruit's pixel, of 255.
            least_value: Of a fruit's pixel, of 255.
            smallest_area: Of a fruit, in [px].
            summit: Share of a summit's distance above which its surroundings are one fruit's seed.
            farthest_m: Pixels farther than this are left out, in [m].
            depth_jump_m: Neighbouring pixels whose depths differ by more are on different things, in [m].

        Raises:
            InvalidInputError: A threshold cannot be used.
        """
        if not 0 < summit < 1:
            raise InvalidInputError(f"summit must be between 0 and 1, got {summit}")
        if smallest_area < 1 or farthest_m <= 0 or depth_jump_m <= 0:
            raise InvalidInputError("smallest_area, farthest_m and depth_jump_m must be positive")
        self.least_saturation = least_saturation
        self.least_value = least_value
        self.smallest_area = smallest_area
        self.summit = summit
        self.farthest_m = farthest_m
        self.depth_jump_m = depth_jump_m

    def __call__(self, image: Image, depth_m: NDArray[np.float32] | None = None) -> Instances:
        """The ripe fruits in an image; see `Segmenter`."""
        check_image(image, depth_m)
        red = self._red(image)
        if depth_m is not None:
            known = np.isfinite(depth_m) & (depth_m > 0)
            red &= ~(known & (depth_m > self.farthest_m))
            red &= ~self._jumps(np.where(known, depth_m, 0).astype(np.float32), known)
        masks = split_by_watershed(red, self.summit)
        masks = masks[masks.sum(axis=(1, 2)) >= self.smallest_area]
        scores = np.array([ellipse_likeness(mask) for mask in masks], np.float32)
        return Instances.from_masks(masks, scores, (FRUIT_CATEGORIES[0],) * len(masks))

    def _red(self, image: Image) -> NDArray[np.bool_]:
        """Pixels of a ripe fruit's colour, without specks. Shape (H, W)."""
        hsv = cv2.cvtColor(cv2.GaussianBlur(image, (3, 3), 0), cv2.COLOR_RGB2HSV)
        hue, saturation, value = (hsv[..., i] for i in range(3))
        red = np.zeros(hue.shape, bool)
        for low, high in RIPE_HUES:
            red |= (hue >= low) & (hue <= high)
        red &= (saturation >= self.least_saturation) & (value >= self.least_value)
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3))
        opened = cv2.morphologyEx(red.astype(np.uint8), cv2.MORPH_OPEN, kernel)
        closed: NDArray[np.bool_] = cv2.morphologyEx(opened, cv2.MORPH_CLOSE, kernel).astype(bool)
        return closed

    def _jumps(self, depth_m: NDArray[np.float32], known: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Pixels on the near side of nothing: where a neighbour is nearer by more than the jump. Shape (H, W)."""
        filled = np.where(known, depth_m, np.float32(1e3))
        nearest = cv2.erode(filled, np.ones((3, 3), np.uint8))
        return np.asarray(known & (depth_m - nearest > self.depth_jump_m))


def split_by_watershed(pixels: NDArray[np.bool_], summit: float = 0.6) -> NDArray[np.bool_]:
    """Separates things that touch, each around a summit of the distance to the edge.

    Args:
        pixels: Pixels of all of them. Shape (H, W).
        summit: Share of a summit's distance above which its surroundings are one thing's seed.

    Returns:
        Masks of shape (N, H, W).
    """
    count, parts = cv2.connectedComponents(pixels.astype(np.uint8))
    distance = np.asarray(cv2.distanceTransform(pixels.astype(np.uint8), cv2.DIST_L2, 5), np.float32)
    seeds = np.zeros(pixels.shape, np.int32)
    number = 0
    for part in range(1, count):
        inside = parts == part
        core = (inside & (distance >= summit * distance[inside].max())).astype(np.uint8)
        cores, labels = cv2.connectedComponents(core)
        seeds[labels > 0] = labels[labels > 0] + number
        number += cores - 1
    labels = _flooded(seeds, distance)
    return np.array([labels == k for k in range(1, number + 1)], bool).reshape(-1, *pixels.shape)


def _flooded(seeds: NDArray[np.int32], distance: NDArray[np.float32]) -> NDArray[np.int32]:
    """Seeds grown downhill over the distance to the edge, a pixel a level, until they meet (Vincent and Soille, 1991).

    Args:
        seeds: Number of the seed at each pixel, 0 elsewhere. Shape (H, W).
        distance: Distance to the edge in [px], 0 outside. Shape (H, W).
    """
    labels = seeds.astype(np.float32)
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    for level in range(int(distance.max()), -1, -1):
        region = distance > level
        for _ in range(2 if level else distance.size):
            grown = np.asarray(cv2.dilate(labels, cross), np.float32)
            new = region & (labels == 0) & (grown > 0)
            if not new.any():
                break
            labels[new] = grown[new]
    return labels.astype(np.int32)


def ellipse_likeness(mask: NDArray[np.bool_]) -> float:
    """Intersection over union of a mask and the ellipse of the same centre and second moments, 0 to 1."""
    y, x = np.nonzero(mask)
    if len(x) < 6:
        return 0.0
    points = np.stack([x, y]).astype(np.float64)
    centre = points.mean(axis=1)
    # Each pixel is a square, whose own second moment is 1/12.
    spread = np.cov(points) + np.eye(2) / 12
    rows, columns = np.indices(mask.shape)
    away = np.stack([columns - centre[0], rows - centre[1]])
    inside = np.einsum("ihw,ij,jhw->hw", away, np.linalg.inv(spread), away) <= 4
    return float((mask & inside).sum() / (mask | inside).sum())
