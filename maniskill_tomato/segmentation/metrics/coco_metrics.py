"""COCO's average precisions, by its own library."""

import contextlib
import io
from typing import Any

import numpy as np

from maniskill_tomato.errors import InvalidInputError, MissingPackageError
from maniskill_tomato.segmentation.instances import Instances
from maniskill_tomato.segmentation.masks import EncodedMask
from maniskill_tomato.segmentation.metrics.detection_metrics import ImageTruth, Overlap

NAMES = ("AP", "AP50", "AP75", "AP_small", "AP_medium", "AP_large", "AR1", "AR10", "AR100")
"""What COCO reports first: mean AP over overlaps 0.5 to 0.95, at 0.5, at 0.75, by size; mean recall."""


class CocoScore:
    """COCO's metrics of all fruits as one category, image by image; masks are kept encoded."""

    def __init__(self, overlap: Overlap = "box") -> None:
        """Begins without images.

        Args:
            overlap: Whether boxes or masks are compared.
        """
        self._overlap = overlap
        self._images: list[dict[str, Any]] = []
        self._truths: list[dict[str, Any]] = []
        self._detections: list[dict[str, Any]] = []

    def add(self, found: Instances, truth: ImageTruth) -> None:
        """Takes what was found in an image and what is there.

        Raises:
            InvalidInputError: Masks are asked for, but the image has boxes only.
        """
        if self._overlap == "mask" and truth.masks is None:
            raise InvalidInputError("masks are compared, but an image has only boxes; compare boxes there")
        number = len(self._images) + 1
        height, width = found.masks.shape[1:]
        self._images.append({"id": number, "height": height, "width": width})
        for index, (left, top, right, bottom) in enumerate(truth.boxes.tolist()):
            entry = {
                "id": len(self._truths) + 1,
                "image_id": number,
                "category_id": 1,
                "bbox": [left, top, right - left, bottom - top],
                "area": (right - left) * (bottom - top),
                "iscrowd": int(truth.ignored[index]),
            }
            if self._overlap == "mask" and truth.masks is not None:
                mask = EncodedMask.encode(truth.masks[index])
                entry |= {"segmentation": mask.to_coco(), "area": mask.area}
            self._truths.append(entry)
        for index, (left, top, right, bottom) in enumerate(found.boxes.tolist()):
            entry = {"image_id": number, "category_id": 1, "score": float(found.scores[index])}
            if self._overlap == "mask":
                entry["segmentation"] = EncodedMask.encode(found.masks[index]).to_coco()
            else:
                entry["bbox"] = [left, top, right - left, bottom - top]
            self._detections.append(entry)

    def metrics(self) -> dict[str, float]:
        """The metrics by their names in `NAMES`; -1 where there was nothing to find.

        Raises:
            MissingPackageError: pycocotools is not installed.
        """
        try:
            from pycocotools.coco import COCO
            from pycocotools.cocoeval import COCOeval
        except ImportError as error:
            raise MissingPackageError.extra("pycocotools", "perception") from error
        if not self._detections:
            return dict.fromkeys(NAMES, 0.0 if self._truths else -1.0)
        with contextlib.redirect_stdout(io.StringIO()):  # pycocotools prints.
            truth_set: Any = COCO()
            truth_set.dataset = {
                "images": self._images,
                "annotations": self._truths,
                "categories": [{"id": 1, "name": "tomato"}],
            }
            truth_set.createIndex()
            found_set = truth_set.loadRes(self._detections)
            evaluation = COCOeval(truth_set, found_set, "bbox" if self._overlap == "box" else "segm")
            evaluation.evaluate()
            evaluation.accumulate()
            evaluation.summarize()
        return {name: float(value) for name, value in zip(NAMES, np.asarray(evaluation.stats), strict=False)}
