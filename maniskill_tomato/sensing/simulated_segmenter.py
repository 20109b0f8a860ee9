"""Masks with the light segmenter's errors, made from perfect ones: what training by the thousand sees with.

Hidden and small fruits are missed, and their pixels then mostly go to a neighbour's mask; edges are ragged; ripeness is
mistaken; leaves are taken for fruits. All rates are measured on rendered views (`tools/segmenter_errors.py`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.segmentation.instances import Instances
from maniskill_tomato.segmentation.masks import BinaryMask
from maniskill_tomato.sensing.posed_frame import PosedFrame
from maniskill_tomato.sensing.visible_fraction.sphere import silhouette_pixels

KINDS: Final = ("tomato_ripe", "tomato_turning", "tomato_unripe")
"""Order of the categories in all tables."""

MEASURED_WIDTH: Final = 640
"""Width of the pictures that the rates were measured in, in [px]; sizes in pixels count there."""

GRID: Final = 8
"""Distance between the places whose shifts make edges ragged, in [px]."""

FEWEST_PIXELS: Final = 4
"""Smaller masks are no detections, in [px]."""

FARTHEST_FALSE: Final = 1.0
"""Leaves that are farther away are not taken for fruits, in [m]."""


@dataclass(frozen=True, kw_only=True)
class SegmenterErrors:
    """How often each error is made and how large it is."""

    detection: tuple[float, float, float] = (-5.21, 5.7, 0.72)
    """Log-odds of being found: at V_f = 0 and one pixel, what V_f adds, what the logarithm of the visible pixels
    adds."""
    merged_share: float = 0.74
    """Share of the missed fruits beside a found one whose pixels the mask of that one takes in."""
    edge_shift: float = 1.25
    """Standard deviation of the shifts of edges at the places of a grid, in [px]."""
    score: tuple[float, float, float] = (0.38, 0.42, 0.1)
    """Score of a fruit at V_f = 0, what V_f adds, and its standard deviation."""
    least_score: float = 0.3
    """No score is lower: what would have one is missed."""
    confusion: tuple[tuple[float, float, float], ...] = field(
        default=((1.0, 0.0, 0.0), (0.115, 0.874, 0.012), (0.0, 0.164, 0.836))
    )
    """Share of the found fruits of each kind (rows) that are taken for each (columns), in the order of `KINDS`."""
    false_rate: float = 0.15
    """False detections in a picture."""
    false_pixels: tuple[float, float] = (268.0, 1.14)
    """Median of their pixels, and the standard deviation of the logarithm."""
    false_kinds: tuple[float, float, float] = (0.42, 0.17, 0.42)
    """Shares of them by kind, in the order of `KINDS`."""

    def __post_init__(self) -> None:
        shares = (self.merged_share, *self.false_kinds, *(share for row in self.confusion for share in row))
        if not all(0.0 <= share <= 1.0 for share in shares):
            raise InvalidInputError(f"shares of errors must be from 0 to 1, got {shares}")
        if min(self.edge_shift, self.false_rate, self.score[2], *self.false_pixels) < 0.0:
            raise InvalidInputError(
                "edge_shift, false_rate, false_pixels and the spread of scores must not be negative"
            )


def simulated_masks(
    frame: PosedFrame,
    centres_w: Mapping[int, NDArray[np.float64]],
    radii: Mapping[int, float],
    rng: Generator,
    errors: SegmenterErrors | None = None,
) -> Instances:
    """What the light segmenter might have found in a picture.

    Args:
        frame: With the true fruits.
        centres_w: Their centres by their numbers in `PosedFrame.true_numbers`, world frame, in [m]. Each of shape (3,).
        radii: Their radii, in [m].
        rng: From which all errors follow.
        errors: How many; the measured ones if None.

    Raises:
        InvalidInputError: The frame does not tell its fruits.
    """
    e = errors or SegmenterErrors()
    if frame.true_fruits is None:
        raise InvalidInputError("errors are made of true masks; the frame has none")
    height, width = frame.depth_m.shape
    scale = width / MEASURED_WIDTH
    labels = np.full((height, width), -1, np.int16)
    for index, mask in enumerate(frame.true_fruits.masks):
        labels[mask] = index
    wholes = [silhouette_of(frame, centres_w[number], radii[number]) for number in frame.true_numbers]
    seen = np.array([np.count_nonzero(mask) for mask in frame.true_fruits.masks], np.float64)
    fractions = np.minimum(seen / np.array(wholes), 1.0) if len(seen) else seen
    at_zero, by_fraction, by_size = e.detection
    odds = at_zero + by_fraction * fractions + by_size * np.log(np.maximum(seen / scale**2, 1.0))
    found = rng.random(len(seen)) < 1.0 / (1.0 + np.exp(-odds))
    labels = _ragged(labels, e.edge_shift * scale, rng)
    _merge(labels, found, e.merged_share, rng)
    masks: list[BinaryMask] = []
    scores: list[float] = []
    kinds: list[str] = []
    for index in np.flatnonzero(found).tolist():
        score = e.score[0] + e.score[1] * fractions[index] + e.score[2] * rng.standard_normal()
        kind = rng.choice(3, p=_shares(e.confusion[KINDS.index(frame.true_fruits.categories[index])]))
        masks.append(labels == index)
        scores.append(float(np.clip(score, e.least_score, 1.0)))
        kinds.append(KINDS[kind])
    plant = (labels < 0) & (frame.measured_m > 0.0) & (frame.measured_m < FARTHEST_FALSE)
    if frame.robot_mask is not None:
        plant &= ~frame.robot_mask
    places = np.flatnonzero(plant)
    for _ in range(rng.poisson(e.false_rate) if len(places) else 0):
        row, column = divmod(int(rng.choice(places)), width)
        area = e.false_pixels[0] * np.exp(e.false_pixels[1] * rng.standard_normal()) * scale**2
        y, x = np.ogrid[:height, :width]
        masks.append(plant & ((y - row) ** 2 + (x - column) ** 2 <= area / np.pi))
        scores.append(e.least_score + e.score[2] * abs(rng.standard_normal()))
        kinds.append(KINDS[rng.choice(3, p=_shares(e.false_kinds))])
    large = [k for k, mask in enumerate(masks) if np.count_nonzero(mask) >= FEWEST_PIXELS]
    return Instances.from_masks(
        np.array([masks[k] for k in large], np.bool_).reshape(-1, height, width),
        np.array([scores[k] for k in large], np.float32),
        tuple(kinds[k] for k in large),
    )


def silhouette_of(frame: PosedFrame, centre_w: NDArray[np.float64], radius: float) -> float:
    """Pixels of a whole fruit in a picture, in it or outside.

    Args:
        frame: The picture.
        centre_w: The fruit's centre, world frame, in [m]. Shape (3,).
        radius: In [m].
    """
    pose = frame.T_world_camera
    return silhouette_pixels(
        pose[:3, :3].T @ (centre_w - pose[:3, 3]), radius, frame.intrinsics, up=pose[2, :3]
    )


def _ragged(labels: NDArray[np.int16], shift: float, rng: Generator) -> NDArray[np.int16]:
    """Labels read beside their places, by shifts that change from place to place. Shape (H, W)."""
    if shift <= 0.0:
        return labels
    height, width = labels.shape
    step = max(GRID * width / MEASURED_WIDTH, 1.0)
    coarse = rng.standard_normal((2, int(height / step) + 2, int(width / step) + 2)).astype(np.float32)
    across, down = (cv2.resize(plane, (width, height), interpolation=cv2.INTER_CUBIC) for plane in coarse)
    x = np.arange(width, dtype=np.float32)[None] + np.float32(shift) * across
    y = np.arange(height, dtype=np.float32)[:, None] + np.float32(shift) * down
    read = cv2.remap(labels, x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(read, np.int16)


def _merge(labels: NDArray[np.int16], found: NDArray[np.bool_], share: float, rng: Generator) -> None:
    """Gives the pixels of missed fruits to the found one that touches them most, or takes them away, in place."""
    for index in np.flatnonzero(~found).tolist():
        mask = labels == index
        left, top, width, height = cv2.boundingRect(mask.view(np.uint8))
        if not width:
            continue
        window = (slice(max(top - 2, 0), top + height + 2), slice(max(left - 2, 0), left + width + 2))
        around = labels[window]
        ring = cv2.dilate(mask[window].view(np.uint8), np.ones((5, 5), np.uint8)) > 0
        beside = around[ring]
        beside = beside[(beside >= 0) & (beside != index)]
        beside = beside[found[beside]]
        taken = bool(len(beside)) and rng.random() < share
        labels[mask] = np.bincount(beside).argmax() if taken else -1


def _shares(row: Sequence[float]) -> NDArray[np.float64]:
    shares = np.asarray(row, np.float64)
    return np.asarray(shares / shares.sum())


COLOURS: Final[Mapping[str, tuple[int, int, int]]] = {
    "tomato_ripe": (160, 33, 25),
    "tomato_turning": (144, 108, 45),
    "tomato_unripe": (95, 116, 57),
}
"""Mean colours of fruits in rendered pictures: red, green, blue."""

FOLIAGE: Final = (78, 115, 60)
"""The same of what is no fruit."""


def flat_colours(frame: PosedFrame) -> NDArray[np.uint8]:
    """A picture in which everything has the mean colour of its kind, by which ripeness can be told.

    Args:
        frame: With the true fruits.

    Returns:
        Shape (H, W, 3).
    """
    rgb = np.empty((*frame.depth_m.shape, 3), np.uint8)
    rgb[:] = FOLIAGE
    if frame.true_fruits is not None:
        for mask, category in zip(frame.true_fruits.masks, frame.true_fruits.categories, strict=True):
            rgb[mask] = COLOURS[category]
    return rgb
