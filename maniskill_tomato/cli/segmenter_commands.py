"""`maniskill-tomato train-segmenter`: three kinds of segmenters, trained on annotated images."""

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from maniskill_tomato.cli.arguments import Flat
from maniskill_tomato.cli.early_checks import check_counts, check_file, check_place
from maniskill_tomato.cli.shared_options import say
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.segmentation.detector_configs import (
    MASK_RCNN_PRESETS,
    Backbone,
    LightTrainConfig,
    ThingClass,
)

if TYPE_CHECKING:
    from maniskill_tomato.segmentation.datasets.annotations import AnnotatedImage
    from maniskill_tomato.segmentation.training.detector_training import DetectorTraining
    from maniskill_tomato.segmentation.training.training_pictures import TrainingImages


@dataclass(frozen=True, kw_only=True)
class ImageOptions:
    """What a segmenter is trained on."""

    data: tuple[str, ...]
    """Folders of annotated images (COCO or Pascal VOC), or FOLDER:SPLIT for one list of a folder (`photos:train` for
    its train.txt)."""
    shares: tuple[float, ...] = ()
    """How often each folder is drawn from; by default all alike."""
    validation: str | None = None
    """Images whose losses are logged too, in the same form."""
    limit: int | None = None
    """Use only this many images of each folder, the first of its list."""
    out: Path = Path("runs/segmenter")
    """Folder of the training; one that holds a training of the same settings goes on."""

    def check(self) -> None:
        """Accepts folders that are there.

        Raises:
            InvalidInputError: One is missing, or the shares do not fit.
        """
        if not self.data:
            raise InvalidInputError("--data must name one folder or more")
        for place in self.data:
            check_place("--data", place)
        if self.validation is not None:
            check_place("--validation", self.validation)
        if self.shares and len(self.shares) != len(self.data):
            raise InvalidInputError(f"--shares must be one for each folder of --data, got {len(self.shares)}")
        check_counts(limit=self.limit)

    def read(self) -> "TrainingImages":
        """The images; what is left out is named on standard error."""
        from maniskill_tomato.segmentation.datasets.reading import read_place
        from maniskill_tomato.segmentation.training.training_pictures import TrainingImages

        def images(place: str) -> "tuple[AnnotatedImage, ...]":
            found = read_place(place)
            if found.skipped:
                print(f"{place}: {found.skipped_text()}", file=sys.stderr)
            return found.images

        return TrainingImages(
            sets=tuple(images(place)[: self.limit] for place in self.data),
            shares=self.shares,
            validation=images(self.validation) if self.validation else (),
        )


@dataclass(frozen=True, kw_only=True)
class TrainLight(ImageOptions):
    """Train the light segmenter, on a CPU; a training that was stopped goes on."""

    start_from: Path | None = None
    """Weights to begin with instead of ImageNet's; layers that do not fit begin anew."""
    config: Annotated[LightTrainConfig, Flat] = field(default_factory=LightTrainConfig)
    """How to train."""

    def run(self) -> None:
        """Trains and says where the weights are."""
        self.check()
        check_file("--start-from", self.start_from)

        from maniskill_tomato.segmentation.training.light_training import LightTraining

        _tell_weights(lambda: _train(LightTraining(self.config, self.read(), self.start_from), self.out))


