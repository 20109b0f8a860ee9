"""Detectors on the same photos in the same runtime: ours, and a stock YOLO nano that was trained on the same photos."""

import statistics
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from benchmarking.turns import four_digits
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.segmentation.datasets.reading import read_place
from maniskill_tomato.segmentation.instances import Image, Instances
from maniskill_tomato.segmentation.light_segmenter import THOROUGH
from maniskill_tomato.segmentation.metrics.detector_evaluation import evaluate_segmenter
from maniskill_tomato.segmentation.segmenter import Segmenter, make_segmenter

OURS: Final[dict[str, dict[str, Any]]] = {
    "light, one size": {"scales": (1.5,)},
    "light, two sizes (`--quick`)": {},
    "light, three sizes, mirrored": THOROUGH,
}
"""Options of the segmenter that ships, by what they are called in the table."""


@dataclass
class Clock:
    """A segmenter, and the processor time of each of its calls."""

    segmenter: Segmenter
    spent: list[float] = field(default_factory=list)
    """In [s]."""

    def __call__(self, image: Image, depth_m: NDArray[np.float32] | None = None) -> Instances:
        """What the segmenter finds."""
        start = time.process_time()
        found = self.segmenter(image, depth_m)
        self.spent.append(time.process_time() - start)
        return found


def check_detection(photos: str | None, yolo: Path | None) -> None:
    """Accepts what to compare detectors on, before anything else is measured.

    Raises:
        InvalidInputError: There are no such photos or weights.
    """
    if photos is None:
        if yolo is not None:
            raise InvalidInputError("--yolo needs --photos FOLDER:SPLIT, the photos to judge it on")
        return
    read_place(photos)
    if yolo is not None and (yolo.suffix != ".onnx" or not yolo.is_file()):
        raise InvalidInputError(
            f"--yolo takes the .onnx file that Ultralytics' `yolo export format=onnx` writes, got {yolo}"
        )


def compare_detectors(photos: str, yolo: Path | None) -> list[dict[str, Any]]:
    """Milliseconds of processor time an image, and AP of boxes, from the image to the boxes in it.

    Args:
        photos: FOLDER:SPLIT of annotated photos.
        yolo: A YOLO in ONNX, which Ultralytics runs in ONNX Runtime; None to leave it out.
    """
    images = read_place(photos).images
    segmenters = {name: make_segmenter("light", **options) for name, options in OURS.items()}
    if yolo is not None:
        segmenters[f"YOLO ({yolo.stem})"] = make_segmenter("yolo", weights=yolo, score_threshold=0.001)
    rows = []
    for name, segmenter in segmenters.items():
        clock = Clock(segmenter)
        with tempfile.TemporaryDirectory() as folder:
            metrics = evaluate_segmenter(clock, images, Path(folder)).metrics
        rows.append(
            {
                "detector": name,
                "images": len(images),
                "ms_an_image": four_digits(1e3 * statistics.median(clock.spent)),
                "box_AP50": round(metrics["box_AP50"], 3),
                "box_AP50_95": round(metrics["coco_box_AP"], 3),
            }
        )
    return rows
