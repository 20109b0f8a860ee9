"""How the detectors are built and trained; cheap to import.

The thesis's settings are Mask R-CNN strategies 1 and 2 (Tables 4-2 to 4-4) and 3 (6-2); those of YOLO (Table 4-1) stand
in `training.yolo_training`.
"""

import math
from dataclasses import dataclass, field, replace
from typing import Literal

from maniskill_tomato.errors import InvalidInputError

FIXED_BLOCKS = 6
"""First of the fifteen blocks that a training on fruits leaves as ImageNet made them, with the stem."""


@dataclass(frozen=True, kw_only=True)
class FruitNetworkConfig:
    """Size of the light segmenter's network."""

    neck_width: int = 64
    """Channels on the way back to stride 4."""
    fine_width: int = 48
    """Channels at stride 2, where the outputs are."""
    categories: int = 3
    """Kinds of fruit that are told apart."""


@dataclass(frozen=True, kw_only=True)
class AugmentationConfig:
    """How pictures are varied for the light segmenter."""

    size: int = 320
    """Height and width of a training picture in [px]."""
    scale: tuple[float, float] = (0.6, 1.6)
    """Range of the factor on the picture's size, uniform in its logarithm."""
    mosaic_probability: float = 0.5
    """How often four pictures share one."""
    flip_probability: float = 0.5
    """How often a picture is mirrored left to right."""
    brightness: tuple[float, float] = (0.6, 1.4)
    """Factor on all colours."""
    contrast: tuple[float, float] = (0.7, 1.3)
    """Factor on the difference from the mean."""
    gamma: tuple[float, float] = (0.7, 1.4)
    """Exponent of the colours."""
    channel_gain: tuple[float, float] = (0.85, 1.15)
    """Factor on each colour for itself: white balance."""
    saturation: tuple[float, float] = (0.6, 1.4)
    """Factor on the difference from grey."""
    blur_probability: float = 0.2
    """How often a picture is blurred, by a Gaussian of up to 1.5 px."""
    noise_probability: float = 0.3
    """How often each pixel gets Gaussian noise, of up to 10 of 255."""
    smallest_side: float = 5.0
    """Fruits narrower than this in [px] are ignored: they need not be found, and finding them is no error."""
    smallest_share: float = 0.2
    """Fruits of which less than this share is left in the picture are ignored too."""


@dataclass(frozen=True, kw_only=True)
class LightTrainConfig:
    """How to train the light segmenter."""

    steps: int = 8000
    """Batches in all."""
    batch_size: int = 8
    """Pictures in a batch."""
    learning_rate: float = 1.5e-3
    """Of AdamW, after the warm-up; it falls to a hundredth along a cosine."""
    weight_decay: float = 1e-3
    """Of AdamW."""
    warmup_steps: int = 200
    """Steps over which the learning rate rises from 0."""
    gradient_norm: float = 20.0
    """Longest gradient; longer ones are shortened."""
    averaging: float = 0.998
    """Share of the averaged weights, which are those that are kept, that stays at each step."""
    bfloat16: bool = True
    """Multiply in 16 bits, which processors with AMX or AVX-512 BF16 do several times faster."""
    backbone_rate: float = 0.3
    """Learning rate of a backbone with ImageNet weights, as a share of the others'."""
    fixed_blocks: int = FIXED_BLOCKS
    """First blocks of a backbone with ImageNet weights that stay as they are, with the stem."""
    plain_share: float = 0.0
    """Last share of the steps, without mosaics, so that the last pictures resemble real ones."""
    seed: int = 0
    """Of the weights and the pictures."""
    log_every: int = 50
    """Steps between two lines of the history."""
    save_every: int = 200
    """Steps between two checkpoints."""
    network: FruitNetworkConfig = field(default_factory=FruitNetworkConfig)
    """Size of the network."""
    augmentation: AugmentationConfig = field(default_factory=AugmentationConfig)
    """How pictures are varied."""

    def __post_init__(self) -> None:
        for name in ("steps", "batch_size", "log_every", "save_every"):
            if getattr(self, name) < 1:
                raise InvalidInputError(f"{name} must be at least 1, got {getattr(self, name)}")
        if not 0 < self.learning_rate < 1:
            raise InvalidInputError(f"learning_rate must be between 0 and 1, got {self.learning_rate}")
        if not 0 <= self.averaging < 1:
            raise InvalidInputError(f"averaging must be from 0 to below 1, got {self.averaging}")

    def rate_at(self, step: int) -> float:
        """The learning rate of a step: linear warm-up, then a cosine down to a hundredth."""
        if step < self.warmup_steps:
            return self.learning_rate * (step + 1) / self.warmup_steps
        progress = (step - self.warmup_steps) / max(self.steps - self.warmup_steps, 1)
        return self.learning_rate * (0.01 + 0.99 * (1 + math.cos(math.pi * min(progress, 1.0))) / 2)


Backbone = Literal["resnet101", "resnet50", "efficientnet_lite0"]

ThingClass = Literal["tomato", "robot", "leaf", "stem"]
"""What Mask R-CNN can tell apart; tomatoes of every ripeness are one class."""


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
        if "tomato" not in self.categories or len(set(self.categories)) < len(self.categories):
            raise InvalidInputError(
                f"classes must be different ones and tomato one of them, got {', '.join(self.categories) or 'none'}"
            )
        for name in ("epochs", "steps_per_epoch", "batch_size"):
            if getattr(self, name) < 1:
                raise InvalidInputError(f"{name} must be at least 1, got {getattr(self, name)}")

    def learning_rate(self, epoch: int) -> float:
        """The learning rate of an epoch, counted from 1."""
        return [rate for first, rate in self.learning_rates if first <= epoch][-1]

    def scaled(self, *, steps: float = 1.0, size: float = 1.0, rates: float = 1.0) -> "MaskRcnnConfig":
        """The same training with fewer steps in each epoch, on smaller pictures.

        Epochs, and with them the places where the learning rate falls, stay. So does the size of the anchors over that
        of the picture.

        Args:
            steps: Factor on the steps of an epoch, in training and in validation; at least one of each is left.
            size: Factor on the sides of the input and of the anchors.
            rates: Factor on the learning rates, which makes up for a part of the steps that are left out.

        Raises:
            InvalidInputError: A factor on steps or size is not above 0 and at most 1, or that on the learning rates
                not from 1 to 10.
        """
        for name, factor in (("steps", steps), ("size", size)):
            if not 0 < factor <= 1:
                raise InvalidInputError(f"the factor on {name} must be above 0 and at most 1, got {factor}")
        if not 1 <= rates <= 10:
            raise InvalidInputError(f"the factor on the learning rates must be from 1 to 10, got {rates}")
        return replace(
            self,
            learning_rates=tuple((first, rate * rates) for first, rate in self.learning_rates),
            steps_per_epoch=max(1, round(self.steps_per_epoch * steps)),
            validation_steps=max(1, round(self.validation_steps * steps)),
            longest_side=round(self.longest_side * size),
            shortest_side=round(self.shortest_side * size),
            anchor_sides=tuple(max(1, round(side * size)) for side in self.anchor_sides),
        )


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
