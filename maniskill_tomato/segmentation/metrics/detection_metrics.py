"""Precision, recall and average precision of a segmenter (Eq. 4-1 to 4-3 of the thesis).

A detection is true if its intersection over union with a fruit reaches a threshold; detections choose in order of their
scores, each the fruit that it overlaps most among those still free. A fruit that is set aside (`ignored`) counts
neither as found nor as missed, and a detection of which the threshold's share lies on it is not counted: this is how
COCO treats crowds.
"""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.segmentation.datasets.annotations import (
    BEHIND,
    SMALLEST_SHARE,
    AnnotatedImage,
    ignored_fruit,
)
from maniskill_tomato.segmentation.instances import Instances

Overlap = Literal["box", "mask"]


@dataclass(frozen=True, kw_only=True)
class ImageTruth:
    """The annotated fruits of an image."""

    boxes: NDArray[np.float64]
    """Left, top, right, bottom in [px]. Shape (N, 4)."""
    ignored: NDArray[np.bool_]
    """Those set aside. Shape (N,)."""
    masks: NDArray[np.bool_] | None = None
    """Visible pixels; None where only boxes are annotated. Shape (N, H, W)."""
    least_side: float = 0.0
    """Width of a box below which fruits are ignored or not even annotated, in [px]."""


def image_truth(
    image: AnnotatedImage, smallest_share: float = SMALLEST_SHARE, rows_behind: bool = True
) -> ImageTruth:
    """The visible fruits of an annotated image, ripe or not; see `ignored_fruit` for those set aside.

    Args:
        image: Whose fruits.
        smallest_share: What stands for `SMALLEST_SHARE`.
        rows_behind: Whether fruits of the rows behind a rendered row count, or are set aside too.
    """
    longer = max(image.width, image.height)
    fruits = image.fruits
    boxes = np.array([f.box_xywh for f in fruits], np.float64).reshape(-1, 4)
    boxes[:, 2:] += boxes[:, :2]
    masks = [f.visible_mask.decode() for f in fruits if f.visible_mask is not None]
    return ImageTruth(
        boxes=boxes,
        ignored=np.array(
            [
                ignored_fruit(f, longer, smallest_share)
                or (not rows_behind and (f.name or "").startswith(BEHIND))
                for f in fruits
            ],
            bool,
        ),
        masks=np.array(masks, bool).reshape(-1, image.height, image.width)
        if len(masks) == len(fruits)
        else None,
        # Whoever annotates by hand leaves no size out.
        least_side=smallest_share * longer if any(f.visible_fraction is not None for f in fruits) else 0.0,
    )


def without_narrow(found: Instances, truth: ImageTruth, threshold: float = 0.5) -> Instances:
    """The detections without those that are too narrow and overlap no fruit that counts.

    A renderer's image shows fruits too small to be annotated at all. COCO treats detections outside a range of areas in
    the same way.

    Args:
        found: Detections in an image.
        truth: The fruits in it.
        threshold: Least intersection over union with a fruit of a narrow detection that stays.
    """
    sides = (found.boxes[:, 2:] - found.boxes[:, :2]).min(axis=1, initial=np.inf)
    overlaps, _ = box_overlaps(found.boxes.astype(np.float64), truth.boxes[~truth.ignored])
    return found.chosen((sides >= truth.least_side) | (overlaps.max(axis=1, initial=0) >= threshold))


@dataclass(frozen=True, kw_only=True)
class PrecisionRecall:
    """Precision and recall as the score threshold falls."""

    scores: NDArray[np.float64]
    """Scores of the counted detections, falling. Shape (D,)."""
    precision: NDArray[np.float64]
    """TP / (TP + FP) with the detections down to each (Eq. 4-1). Shape (D,)."""
    recall: NDArray[np.float64]
    """TP / (TP + FN) with the detections down to each (Eq. 4-2). Shape (D,)."""
    fruits: int
    """Fruits that were to be found: TP + FN."""

    @property
    def average_precision(self) -> float:
        """Area under the interpolated curve (Eq. 4-3): each rise of recall times the best precision from there on.

        NaN if there was no fruit to find.
        """
        if self.fruits == 0:
            return float("nan")
        envelope = np.maximum.accumulate(self.precision[::-1])[::-1]
        return float(np.sum(np.diff(self.recall, prepend=0.0) * envelope))

    def at_score(self, threshold: float) -> tuple[float, float]:
        """Precision and recall of the detections with at least this score; precision is NaN without one."""
        count = int((self.scores >= threshold).sum())
        if count == 0:
            return float("nan"), 0.0 if self.fruits else float("nan")
        return float(self.precision[count - 1]), float(self.recall[count - 1])


