"""Trains a segmenter on annotated images (COCO or Pascal VOC); a training that was stopped goes on.

Example:
    python scripts/train_segmenter.py light --data data/train real_photos:train --shares 0.6 0.4 \\
        --validation real_photos:val --out runs/segmenter
    python scripts/train_segmenter.py mask-rcnn --preset strategy-2 --data data/train --out runs/strategy-2
    python scripts/train_segmenter.py yolo --data real_photos:train --validation real_photos:val --out runs/yolo
"""

import logging
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

import tyro

from maniskill_tomato.errors import InvalidInputError, TomatoError
from maniskill_tomato.learning.interrupt import stop_on_signals
from maniskill_tomato.segmentation.datasets.annotations import AnnotatedImage
from maniskill_tomato.segmentation.datasets.reading import read_place
from maniskill_tomato.segmentation.metrics.detection_plots import plot_losses
from maniskill_tomato.segmentation.training.detector_presets import MASK_RCNN_PRESETS, YOLO_PRESET
from maniskill_tomato.segmentation.training.light_config import LightTrainConfig
from maniskill_tomato.segmentation.training.light_training import LightTraining
from maniskill_tomato.segmentation.training.mask_rcnn_training import MaskRcnnTraining
from maniskill_tomato.segmentation.training.resumable_training import CHECKPOINT, ResumableTraining
from maniskill_tomato.segmentation.yolo import (
    read_history,
    stock_settings,
    thesis_settings,
    train_yolo,
    write_yolo_data,
)


@dataclass(frozen=True, kw_only=True)
class DataArgs:
    """What to train on."""

    data: tuple[str, ...]
    """Folders of annotated images, or FOLDER:SPLIT for one list of a folder (`photos:train` for its train.txt)."""
    shares: tuple[float, ...] = ()
    """How often each folder is drawn from; by default all alike."""
    validation: str | None = None
    """Images whose losses are logged too, in the same form."""
    limit: int | None = None
    """Use only this many images of each folder, the first of its list."""
    out: Path = Path("runs/segmenter")
    """Folder of the training; one that holds a training of the same settings goes on."""

    def sets(self) -> list[tuple[AnnotatedImage, ...]]:
        """The images of each folder."""
        return [read_images(place, self.limit) for place in self.data]

    def validation_images(self) -> tuple[AnnotatedImage, ...]:
        """The images to validate on."""
        return read_images(self.validation) if self.validation else ()

    def all_shares(self) -> tuple[float, ...]:
        """A share for each folder."""
        return self.shares or (1.0,) * len(self.data)


@dataclass(frozen=True, kw_only=True)
class Light(DataArgs):
    """The light segmenter, on a CPU."""

    start_from: Path | None = None
    """Weights to begin with instead of ImageNet's; layers that do not fit begin anew."""
    config: LightTrainConfig = field(default_factory=LightTrainConfig)
    """How to train."""

    def run(self) -> Path | None:
        """Trains."""
        training = LightTraining(
            self.config, self.sets(), self.all_shares(), self.validation_images(), self.start_from
        )
        return run(training, self.out)


@dataclass(frozen=True, kw_only=True)
class MaskRcnn(DataArgs):
    """Mask R-CNN with the thesis's settings, or small enough for a CPU."""

    preset: Literal["light-lite0", "strategy-1", "strategy-2", "strategy-3"] = "light-lite0"
    """Settings: `light-lite0` for a CPU, or those of Tables 4-3, 4-4 and section 6-2."""
    pretrained: bool = False
    """Start from ImageNet weights of the backbone: of `light-lite0` those of the extra `pretrained`, of the others
    torchvision's, which are downloaded."""
    epochs: int | None = None
    """Epochs, if not those of the preset."""
    steps_per_epoch: int | None = None
    """Steps in an epoch, if not those of the preset."""
    seed: int = 0
    """Of the weights and the pictures."""

    def run(self) -> Path | None:
        """Trains."""
        config = MASK_RCNN_PRESETS[self.preset]
        config = replace(
            config,
            epochs=config.epochs if self.epochs is None else self.epochs,
            steps_per_epoch=config.steps_per_epoch if self.steps_per_epoch is None else self.steps_per_epoch,
        )
        training = MaskRcnnTraining(
            config, self.sets(), self.all_shares(), self.validation_images(), self.pretrained, self.seed
        )
        return run(training, self.out)


@dataclass(frozen=True, kw_only=True)
class Yolo(DataArgs):
    """YOLO through Ultralytics (extra `yolo`, licence AGPL-3.0), from random weights."""

    preset: Literal["thesis", "stock"] = "thesis"
    """Settings: those of Table 4-1, or Ultralytics' own."""
    model: str = "yolov8n.yaml"
    """Network of Ultralytics; the thesis's is yolov3.yaml."""
    epochs: int | None = None
    """Epochs, if not those of Table 4-1."""
    seed: int = 0
    """Of the weights and the pictures."""

    def run(self) -> Path | None:
        """Trains."""
        images = [image for images in self.sets() for image in images]
        data = write_yolo_data(images, self.validation_images(), self.out / "data")
        epochs = YOLO_PRESET.epochs if self.epochs is None else self.epochs
        thesis = replace(YOLO_PRESET, epochs=epochs)
        settings = stock_settings(epochs) if self.preset == "stock" else thesis_settings(thesis)
        path = train_yolo(data, self.out, settings, self.model, self.seed)
        plot_losses({self.out.name: read_history(self.out / "yolo" / "results.csv")}, self.out / "losses.png")
        return path


def read_images(place: str, limit: int | None = None) -> tuple[AnnotatedImage, ...]:
    """The first images of FOLDER or FOLDER:SPLIT; what is left out is named on standard error."""
    if limit is not None and limit < 1:
        raise InvalidInputError(f"--limit must be at least 1, got {limit}")
    found = read_place(place)
    if found.skipped:
        print(f"{place}: {found.skipped_text()}", file=sys.stderr)
    return found.images[:limit]


def run(training: ResumableTraining, out: Path) -> Path | None:
    """Goes on or begins, and draws the losses at the end."""
    if (out / CHECKPOINT).is_file():
        training.resume(out)
    with stop_on_signals() as request:
        path = training.run(out, lambda line: print(line, flush=True), lambda: request.reason is not None)
    if training.history:
        plot_losses({out.name: training.history}, out / "losses.png")
    return path


def main(argv: Sequence[str] | None = None) -> None:
    """Trains; errors made on purpose end with one line and exit status 2."""
    logging.basicConfig(level=logging.WARNING, format="%(message)s", stream=sys.stderr)
    start = time.perf_counter()
    try:
        kinds = (
            Annotated[Light, tyro.conf.subcommand("light")]
            | Annotated[MaskRcnn, tyro.conf.subcommand("mask-rcnn")]
            | Annotated[Yolo, tyro.conf.subcommand("yolo")]
        )
        args: Light | MaskRcnn | Yolo = tyro.cli(
            kinds,
            args=argv,
            description=__doc__,
        )
        path = args.run()
    except TomatoError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    took = f"after {time.perf_counter() - start:.0f} s"
    print(
        f"weights {path} {took}, {time.process_time():.0f} s of the processor"
        if path
        else f"stopped {took}; the same command goes on"
    )


if __name__ == "__main__":
    main()
