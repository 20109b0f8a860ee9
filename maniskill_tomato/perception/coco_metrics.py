"""COCO's average precisions, by its own library."""

import contextlib
import io
from collections.abc import Iterable
from typing import Any

import numpy as np

from maniskill_tomato.errors import InvalidInputError, MissingPackageError
from maniskill_tomato.perception.detection_metrics import ImageTruth, Overlap
from maniskill_tomato.perception.instances import Instances
from maniskill_tomato.perception.masks import EncodedMask

NAMES = ("AP", "AP50", "AP75", "AP_small", "AP_medium", "AP_large", "AR1", "AR10", "AR100")
"""What COCO reports first: mean AP over overlaps 0.5 to 0.95, at 0.5, at 0.75, by size; mean recall."""


def coco_metrics(pairs: Iterable[tuple[Instances, ImageTruth]], overlap: Overlap = "box") -> dict[str, float]:
    """COCO's metrics of all fruits as one category; -1 where there was nothing to find.

    Args:
        pairs: What was found in each image, and what is there.
        overlap: Whether boxes or masks are compared.

    Raises:
        InvalidInputError: Masks are asked for, but an image has boxes only.
        MissingPackageError: pycocotools is not installed.
    """
    try:
        from pycocotools.coco import COCO
        from pycocotools.cocoeval import COCOeval
    except ImportError as error:
        raise MissingPackageError.extra("pycocotools", "perception") from error
    images: list[dict[str, Any]] = []
    truths: list[dict[str, Any]] = []
    detections: list[dict[str, Any]] = []
    for number, (found, truth) in enumerate(pairs, start=1):
        height, width = found.masks.shape[1:]
        images.append({"id": number, "height": height, "width": width})
        if overlap == "mask" and truth.masks is None:
            raise InvalidInputError("masks are compared, but an image has only boxes; compare boxes there")
        for index, (left, top, right, bottom) in enumerate(truth.boxes.tolist()):
            entry = {
                "id": len(truths) + 1,
                "image_id": number,
                "category_id": 1,
                "bbox": [left, top, right - left, bottom - top],
                "area": (right - left) * (bottom - top),
                "iscrowd": int(truth.ignored[index]),
            }
            if overlap == "mask" and truth.masks is not None:
                mask = EncodedMask.encode(truth.masks[index])
                entry |= {"segmentation": mask.to_coco(), "area": mask.area}
            truths.append(entry)
        for index, (left, top, right, bottom) in enumerate(found.boxes.tolist()):
            entry = {"image_id": number, "category_id": 1, "score": float(found.scores[index])}
            if overlap == "mask":
                entry["segmentation"] = EncodedMask.encode(found.masks[index]).to_coco()
            else:
                entry["bbox"] = [left, top, right - left, bottom - top]
            detections.append(entry)
    with contextlib.redirect_stdout(io.StringIO()):  # pycocotools prints.
        truth_set: Any = COCO()
        truth_set.dataset = {
            "images": images,
            "annotations": truths,
            "categories": [{"id": 1, "name": "tomato"}],
        }
        truth_set.createIndex()
        if not detections:
            return dict.fromkeys(NAMES, 0.0 if truths else -1.0)
        evaluation = COCOeval(
            truth_set, truth_set.loadRes(detections), "bbox" if overlap == "box" else "segm"
        )
        evaluation.evaluate()
        evaluation.accumulate()
        evaluation.summarize()
    return {name: float(value) for name, value in zip(NAMES, np.asarray(evaluation.stats), strict=False)}
