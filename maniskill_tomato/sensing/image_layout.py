"""Which images a policy observes; free of anything that is slow to import, for machines where policies only act."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, get_args

import numpy as np

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.plants.organs import Role
from maniskill_tomato.sensing.perception_kinds import STATE_MODE, ImageKind, Part

if TYPE_CHECKING:
    import gymnasium as gym

    from maniskill_tomato.robot.d435 import CameraIntrinsics

CHANNELS: Final[dict[ImageKind, int]] = {"rgb": 3, "depth": 1, "segmentation": 1}

LARGEST_DEPTH_MM: Final = 32767
"""The largest depth that an image can tell, in [mm]."""

SMALLEST_SIDE: Final = 28
"""What the convolutions of `policies.image_encoder` need."""
LARGEST_SIDE: Final = 640


@dataclass(frozen=True, kw_only=True)
class ImageLayout:
    """Which images an observation holds, as ManiSkill lays them out: rows, columns, channels.

    - `rgb` (H, W, 3), uint8: colours.
    - `depth` (H, W, 1), int16: along the optical axis, in [mm]; 0 where it was not measured.
    - `segmentation` (H, W, 1), uint8: values of `plants.organs.Role`.
    """

    kinds: tuple[ImageKind, ...]
    """Which."""
    width: int = 64
    """In [px]."""
    height: int = 48
    """In [px]."""

    def __post_init__(self) -> None:
        for kind in self.kinds:
            if kind not in CHANNELS:
                raise InvalidInputError.choice("a kind of image", kind, get_args(ImageKind))
        if not self.kinds or len(set(self.kinds)) != len(self.kinds):
            raise InvalidInputError(
                f"name each kind of image once, of {get_args(ImageKind)}; got {self.kinds}"
            )
        for name in ("width", "height"):
            side = getattr(self, name)
            if not SMALLEST_SIDE <= side <= LARGEST_SIDE:
                raise InvalidInputError(
                    f"the {name} of images must be from {SMALLEST_SIDE} to {LARGEST_SIDE} pixels; got {side}"
                )

    @classmethod
    def parse(cls, obs_mode: str, size: Sequence[int] = (64, 48)) -> "ImageLayout | None":
        """The images of an observation mode in ManiSkill's words.

        Args:
            obs_mode: `state` for none, `rgbd`, or kinds joined by `+`, such as `depth+segmentation`.
            size: Width and height, in [px].

        Raises:
            InvalidInputError: The mode is another one.
        """
        if obs_mode == STATE_MODE:
            return None
        parts = obs_mode.replace("rgbd", "rgb+depth").split("+")
        if any(part not in CHANNELS for part in parts) or len(set(parts)) != len(parts):
            raise InvalidInputError(
                f"obs_mode must be 'state', 'rgbd', or {', '.join(map(repr, CHANNELS))} joined by '+'; got {obs_mode!r}"
            )
        width, height = size
        return cls(kinds=tuple(kind for kind in CHANNELS if kind in parts), width=width, height=height)

    @property
    def needs_colours(self) -> bool:
        """Whether a camera must see colours, which only a renderer or a real one does."""
        return "rgb" in self.kinds

    @property
    def bytes_a_view(self) -> int:
        """Memory of one view, in [bytes]."""
        return sum(self.width * self.height * CHANNELS[k] * (2 if k == "depth" else 1) for k in self.kinds)

    def spaces(self, frames: int = 1) -> "dict[str, gym.spaces.Box]":
        """The space of each image of one environment, with so many views of channels one after another."""
        import gymnasium as gym  # Not where a policy only acts.

        bounds: dict[ImageKind, tuple[int, type[Any]]] = {
            "rgb": (255, np.uint8),
            "depth": (LARGEST_DEPTH_MM, np.int16),
            "segmentation": (max(Role), np.uint8),
        }
        return {
            kind: gym.spaces.Box(
                0, bounds[kind][0], (self.height, self.width, CHANNELS[kind] * frames), bounds[kind][1]
            )
            for kind in self.kinds
        }

    def intrinsics(self, camera: "CameraIntrinsics") -> "CameraIntrinsics":
        """Of the images of a camera: its middle column of the wanted shape, over its whole height."""
        return type(camera).from_fov(width=self.width, height=self.height, fov_y=camera.fov_y)


@dataclass(frozen=True, kw_only=True)
class Sight:
    """What a policy observes that sees images."""

    images: ImageLayout
    """The images."""
    frames: int = 1
    """How many views the images hold, one behind the other."""
    state_parts: tuple[Part, ...] = ("pose", "target", "time")
    """Parts of the general tasks' observation that stand beside the images; the thesis's tasks have nine numbers."""

    @property
    def shapes(self) -> dict[str, tuple[int, int, int]]:
        """Rows, columns and channels of each image."""
        layout = self.images
        return {k: (layout.height, layout.width, CHANNELS[k] * self.frames) for k in layout.kinds}


def check_images(images: Mapping[str, Any], sight: Sight, batch: int) -> None:
    """Accepts the images that a policy observes.

    Args:
        images: By kind, tensors or arrays of shape (B, H, W, C).
        sight: What it observes.
        batch: B.

    Raises:
        InvalidInputError: One is missing or has another shape.
    """
    for kind, shape in sight.shapes.items():
        found = tuple(images[kind].shape) if kind in images else "none"
        if found != (batch, *shape):
            raise InvalidInputError(f"this policy observes {kind} of shape {(batch, *shape)}, got {found}")
