"""YOLO through Ultralytics, which is an extra of its own: its licence is AGPL-3.0.

Whoever gives a program that uses Ultralytics to others, or offers it over a network, must give its source under the
same licence, or buy another one. Nothing else in this package needs it, and it is imported only here.
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.errors import CheckpointError, InvalidInputError, MissingPackageError
from maniskill_tomato.segmentation.instances import TOMATO, Image, Instances, box_ellipse, check_image

SMALLEST_INPUT, LARGEST_INPUT = 288, 448
"""I_min and I_max of Table 4-1 in [px]; the size of the input varies between the two in training."""

OBJECT_THRESHOLD = 0.5
"""Least confidence of an object (Table 4-1)."""

NMS_THRESHOLD = 0.45
"""Of two boxes with a larger intersection over union only the better one stays (Table 4-1)."""


class YoloSegmenter:
    """A `Segmenter` over an Ultralytics model; of a model that only detects, masks are the ellipses in its boxes."""

    def __init__(self, model: Any, score_threshold: float) -> None:
        """Takes an opened model.

        Args:
            model: `ultralytics.YOLO`.
            score_threshold: Objects below are left out.
        """
        self.model = model
        self.score_threshold = score_threshold

    def __call__(self, image: Image, depth_m: NDArray[np.float32] | None = None) -> Instances:
        """The fruits in an image; see `Segmenter`."""
        check_image(image, depth_m)
        height, width = image.shape[:2]
        (found,) = self.model.predict(
            np.ascontiguousarray(image[..., ::-1]),
            conf=max(self.score_threshold, 1e-3),
            iou=NMS_THRESHOLD,
            imgsz=LARGEST_INPUT,
            retina_masks=True,
            verbose=False,
        )
        boxes = found.boxes.xyxy.cpu().numpy().astype(np.float32).reshape(-1, 4)
        if found.masks is None:
            masks = np.array([box_ellipse(box, height, width) for box in boxes], bool).reshape(
                -1, height, width
            )
        else:
            masks = found.masks.data.cpu().numpy().astype(bool)
        names = [str(found.names[int(k)]) for k in found.boxes.cls.tolist()]
        instances = Instances(
            boxes=boxes,
            scores=found.boxes.conf.cpu().numpy().astype(np.float32),
            categories=tuple(names),
            masks=masks,
        )
        fruit = np.array([name.startswith(TOMATO) for name in names], bool)
        return instances.chosen(fruit)


def import_ultralytics() -> Any:
    """The library.

    Raises:
        MissingPackageError: It is not installed.
    """
    try:
        import ultralytics  # pyright: ignore[reportMissingImports] # An extra of its own.
    except ImportError as error:
        raise MissingPackageError.extra("ultralytics (licence AGPL-3.0)", "yolo") from error
    return ultralytics


def open_yolo(weights: Path | str | None = None, score_threshold: float | None = None) -> YoloSegmenter:
    """Opens the weights in a file that Ultralytics wrote; none ship.

    Raises:
        MissingPackageError: Ultralytics is not installed.
        CheckpointError: No file is given, or it is missing.
        InvalidInputError: The threshold is not between 0 and 1.
    """
    threshold = OBJECT_THRESHOLD if score_threshold is None else score_threshold
    if not 0 <= threshold <= 1:
        raise InvalidInputError(f"score_threshold must be between 0 and 1, got {threshold}")
    if weights is None or not Path(weights).is_file():
        raise CheckpointError(
            f"no YOLO weights at {weights}; train some with `maniskill-tomato train-segmenter yolo` and give their "
            "file, whose name begins with yolo, as the segmenter"
        )
    return YoloSegmenter(import_ultralytics().YOLO(str(weights)), threshold)
