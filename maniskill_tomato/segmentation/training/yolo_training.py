"""Training of YOLO by Ultralytics' own loop: its data, its settings and its losses."""

import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from maniskill_tomato.errors import CheckpointError, InvalidInputError
from maniskill_tomato.files import write_atomically
from maniskill_tomato.folder_lock import only_writer
from maniskill_tomato.segmentation.datasets.annotations import AnnotatedImage, ignored_fruit
from maniskill_tomato.segmentation.datasets.picture_files import write_picture
from maniskill_tomato.segmentation.instances import TOMATO
from maniskill_tomato.segmentation.metrics.detection_plots import plot_losses
from maniskill_tomato.segmentation.training.training_pictures import TrainingImages
from maniskill_tomato.segmentation.yolo import LARGEST_INPUT, SMALLEST_INPUT, import_ultralytics

WITHOUT_AUGMENTATION: dict[str, Any] = {
    # Colours; place, size and mirror image; several pictures in one; blur, grey and contrast by Albumentations, which
    # Ultralytics adds where that package is installed.
    **dict.fromkeys(("hsv_h", "hsv_s", "hsv_v", "bgr"), 0.0),
    **dict.fromkeys(("translate", "scale", "degrees", "shear", "perspective", "fliplr", "flipud"), 0.0),
    **dict.fromkeys(("mosaic", "mixup", "cutmix", "copy_paste"), 0.0),
    "augmentations": [],
}
"""Everything by which Ultralytics varies pictures for detection, off; only the size of the input varies then."""

YOLO_SETTINGS: dict[str, dict[str, Any]] = {
    "thesis": {
        "epochs": 100,
        "batch": 1,
        "lr0": 1e-4,
        "imgsz": (SMALLEST_INPUT + LARGEST_INPUT) // 2,
        "multi_scale": (LARGEST_INPUT - SMALLEST_INPUT) / (LARGEST_INPUT + SMALLEST_INPUT),
        "patience": 3,
        "optimizer": "Adam",
        "pretrained": False,
        **WITHOUT_AUGMENTATION,
    },
    # Ultralytics' own batch of 16 fills a small machine's memory.
    "stock": {"epochs": 100, "batch": 8, "imgsz": LARGEST_INPUT, "pretrained": False},
}
"""Settings in Ultralytics' words: Table 4-1, or what the library (version 8.4) does when nothing is asked of it.

The thesis trained without augmentation (4-2-2). Deviations: Ultralytics' networks have no anchors, which the thesis
generated from its boxes; Ultralytics lowers the learning rate along its own schedule instead of at plateaus, and
rounds the sizes of the input to multiples of 32."""


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


def train_yolo(images: TrainingImages, out: Path, settings: dict[str, Any], model: str, seed: int) -> Path:
    """Trains from random weights, and draws the losses at the end.

    Args:
        images: What to train and validate on; the shares of the sets do not count.
        out: Folder of the training.
        settings: One of `YOLO_SETTINGS`.
        model: Network of Ultralytics; the thesis used YOLOv3 (`yolov3.yaml`), which is large for a CPU.
        seed: Of the weights and the pictures.

    Returns:
        File of the best weights.

    Raises:
        InvalidInputError: There is no image to train or to validate on, or one cannot be read.
        MissingPackageError: Ultralytics is not installed.
        CheckpointError: A file cannot be written, or another process trains in the folder.
    """
    with only_writer(out, "trains"):
        return _train(images, out, settings, model, seed)


def _train(images: TrainingImages, out: Path, settings: dict[str, Any], model: str, seed: int) -> Path:
    network = import_ultralytics().YOLO(model)
    data = write_yolo_data([image for one in images.sets for image in one], images.validation, out / "data")
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
    plot_losses({out.name: read_history(out / "yolo" / "results.csv")}, out / "losses.png")
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
    except (OSError, AttributeError, KeyError, TypeError, ValueError, csv.Error) as error:
        raise CheckpointError(f"{results} is no list of losses of Ultralytics ({error})") from error