@dataclass(frozen=True, kw_only=True)
class TrainMaskRcnn(ImageOptions):
    """Train Mask R-CNN with the thesis's settings, or small enough for a CPU; a training that was stopped goes on."""

    preset: Literal["light-lite0", "strategy-1", "strategy-2", "strategy-3"] = "light-lite0"
    """Settings: `light-lite0` for a CPU, or those of Tables 4-3, 4-4 and section 6-2."""
    pretrained: bool = False
    """Start from ImageNet weights of the backbone: of `efficientnet_lite0` those of the extra `pretrained`, of the
    others torchvision's, which are downloaded."""
    classes: tuple[ThingClass, ...] = ("tomato", "robot")
    """What is told apart. With leaf or stem, images that name neither, such as photos, are left out."""
    backbone: Backbone | None = None
    """Network under the pyramid, if not that of the preset; `efficientnet_lite0` is small enough for a CPU."""
    epochs: int | None = None
    """Epochs, if not those of the preset."""
    steps_per_epoch: int | None = None
    """Steps in an epoch, if not those of the preset."""
    step_scale: float = 1.0
    """Factor on the steps of an epoch in training and validation; epochs and the learning rates of each stay."""
    input_scale: float = 1.0
    """Factor on the sides of the input and of the anchors."""
    bfloat16: bool | None = None
    """Train in 16 bits, if not as the preset does; slower where the processor has neither AMX nor AVX-512 BF16."""
    rate_scale: float = 1.0
    """Factor on the learning rates, from 1 to 10: makes up for a part of the steps that --step-scale leaves out."""
    anchors: Literal["preset", "data"] = "preset"
    """Sides of the anchors: those of the preset, or five clusters of the boxes in --data (k-means)."""
    seed: int = 0
    """Of the weights and the pictures."""

    def run(self) -> None:
        """Trains and says where the weights are."""
        self.check()
        check_counts(epochs=self.epochs, steps_per_epoch=self.steps_per_epoch)
        preset = MASK_RCNN_PRESETS[self.preset].scaled(
            steps=self.step_scale, size=self.input_scale, rates=self.rate_scale
        )
        config = replace(
            preset,
            categories=self.classes,
            bfloat16=preset.bfloat16 if self.bfloat16 is None else self.bfloat16,
            backbone=self.backbone or preset.backbone,
            epochs=preset.epochs if self.epochs is None else self.epochs,
            steps_per_epoch=preset.steps_per_epoch if self.steps_per_epoch is None else self.steps_per_epoch,
        )

        from maniskill_tomato.segmentation.training.anchors import anchor_sides
        from maniskill_tomato.segmentation.training.mask_rcnn_training import MaskRcnnTraining

        images = self.read()
        if self.anchors == "data":
            config = replace(config, anchor_sides=anchor_sides((i for s in images.sets for i in s), config))
            print(f"anchors {', '.join(map(str, config.anchor_sides))} px")
        training = MaskRcnnTraining(config, images, self.pretrained, self.seed)
        sets = zip(
            (*self.data, self.validation),
            (*images.sets, images.validation),
            (*training.images.sets, training.images.validation),
            strict=True,
        )
        for place, given, kept in sets:
            if len(kept) < len(given):
                print(
                    f"{place}: {len(given) - len(kept)} of {len(given)} images name no leaf or stem, left out"
                )
        _tell_weights(lambda: _train(training, self.out))


@dataclass(frozen=True, kw_only=True)
class TrainYolo(ImageOptions):
    """Train YOLO through Ultralytics (extra `yolo`, licence AGPL-3.0), from random weights."""

    preset: Literal["thesis", "stock"] = "thesis"
    """Settings: those of Table 4-1, or Ultralytics' own."""
    model: str = "yolov8n.yaml"
    """Network of Ultralytics; the thesis's is yolov3.yaml."""
    epochs: int | None = None
    """Epochs, if not those of Table 4-1."""
    seed: int = 0
    """Of the weights and the pictures."""

    def run(self) -> None:
        """Trains and says where the weights are."""
        self.check()
        check_counts(epochs=self.epochs)

        from maniskill_tomato.segmentation.training.yolo_training import YOLO_SETTINGS, train_yolo

        settings = YOLO_SETTINGS[self.preset]
        if self.epochs is not None:
            settings = settings | {"epochs": self.epochs}
        _tell_weights(lambda: train_yolo(self.read(), self.out, settings, self.model, self.seed))


def _train(training: "DetectorTraining[Any]", out: Path) -> Path | None:
    from maniskill_tomato.learning.interrupt import stop_on_signals
    from maniskill_tomato.segmentation.metrics.detection_plots import plot_losses

    with stop_on_signals() as request:
        path = training.run(out, say, lambda: request.reason is not None)
    if training.history:
        plot_losses({out.name: training.history}, out / "losses.png")
    return path


def _tell_weights(train: Callable[[], Path | None]) -> None:
    start = time.perf_counter()
    path = train()
    took = f"after {time.perf_counter() - start:.0f} s"
    print(
        f"weights {path} {took}, {time.process_time():.0f} s of the processor"
        if path
        else f"stopped {took}; the same command goes on"
    )
