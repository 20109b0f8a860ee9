"""A camera's picture with depth and the pose that it was taken from: all that sensing asks of a device."""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.robot.d435 import CameraIntrinsics
from maniskill_tomato.segmentation.instances import Instances
from maniskill_tomato.segmentation.masks import BinaryMask
from maniskill_tomato.sensing.visible_fraction.estimate import Float64, filled_depth


@dataclass(frozen=True, eq=False, kw_only=True)
class PosedFrame:
    """One picture of an RGB-D camera, real or simulated, with depth aligned to colour."""

    depth_m: NDArray[np.float32]
    """Along the optical axis, in [m]; 0 or not finite where there is no measurement. Shape (H, W)."""
    intrinsics: CameraIntrinsics
    """Of colours and depth."""
    T_world_camera: NDArray[np.float64]
    """Pose of the optical frame in the robot's base frame, translation in [m]. Shape (4, 4)."""
    rgb: NDArray[np.uint8] | None = None
    """Colours; None from a camera that has none, such as a ray-cast one. Shape (H, W, 3)."""
    robot_mask: BinaryMask | None = None
    """Where the picture shows the robot itself, if that is known. Shape (H, W)."""
    true_fruits: Instances | None = None
    """The fruits that a simulated camera knows to be in the picture, for perfect segmentation."""
    told_fruits: Instances | None = None
    """What a simulated segmenter finds in it; a detector without a segmenter takes these."""
    true_numbers: tuple[int, ...] = ()
    """Which these are, as indices in `Plant.fruits`; empty where that is not known."""

    def __post_init__(self) -> None:
        size = (self.intrinsics.height, self.intrinsics.width)
        for name, array, shape in (
            ("depth_m", self.depth_m, size),
            ("rgb", self.rgb, (*size, 3)),
            ("robot_mask", self.robot_mask, size),
            ("T_world_camera", self.T_world_camera, (4, 4)),
        ):
            if array is not None and array.shape != shape:
                raise InvalidInputError(f"{name} must have shape {shape}, got {array.shape}")

    @cached_property
    def measured_m(self) -> Float64:
        """Depth in [m], 0 where there is no measurement. Shape (H, W)."""
        raw = self.depth_m
        return np.where(np.isfinite(raw) & (raw > 0), raw, 0.0).astype(np.float64)

    @cached_property
    def filled_m(self) -> Float64:
        """The same without holes (`filled_depth`). Shape (H, W)."""
        return filled_depth(self.measured_m)

    @cached_property
    def unshadowed_m(self) -> NDArray[np.float32]:
        """The same without the holes that stereo shadows make; 0 in others, such as where something is too near.

        Shape (H, W).
        """
        return filled_depth(self.measured_m, self.intrinsics.fx).astype(np.float32)

    def shown_fruit(self, mask: BinaryMask) -> int | None:
        """Which fruit most pixels of a mask show, as an index in `Plant.fruits`.

        Args:
            mask: Of a detection. Shape (H, W).

        Returns:
            None if less than half of them show any one fruit, or if the camera does not know.
        """
        if self.true_fruits is None or not self.true_numbers:
            return None
        left, top, width, height = cv2.boundingRect(mask.view(np.uint8))
        window = (slice(top, top + height), slice(left, left + width))
        crop = mask[window]
        shared = [np.count_nonzero(fruit[window] & crop) for fruit in self.true_fruits.masks]
        best = int(np.argmax(shared))
        return self.true_numbers[best] if 2 * shared[best] >= np.count_nonzero(crop) else None
