"""Size of the fruit network; cheap to import."""

from dataclasses import asdict, dataclass
from typing import Any, Literal

FIXED_BLOCKS = 6
"""First of the fifteen blocks that a training on fruits leaves as ImageNet made them, with the stem."""


@dataclass(frozen=True, kw_only=True)
class FruitNetworkConfig:
    """Size of the network."""

    backbone: Literal["efficientnet_lite0", "plain"] = "efficientnet_lite0"
    """A network that begins from ImageNet weights, or a plain one of the sizes below that begins from random ones."""
    widths: tuple[int, int, int, int] = (32, 64, 128, 256)
    """Channels of the plain one at strides 4, 8, 16 and 32."""
    blocks: tuple[int, int, int, int] = (1, 2, 2, 1)
    """Its residual blocks at these strides."""
    neck_width: int = 64
    """Channels on the way back to stride 4."""
    fine_width: int = 48
    """Channels at stride 2, where the outputs are."""
    categories: int = 3
    """Kinds of fruit that are told apart."""

    def to_dict(self) -> dict[str, Any]:
        """Numbers and lists only, for a file."""
        return {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(self).items()}

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> "FruitNetworkConfig":
        """The inverse of `to_dict`."""
        values: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in data.items()}
        return cls(**values)
