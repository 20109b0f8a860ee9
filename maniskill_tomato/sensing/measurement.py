"""What one view told: the fruits found in it, and the frame from which rays can be read about any target position."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray

from maniskill_tomato.raycast.view_rays import ViewRays
from maniskill_tomato.segmentation.masks import BinaryMask
from maniskill_tomato.sensing.posed_frame import PosedFrame
from maniskill_tomato.sensing.view_pattern import sample_view
from maniskill_tomato.sensing.visible_fraction.crop import CropShape, WholeFruit
from maniskill_tomato.sensing.visible_fraction.estimate import fruit_depth

Position = NDArray[np.float64]

RIPE_CATEGORIES = ("tomato_ripe", "tomato")
"""Targets are ripe; a segmenter that does not tell ripeness says `tomato`."""


@dataclass(frozen=True, eq=False, kw_only=True)
class DetectedFruit:
    """One fruit in one view, by a segmenter and an estimator of the visible fraction."""

    category: str
    """As segmenters call it; see `segmentation.instances`."""
    score: float
    """The segmenter's confidence from 0 to 1."""
    corner: tuple[int, int]
    """Row and column of the upper left pixel of `crop` in the picture."""
    crop: BinaryMask
    """Visible pixels in the smallest box that holds them."""
    visible_fraction: float
    """V_f as estimated; NaN where the estimator failed."""
    centre_w: Position
    """Centre in the world frame, in [m]; without depth, as far away as a usual fruit of its size. Shape (3,)."""
    radius_m: float
    """Radius in [m]; NaN where it is not known."""
    is_depth_measured: bool
    """Whether its depth was measured; if not, it is that of what is seen round it, or follows from its size."""
    direction_w: Position
    """Unit vector from the camera through the middle of the visible pixels, world frame. Shape (3,)."""
    redness: float = float("nan")
    """(R - G) / (R + G) of the mean colour of the visible pixels; NaN where that is not known."""
    seen_whole: WholeFruit | None = None
    """Size and shape, where the whole outline is seen."""

    @property
    def is_ripe(self) -> bool:
        """Whether it can be a target."""
        return self.category in RIPE_CATEGORIES

    @property
    def pixels(self) -> int:
        """Number of visible pixels."""
        return int(np.count_nonzero(self.crop))


@dataclass(frozen=True, eq=False, kw_only=True)
class Measurement:
    """A view as it was measured. It is kept, so that no view is ever rendered or measured twice."""

    frame: PosedFrame
    """The picture."""
    fruits: tuple[DetectedFruit, ...]
    """All fruits that were found in it, best score first."""
    crop: CropShape = CropShape()
    """What was known of the fruits' size and shape when it was measured."""

    @property
    def camera_position(self) -> Position:
        """World frame, in [m]. Shape (3,)."""
        return self.frame.T_world_camera[:3, 3]

    def mask(self, fruit: int | None) -> BinaryMask:
        """Visible pixels of a fruit by its index in `fruits`; none for None. Shape (H, W)."""
        mask = np.zeros(self.frame.depth_m.shape, dtype=np.bool_)
        if fruit is not None:
            (top, left), crop = self.fruits[fruit].corner, self.fruits[fruit].crop
            mask[top : top + crop.shape[0], left : left + crop.shape[1]] = crop
        return mask

    @cached_property
    def depth_by_fruits(self) -> tuple[NDArray[np.float64], BinaryMask, tuple[float, ...]]:
        """Depth without holes with every fruit at one depth, in [m], the pixels of all fruits, and the depth of each.

        Shapes (H, W) and (H, W), and one number a fruit, NaN where none was measured.
        """
        measured, depth = self.frame.measured_m, self.frame.filled_m.copy()
        pixels, owns = np.zeros(depth.shape, np.bool_), []
        for fruit in self.fruits:
            (top, left), crop = fruit.corner, fruit.crop
            window = (slice(top, top + crop.shape[0]), slice(left, left + crop.shape[1]))
            owns.append(fruit_depth(measured[window], crop))
            if np.isfinite(owns[-1]):
                depth[window][crop] = owns[-1]
            pixels[window] |= crop
        return depth, pixels, tuple(owns)

    def rays(self, target_position: Position, fruit: int | None) -> ViewRays:
        """The pattern of rays about a target position, read from depth and masks.

        Rays into a stereo shadow tell of what is farther: without them the surroundings of every leaf seem denser.

        Args:
            target_position: Where the target is believed to be, world frame, in [m]. Shape (3,).
            fruit: Index in `fruits` of the one that is the target; None if none is.

        Returns:
            One view (B = 1), on the CPU.
        """
        return sample_view(
            self.frame.unshadowed_m,
            self.mask(fruit),
            self.frame.intrinsics,
            torch.as_tensor(self.frame.T_world_camera),
            torch.as_tensor(target_position),
            self.frame.robot_mask,
        )
