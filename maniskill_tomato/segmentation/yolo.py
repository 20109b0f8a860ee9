"""YOLO through Ultralytics, which is an extra of its own: its licence is AGPL-3.0.

Whoever gives a program that uses Ultralytics to others, or offers it over a network, must give its source under the
same licence, or buy another one. Nothing else in this package needs it, and it is imported only here.
"""

import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.errors import CheckpointError, InvalidInputError, MissingPackageError
from maniskill_tomato.files import write_atomically
from maniskill_tomato.segmentation.datasets.annotations import AnnotatedImage, ignored_fruit
from maniskill_tomato.segmentation.datasets.picture_files import write_picture
from maniskill_tomato.segmentation.instances import TOMATO, Image, Instances, box_ellipse, check_image
from maniskill_tomato.segmentation.training.detector_presets import YOLO_PRESET, YoloConfig


class YoloSegmenter:
    """A `Segmenter` over an Ultralytics model; of a model that only detects, masks are the ellipses in its boxes."""

    def __init__(self, model: Any, score_threshold: float, config: YoloConfig = YOLO_PRESET) -> None:
        """Takes an opened model.

        Args:
            model: `ultralytics.YOLO`.
            score_threshold: Objects below are left out.
            config: The input's size and the threshold of non-maximum suppression.
        """
        self.model = model
        self.score_threshold = score_threshold
        self.config = config

    def __call__(self, image: Image, depth_m: NDArray[np.float32] | None = None) -> Instances:
        """The fruits in an image; see `Segmenter`."""
        check_image(image, depth_m)
        height, width = image.shape[:2]
        (found,) = self.model.predict(
            np.ascontiguousarray(image[..., ::-1]),
            conf=max(self.score_threshold, 1e-3),
            iou=self.config.nms_threshold,
            imgsz=self.config.largest_input,
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
    threshold = YOLO_PRESET.object_threshold if score_threshold is None else score_threshold
    if not 0 <= threshold <= 1:
        raise InvalidInputError(f"score_threshold must be between 0 and 1, got {threshold}")
    if weights is None or not Path(weights).is_file():
        raise CheckpointError(
            f"no YOLO weights at {weights}; train some with `maniskill-tomato train-segmenter yolo` and give their "
            "file, whose name begins with yolo, as the segmenter"
        )
    return YoloSegmenter(import_ultralytics().YOLO(str(weights)), threshold)


def write_yolo_data(
    training: Sequence[AnnotatedImage], validation: Sequence[AnnotatedImage], folder: Path
) -> Path:
    """Copies images and writes their boxes in YOLO's format: class, centre and size as shares of the image.

    Args:
        training: Images to train on.
        validation: Images to validate on.
        folder: Where to.

    Returns:
        `data.yaml`, which names them.

    Raises:
        InvalidInputError: There is no image, or one cannot be read.
        CheckpointError: A file cannot be written.
    """
    if not training or not validation:
        raise InvalidInputError("YOLO needs images to train and to validate on")
    for split, images in (("train", training), ("val", validation)):
        for number, image in enumerate(images):
            stem = f"{number:06d}"
            write_picture(folder / "images" / split / f"{stem}.png", image.load())
            write_atomically(folder / "labels" / split / f"{stem}.txt", yolo_labels(image).encode())
    # Relative to this file's own folder, where Ultralytics looks first.
    text = f"path: {folder.resolve()}\ntrain: images/train\nval: images/val\nnames:\n  0: {TOMATO}\n"
    write_atomically(folder / "data.yaml", text.encode())
    return folder / "data.yaml"


def yolo_labels(image: AnnotatedImage) -> str:
    """One line a fruit: class 0, centre x, centre y, width, height, as shares of the image's size.

    YOLO cannot be told to overlook what is set aside (`ignored_fruit`), so that those fruits are left out.
    """
    lines = []
    for fruit in image.fruits:
        if ignored_fruit(fruit, max(image.width, image.height)):
            continue
        x, y, w, h = fruit.box_xywh
        values = (x + w / 2) / image.width, (y + h / 2) / image.height, w / image.width, h / image.height
        lines.append("0 " + " ".join(f"{v:.6f}" for v in values))
    return "\n".join(lines) + ("\n" if lines else "")


STOCK_BATCH = 8
"""Pictures in a batch of the stock training; Ultralytics' 16 fill a small machine's memory."""


def thesis_settings(config: YoloConfig = YOLO_PRESET) -> dict[str, Any]:
    """Table 4-1 in Ultralytics' words.

    Deviations: Ultralytics lowers the learning rate along its own schedule instead of at plateaus, and rounds the sizes
    of the input to multiples of 32.
    """
    return {
        "epochs": config.epochs,
        "batch": config.batch_size,
        "lr0": config.learning_rate,
        "imgsz": (config.smallest_input + config.largest_input) // 2,
        "multi_scale": (config.largest_input - config.smallest_input)
        / (config.largest_input + config.smallest_input),
        "patience": config.patience,
        "optimizer": "Adam",
        "pretrained": config.pretrained,
    }


def stock_settings(epochs: int = YOLO_PRESET.epochs) -> dict[str, Any]:
    """What Ultralytics does when nothing is asked of it (version 8.4), at the largest input of Table 4-1."""
    return {
        "epochs": epochs,
        "batch": STOCK_BATCH,
        "imgsz": YOLO_PRESET.largest_input,
        "pretrained": False,
    }


def train_yolo(
    data: Path, out: Path, settings: dict[str, Any], model: str = "yolov8n.yaml", seed: int = 0
) -> Path:
    """Trains from random weights.

    Args:
        data: What `write_yolo_data` wrote.
        out: Folder of the training.
        settings: Of `thesis_settings` or `stock_settings`.
        model: Network of Ultralytics; the thesis used YOLOv3 (`yolov3.yaml`), which is large for a CPU.
        seed: Of the weights and the pictures.

    Returns:
        File of the best weights.

    Raises:
        MissingPackageError: Ultralytics is not installed.
    """
    network = import_ultralytics().YOLO(model)
    network.train(
        data=str(data),
        project=str(out.resolve()),
        name="yolo",
        exist_ok=True,
        seed=seed,
        workers=0,
        **settings,
    )
    best = out / "yolo" / "weights" / "best.pt"
    target = out / "yolo.pt"
    write_atomically(target, best.read_bytes())
    write_atomically(out / "yolo.json", json.dumps(settings, indent=1).encode())
    return target


def read_history(results: Path) -> list[dict[str, float]]:
    """The losses that Ultralytics wrote after each epoch, named as those of the other trainings.

    Args:
        results: Its `results.csv`.

    Returns:
        A line an epoch: `step`, the number of the epoch, and each term in training and, as `val_...`, in validation.

    Raises:
        CheckpointError: It cannot be read.
    """
    try:
        with results.open(newline="") as file:
            rows = [{key.strip(): float(value) for key, value in row.items()} for row in csv.DictReader(file)]
        return [
            {"step": row["epoch"]}
            | {key.removeprefix("train/"): value for key, value in row.items() if key.startswith("train/")}
            | {
                "val_" + key.removeprefix("val/"): value
                for key, value in row.items()
                if key.startswith("val/")
            }
            for row in rows
        ]
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise CheckpointError(f"{results} is no list of losses of Ultralytics ({error})") from error
