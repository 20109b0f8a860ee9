"""The thesis's detectors: YOLOv3 (Table 4-1), Mask R-CNN strategies 1 and 2 (Tables 4-2 to 4-4) and 3 (6-2)."""

from dataclasses import dataclass
from typing import Literal

from maniskill_tomato.errors import InvalidInputError

Backbone = Literal["resnet101", "resnet50", "efficientnet_lite0"]


@dataclass(frozen=True, kw_only=True)
class ClassicAugmentation:
    """With a probability, one of these is applied to a training picture (4-2-3)."""

    probability: float
    """That any is."""
    flip: bool = True
    """Mirror left to right."""
    blur_sigma: float = 2.5
    """Standard deviation of a Gaussian blur in [px]."""
    brightness: tuple[float, float] = (0.8, 1.5)
    """Factor on every pixel."""
    contrast: tuple[float, float] | None = None
    """alpha of 127 + alpha (v - 127); None for strategy 1, which does without."""

    def __post_init__(self) -> None:
        if not 0 <= self.probability <= 1:
            raise InvalidInputError(f"probability must be from 0 to 1, got {self.probability}")


@dataclass(frozen=True, kw_only=True)
class MaskRcnnConfig:
    """How a Mask R-CNN is built and trained."""

    backbone: Backbone = "resnet101"
    """Network under the feature pyramid."""
    epochs: int = 80
    """Epochs."""
    steps_per_epoch: int = 600
    """Training steps in an epoch."""
    validation_steps: int = 100
    """Validation steps after an epoch."""
    batch_size: int = 1
    """Pictures in a step."""
    learning_rates: tuple[tuple[int, float], ...] = ((1, 1e-3),)
    """First epoch, counted from 1, and learning rate of each part of the training."""
    momentum: float = 0.9
    """Of stochastic gradient descent."""
    weight_decay: float = 1e-4
    """Of stochastic gradient descent."""
    longest_side: int = 1024
    """The input is at most this long, in [px], and padded with zeros to a square of it."""
    shortest_side: int = 800
    """The shorter side is scaled to this in [px] where the longer allows it."""
    anchor_sides: tuple[int, ...] = (32, 64, 128, 256, 512)
    """Sides of the anchors of the region proposal network in [px], one for each level of the pyramid."""
    proposal_nms: float = 0.7
    """Non-maximum suppression threshold of the region proposals."""
    rois_per_image: int = 200
    """Regions of interest that a picture trains the heads on."""
    dropout: float = 0.0
    """Share of the nodes dropped after each fully connected layer of the box head."""
    least_confidence: float = 0.5
    """Least score of a detection."""
    categories: tuple[str, ...] = ("tomato", "robot")
    """What is told apart from the background."""
    augmentation: ClassicAugmentation = ClassicAugmentation(probability=0.75)
    """How pictures are varied."""
    bfloat16: bool = False
    """Train in 16 bits where that is safe, which processors with AMX or AVX-512 BF16 do faster."""

    def __post_init__(self) -> None:
        if len(self.anchor_sides) != 5:
            raise InvalidInputError(f"anchor_sides must be 5 numbers, one a level, got {self.anchor_sides}")
        if not self.learning_rates or self.learning_rates[0][0] != 1:
            raise InvalidInputError(f"learning_rates must start with epoch 1, got {self.learning_rates}")
        if not 0 <= self.dropout < 1:
            raise InvalidInputError(f"dropout must be from 0 to below 1, got {self.dropout}")
        for name in ("epochs", "steps_per_epoch", "batch_size"):
            if getattr(self, name) < 1:
                raise InvalidInputError(f"{name} must be at least 1, got {getattr(self, name)}")

    def learning_rate(self, epoch: int) -> float:
        """The learning rate of an epoch, counted from 1."""
        return [rate for first, rate in self.learning_rates if first <= epoch][-1]


FOUR_AUGMENTATIONS = ClassicAugmentation(probability=0.8, brightness=(0.7, 1.3), contrast=(0.6, 1.4))

MASK_RCNN_PRESETS: dict[str, MaskRcnnConfig] = {
    # Tables 4-2 and 4-3.
    "strategy-1": MaskRcnnConfig(),
    # Tables 4-2 and 4-4.
    "strategy-2": MaskRcnnConfig(
        epochs=65,
        steps_per_epoch=1000,
        validation_steps=120,
        learning_rates=((1, 1e-3), (21, 1e-4)),
        anchor_sides=(16, 64, 128, 256, 512),
        dropout=0.3,
        augmentation=FOUR_AUGMENTATIONS,
    ),
    # Section 6-2, proposed there and not run.
    "strategy-3": MaskRcnnConfig(
        epochs=80,
        steps_per_epoch=1000,
        validation_steps=200,
        learning_rates=((1, 1e-3), (11, 1e-4), (41, 1e-5)),
        anchor_sides=(16, 64, 128, 256, 512),
        proposal_nms=0.5,
        rois_per_image=300,
        dropout=0.5,
        augmentation=FOUR_AUGMENTATIONS,
    ),
    # Ours: on the light segmenter's backbone, whose ImageNet weights come as a package (`--pretrained`).
    "light-lite0": MaskRcnnConfig(
        backbone="efficientnet_lite0",
        epochs=10,
        steps_per_epoch=40,
        validation_steps=16,
        batch_size=2,
        learning_rates=((1, 1e-2), (9, 1e-3)),
        longest_side=512,
        shortest_side=384,
        anchor_sides=(12, 24, 48, 96, 192),
        proposal_nms=0.7,
        rois_per_image=128,
        augmentation=FOUR_AUGMENTATIONS,
        bfloat16=True,
    ),
}
"""Mask R-CNN settings by name."""


@dataclass(frozen=True, kw_only=True)
class YoloConfig:
    """How a YOLO detector is trained (Table 4-1 and the text around it)."""

    epochs: int = 100
    """N_e, at most."""
    batch_size: int = 1
    """N."""
    learning_rate: float = 1e-4
    """lr, the first one."""
    smallest_input: int = 288
    """I_min in [px]; the input size varies between the two."""
    largest_input: int = 448
    """I_max in [px]."""
    object_threshold: float = 0.5
    """Least confidence of an object."""
    nms_threshold: float = 0.45
    """Of two boxes with a larger intersection over union only the better one stays."""
    patience: int = 3
    """Epochs without a better validation loss after which training stops."""
    pretrained: bool = False
    """Whether it starts from weights trained elsewhere."""


YOLO_PRESET = YoloConfig()
"""Table 4-1."""
