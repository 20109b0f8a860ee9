"""How the training of the light segmenter is configured; cheap to import."""

from dataclasses import dataclass, field

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.segmentation.fruit_network_config import FIXED_BLOCKS, FruitNetworkConfig


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