@dataclass
class DetectionScore:
    """Collects the detections of many images; see `precision_recall`."""

    overlap: Overlap = "box"
    """What overlaps are measured on."""
    threshold: float = 0.5
    """Least intersection over union of a true detection."""
    fruits: int = 0
    """Fruits to be found so far."""
    _scores: list[NDArray[np.float64]] = field(default_factory=list)
    _true: list[NDArray[np.bool_]] = field(default_factory=list)

    def __post_init__(self) -> None:
        if not 0 < self.threshold <= 1:
            raise InvalidInputError(f"threshold must be above 0 and at most 1, got {self.threshold}")

    def add(self, found: Instances, truth: ImageTruth) -> None:
        """Counts one image.

        Raises:
            InvalidInputError: Masks are asked for, but the image has boxes only.
        """
        overlaps, shares = self._overlaps(found, truth)
        true, counted = match(found.scores, overlaps, shares, truth.ignored, self.threshold)
        self._scores.append(found.scores[counted].astype(np.float64))
        self._true.append(true[counted])
        self.fruits += int((~truth.ignored).sum())

    def precision_recall(self) -> PrecisionRecall:
        """The curve over all images so far."""
        scores = np.concatenate([np.zeros(0), *self._scores])
        true = np.concatenate([np.zeros(0, bool), *self._true])
        order = np.argsort(-scores, kind="stable")
        hits = np.cumsum(true[order])
        return PrecisionRecall(
            scores=scores[order],
            precision=hits / np.arange(1, len(hits) + 1),
            recall=hits / max(self.fruits, 1),
            fruits=self.fruits,
        )

    def _overlaps(
        self, found: Instances, truth: ImageTruth
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Intersection over union, and over the detection alone. Each of shape (D, N)."""
        if self.overlap == "box":
            return box_overlaps(found.boxes.astype(np.float64), truth.boxes)
        if truth.masks is None:
            raise InvalidInputError("masks are compared, but an image has only boxes; compare boxes there")
        return mask_overlaps(found.masks, truth.masks)


def match(
    scores: NDArray[np.floating],
    overlaps: NDArray[np.float64],
    shares: NDArray[np.float64],
    ignored: NDArray[np.bool_],
    threshold: float,
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which detections of an image are true, and which count.

    Args:
        scores: Of the detections. Shape (D,).
        overlaps: Intersection over union of each with each fruit. Shape (D, N).
        shares: Share of each detection that lies on each fruit. Shape (D, N).
        ignored: Fruits that are set aside. Shape (N,).
        threshold: Least overlap of a true detection.

    Returns:
        Two arrays of shape (D,).
    """
    true, counted = np.zeros(len(scores), bool), np.ones(len(scores), bool)
    free = ~ignored
    for detection in np.argsort(-scores, kind="stable"):
        candidates = np.where(free, overlaps[detection], -1.0)
        best = int(candidates.argmax()) if len(candidates) else -1
        if best >= 0 and candidates[best] >= threshold:
            true[detection], free[best] = True, False
        elif (shares[detection][ignored] >= threshold).any():
            counted[detection] = False
    return true, counted


def box_overlaps(
    a: NDArray[np.float64], b: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Intersection over union, and over the area of `a`, of boxes (left, top, right, bottom). Each of shape (A, B)."""
    lower = np.maximum(a[:, None, :2], b[None, :, :2])
    upper = np.minimum(a[:, None, 2:], b[None, :, 2:])
    shared = np.clip(upper - lower, 0, None).prod(axis=2)
    area_a, area_b = ((c[:, 2:] - c[:, :2]).prod(axis=1) for c in (a, b))
    return _ratios(shared, area_a[:, None], area_b[None])


def mask_overlaps(
    a: NDArray[np.bool_], b: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The same of masks of shape (A, H, W) and (B, H, W)."""
    flat_a, flat_b = (c.reshape(len(c), int(np.prod(c.shape[1:]))).astype(np.float32) for c in (a, b))
    shared = (flat_a @ flat_b.T).astype(np.float64)
    areas = [c.sum(axis=1, dtype=np.float64) for c in (flat_a, flat_b)]
    return _ratios(shared, areas[0][:, None], areas[1][None])


def _ratios(
    shared: NDArray[np.float64], area_a: NDArray[np.float64], area_b: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    return shared / np.maximum(area_a + area_b - shared, 1e-9), shared / np.maximum(area_a, 1e-9)
