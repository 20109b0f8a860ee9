"""Images by ray casting: what each pixel of a camera shows, without a renderer."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

BACKGROUND_DEPTH: Final = 4.0
"""Depth of a pixel of `CastImages` that shows neither plant nor robot, in [m]: a greenhouse always has a wall."""

NOTHING_LABEL: Final = 0
"""Label of the background in a `Picture`."""
ROBOT_LABEL: Final = 1
"""Label of the robot in a `Picture`."""
FIRST_ORGAN_LABEL: Final = 2
"""Label of the plant's organ 0 in a `Picture`; organ k has this plus k."""


@dataclass(frozen=True, eq=False)
class CastImages:
    """What the cameras of B environments see, as a perfect segmenter that knows the target tells it."""

    depth: Tensor
    """Along the optical axis, in [m]; `BACKGROUND_DEPTH` for the background. Shape (B, H, W)."""
    role: Tensor
    """Values of `Role`, uint8. Shape (B, H, W)."""


@dataclass(frozen=True, eq=False)
class Picture:
    """What one camera sees, organ by organ and with shading; one ray through the middle of each pixel."""

    depth: NDArray[np.float32]
    """Along the optical axis, in [m], 0 where there is nothing. Shape (H, W)."""
    labels: NDArray[np.int32]
    """`NOTHING_LABEL`, `ROBOT_LABEL`, or `FIRST_ORGAN_LABEL` plus the index in `Plant.organs`. Shape (H, W)."""
    facing: NDArray[np.float32]
    """Cosine of the angle between ray and surface, 1 where one looks straight at it. Shape (H, W)."""

    def coloured(self, palette: NDArray[np.float64]) -> NDArray[np.uint8]:
        """The picture in one colour for every label, darker where one looks along a surface.

        Args:
            palette: sRGB, 0 to 255, by label. Shape (labels, 3).

        Returns:
            Shape (H, W, 3).
        """
        shade = np.where(self.labels == NOTHING_LABEL, 1.0, 0.45 + 0.55 * self.facing)[..., None]
        return np.asarray((palette[self.labels] * shade).round(), dtype=np.uint8)
