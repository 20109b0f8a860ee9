"""Precision, recall and average precision of a segmenter (Eq. 4-1 to 4-3 of the thesis), and COCO's own figures.

pycocotools decides which detections are true: those whose intersection over union with a fruit reaches a threshold.
Detections choose in order of their scores, each the fruit that it overlaps most among those still free. A fruit that
is set aside (`ignored`) counts neither as found nor as missed, and a detection of which the threshold's share lies on
it is not counted: this is how COCO treats crowds.
"""

import contextlib
import io
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from maniskill_tomato.errors import InvalidInputError, MissingPackageError
from maniskill_tomato.segmentation.datasets.annotations import (
    BEHIND,
    SMALLEST_SHARE,
    AnnotatedImage,
    ignored_fruit,
)
from maniskill_tomato.segmentation.instances import Instances
from maniskill_tomato.segmentation.masks import EncodedMask

Overlap = Literal["box", "mask"]

COCO_SIZES = ("small", "medium", "large")
"""COCO's sizes: areas below 32 x 32 px, up to 96 x 96 px, and above."""

COCO_NAMES = (
    *("AP", "AP50", "AP75", *(f"AP_{size}" for size in COCO_SIZES)),
    *("AR1", "AR10", "AR100", *(f"AR_{size}" for size in COCO_SIZES)),
)
"""What COCO reports: mean AP over overlaps 0.5 to 0.95 (AP50-95), AP at 0.5, at 0.75, and AP50-95 by size; mean recall
over the same overlaps with 1, 10 and 100 detections an image, and with 100 by size."""

COCO_OVERLAPS = tuple(round(0.5 + 0.05 * step, 2) for step in range(10))
"""Least intersections over union of a found fruit that COCO averages over."""

COCO_LIMITS = (1, 10, 100, 100_000)
"""Detections an image that count: COCO's own for its figures, and all of them for the curve."""


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
    image: AnnotatedImage,
    smallest_share: float = SMALLEST_SHARE,
    rows_behind: bool = True,
    category: str | None = None,
) -> ImageTruth:
    """The visible fruits of an annotated image, ripe or not; see `ignored_fruit` for those set aside.

    Args:
        image: Whose fruits.
        smallest_share: What stands for `SMALLEST_SHARE`.
        rows_behind: Whether fruits of the rows behind a rendered row count, or are set aside too.
        category: Things of this category, such as `leaf`, instead of fruits.
    """
    longer = max(image.width, image.height)
    fruits = image.fruits if category is None else image.named(category)
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
    from torchvision.ops import box_iou  # Not needed by those who import this module for its masks.

    sides = (found.boxes[:, 2:] - found.boxes[:, :2]).min(axis=1, initial=np.inf)
    fruits = torch.from_numpy(truth.boxes[~truth.ignored])
    overlaps = box_iou(torch.from_numpy(found.boxes).double(), fruits).numpy()
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


class DetectionScore:
    """Collects the detections of many images as one category; masks are kept encoded.

    Attributes:
        fruits: Fruits to be found so far.
    """

    def __init__(self, overlap: Overlap = "box") -> None:
        """Begins without images.

        Args:
            overlap: Whether boxes or masks are compared.
        """
        self.fruits = 0
        self._overlap = overlap
        self._images: list[dict[str, Any]] = []
        self._truths: list[dict[str, Any]] = []
        self._detections: list[dict[str, Any]] = []
        self._judged: Any = None

    def add(self, found: Instances, truth: ImageTruth) -> None:
        """Counts one image.

        Raises:
            InvalidInputError: Masks are asked for, but the image has boxes only.
        """
        if self._overlap == "mask" and truth.masks is None:
            raise InvalidInputError("masks are compared, but an image has only boxes; compare boxes there")
        self._judged = None
        self.fruits += int((~truth.ignored).sum())
        number = len(self._images) + 1
        height, width = found.masks.shape[1:]
        self._images.append({"id": number, "height": height, "width": width})
        for index, ignored in enumerate(truth.ignored.tolist()):
            entry = self._entry(
                number, truth.boxes[index], None if truth.masks is None else truth.masks[index]
            )
            self._truths.append(entry | {"id": len(self._truths) + 1, "iscrowd": int(ignored)})
        for box, mask, score in zip(found.boxes, found.masks, found.scores.tolist(), strict=True):
            self._detections.append(self._entry(number, box, mask) | {"score": score})

    def precision_recall(self) -> PrecisionRecall:
        """The curve over all images so far, at an overlap of 0.5.

        Raises:
            MissingPackageError: pycocotools is not installed.
        """
        scores, true = [np.zeros(0)], [np.zeros(0, bool)]
        if self._detections:
            # The first entries are those of things of any size, and the first row that of the least overlap, 0.5.
            for image in self._evaluated().evalImgs[: len(self._images)]:
                if image is not None:
                    counted = image["dtIgnore"][0] == 0
                    scores.append(np.array(image["dtScores"])[counted])
                    true.append(image["dtMatches"][0][counted] > 0)
        falling = np.argsort(-np.concatenate(scores), kind="stable")
        hits = np.cumsum(np.concatenate(true)[falling])
        return PrecisionRecall(
            scores=np.concatenate(scores)[falling],
            precision=hits / np.arange(1, len(hits) + 1),
            recall=hits / max(self.fruits, 1),
            fruits=self.fruits,
        )

    def coco_metrics(self) -> dict[str, float]:
        """COCO's own figures by their names in `COCO_NAMES`; -1 where there was nothing to find.

        Raises:
            MissingPackageError: pycocotools is not installed.
        """
        if not self._detections:
            return dict.fromkeys(COCO_NAMES, 0.0 if self._truths else -1.0)
        judged = self._evaluated()
        with contextlib.redirect_stdout(io.StringIO()):
            judged.accumulate()
            judged.summarize()
        return {name: float(value) for name, value in zip(COCO_NAMES, judged.stats, strict=False)}

    def precision_by_overlap(self) -> dict[str, NDArray[np.float64]]:
        """COCO's AP at each of `COCO_OVERLAPS`, of all fruits and of each size that occurs; it falls with loose boxes.

        Raises:
            MissingPackageError: pycocotools is not installed.
        """
        if not self._detections:
            return {"all": np.zeros(len(COCO_OVERLAPS))} if self.fruits else {}
        judged = self._evaluated()
        with contextlib.redirect_stdout(io.StringIO()):
            judged.accumulate()
        # Overlap, recall, category, size, limit on detections.
        precision = judged.eval["precision"][:, :, 0, :, COCO_LIMITS.index(100)].mean(axis=1)
        found = dict(zip(("all", *COCO_SIZES), precision.T, strict=True))
        return {name: values for name, values in found.items() if values[0] >= 0}

    def _entry(self, image: int, box: NDArray[Any], mask: NDArray[np.bool_] | None) -> dict[str, Any]:
        entry: dict[str, Any] = {"image_id": image, "category_id": 1}
        if self._overlap == "mask" and mask is not None:
            encoded = EncodedMask.encode(mask)
            return entry | {"segmentation": encoded.to_coco(), "area": encoded.area}
        left, top, right, bottom = box.tolist()
        sides = right - left, bottom - top
        return entry | {"bbox": [left, top, *sides], "area": sides[0] * sides[1]}

    def _evaluated(self) -> Any:
        """COCO's evaluation, with every detection matched."""
        if self._judged is not None:
            return self._judged
        try:
            from pycocotools.coco import COCO
            from pycocotools.cocoeval import COCOeval
        except ImportError as error:
            raise MissingPackageError.extra("pycocotools", "perception") from error
        with contextlib.redirect_stdout(io.StringIO()):  # pycocotools prints.
            truths: Any = COCO()
            truths.dataset = {
                "images": self._images,
                "annotations": self._truths,
                "categories": [{"id": 1, "name": "tomato"}],
            }
            truths.createIndex()
            judged = COCOeval(
                truths, truths.loadRes(self._detections), "bbox" if self._overlap == "box" else "segm"
            )
            judged.params.maxDets = list(COCO_LIMITS)
            judged.evaluate()
        self._judged = judged
        return judged


def mask_overlaps(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Intersection over union of masks of shape (A, H, W) and (B, H, W). Shape (A, B)."""
    flat_a, flat_b = (c.reshape(len(c), int(np.prod(c.shape[1:]))).astype(np.float32) for c in (a, b))
    shared = (flat_a @ flat_b.T).astype(np.float64)
    area_a, area_b = (c.sum(axis=1, dtype=np.float64) for c in (flat_a, flat_b))
    return np.asarray(shared / np.maximum(area_a[:, None] + area_b[None] - shared, 1e-9))
