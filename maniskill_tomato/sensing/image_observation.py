"""Images as policies observe them: what the wrist's camera shows, small, with the role of every pixel.

The images of a simulated world, of a simulated camera with its errors and of the robot's camera have the same layout,
so that a policy that learned on one acts on the others.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Protocol, get_args

import cv2
import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.raycast.images import CastImages, Role
from maniskill_tomato.raycast.view_rays import RANGE
from maniskill_tomato.robot.d435 import CameraIntrinsics
from maniskill_tomato.sensing.measurement import Measurement
from maniskill_tomato.sensing.perception_kinds import STATE_MODE, ImageKind, Part

CHANNELS: Final[dict[ImageKind, int]] = {"rgb": 3, "depth": 1, "segmentation": 1}

Observation = Tensor | dict[str, Tensor]
"""A state vector of shape (B, D), or `state` of that shape with images of shape (B, H, W, C), and for the critics of a
training perhaps `privileged`."""

STATE: Final = "state"
"""Key of what is known beside the images. Shape (B, D)."""

PRIVILEGED: Final = "privileged"
"""Key of what only the critics of a training see. Shape (B, D)."""

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
    - `segmentation` (H, W, 1), uint8: values of `raycast.images.Role`.
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

    def spaces(self, frames: int = 1) -> dict[str, gym.spaces.Box]:
        """The space of each image of one environment, with so many views of channels one after another."""
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

    def intrinsics(self, camera: CameraIntrinsics) -> CameraIntrinsics:
        """Of the images of a camera: its middle column of the wanted shape, over its whole height."""
        return CameraIntrinsics.from_fov(width=self.width, height=self.height, fov_y=camera.fov_y)


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


class ImageSource(Protocol):
    """Delivers the images of the last views of B environments."""

    def __call__(self, layout: ImageLayout) -> dict[str, Tensor]:
        """The images of a layout by kind, each of shape (B, H, W, C).

        Raises:
            InvalidInputError: Colours are wanted where nothing renders them.
        """
        ...


def cast_images(
    cast: CastImages, layout: ImageLayout, colours: NDArray[np.uint8] | None
) -> dict[str, Tensor]:
    """The images of a layout from ray-cast ones of its size.

    Args:
        cast: Depth and roles.
        layout: What is wanted.
        colours: Rendered pictures of any size, if colours are wanted. Shape (B, rows, columns, 3).
    """
    images: dict[str, Tensor] = {}
    if "rgb" in layout.kinds:
        images["rgb"] = _small_colours(colours, layout).to(cast.depth.device)
    if "depth" in layout.kinds:
        millimetres = (1e3 * cast.depth).round().clamp(max=LARGEST_DEPTH_MM)
        images["depth"] = millimetres.to(torch.int16)[..., None]
    if "segmentation" in layout.kinds:
        images["segmentation"] = cast.role[..., None]
    return images


def measured_images(
    views: Sequence[Measurement | None], targets: Sequence[int | None], layout: ImageLayout
) -> dict[str, Tensor]:
    """The images of a layout from what a camera measured: nothing in them is known from elsewhere.

    Fruits are those that a segmenter found; the target is the one that the fruit map takes for it. What else is nearer
    than `view_rays.RANGE` counts as leaf, because a segmenter of fruits does not tell stems from leaves.

    Args:
        views: The last view of each environment; without one its images are 0.
        targets: Index of the target among the fruits of each view; None if it does not show it.
        layout: What is wanted.

    Returns:
        On the CPU, each of shape (B, H, W, C).
    """
    images = {kind: np.zeros((len(views), *box.shape), box.dtype) for kind, box in layout.spaces().items()}
    for k, (view, target) in enumerate(zip(views, targets, strict=True)):
        if view is None:
            continue
        frame = view.frame
        near = (frame.unshadowed_m > 0.0) & (frame.unshadowed_m < RANGE)
        role = np.where(near, int(Role.LEAF), int(Role.BACKGROUND)).astype(np.uint8)
        if frame.robot_mask is not None:
            role[frame.robot_mask] = int(Role.ROBOT)
        for j in range(len(view.fruits)):
            role[view.mask(j)] = int(Role.OTHER_FRUIT)
        role[view.mask(target)] = int(Role.TARGET)
        told = picture_images(frame.measured_m, role, frame.rgb, frame.intrinsics, layout)
        for kind, image in told.items():
            images[kind][k] = image
    return {kind: torch.from_numpy(image) for kind, image in images.items()}


def picture_images(
    depth_m: NDArray[np.floating[Any]],
    role: NDArray[np.uint8],
    colours: NDArray[np.uint8] | None,
    camera: CameraIntrinsics,
    layout: ImageLayout,
) -> dict[ImageKind, NDArray[Any]]:
    """The images of a layout from one picture of a camera: depth and roles of the nearest pixel, colours averaged.

    Args:
        depth_m: Along the optical axis, in [m]; 0 where it was not measured. Shape (rows, columns).
        role: Values of `Role`. Shape (rows, columns).
        colours: Of a camera that has them. Shape (rows, columns, 3).
        camera: Intrinsics of the picture.
        layout: What is wanted.

    Returns:
        By kind, each of shape (H, W, C).

    Raises:
        InvalidInputError: Colours are wanted, and there are none.
    """
    images: dict[ImageKind, NDArray[Any]] = {}
    pixels = _nearest_pixels(layout, camera)
    if "rgb" in layout.kinds:
        images["rgb"] = _small_colours(None if colours is None else colours[None], layout)[0].numpy()
    if "depth" in layout.kinds:
        millimetres = np.minimum(1e3 * depth_m[pixels], LARGEST_DEPTH_MM).round()
        images["depth"] = millimetres.astype(np.int16)[..., None]
    if "segmentation" in layout.kinds:
        images["segmentation"] = role[pixels][..., None]
    return images


def state_of(observations: Observation) -> Tensor:
    """The state vectors of observations. Shape (B, D)."""
    return observations if isinstance(observations, Tensor) else observations[STATE]


def images_of(observations: Observation) -> dict[str, Tensor]:
    """The images of observations by kind; none of state vectors."""
    if isinstance(observations, Tensor):
        return {}
    return {name: value for name, value in observations.items() if name not in (STATE, PRIVILEGED)}


class FrameStack:
    """The last views of B environments, channel behind channel, the newest last."""

    def __init__(self, frames: int) -> None:
        """Holds nothing yet.

        Args:
            frames: How many views.
        """
        self.frames = frames
        self._held: dict[str, Tensor] = {}

    def push(self, images: dict[str, Tensor], fresh: Tensor | None = None) -> dict[str, Tensor]:
        """Takes new views in.

        Args:
            images: By kind, each of shape (B, H, W, C).
            fresh: The environments whose episode begins with this view, all the first time. Shape (B,), bool.

        Returns:
            The stacked views, each of shape (B, H, W, C x frames).
        """
        if self.frames == 1:
            return images
        stacked = {}
        for kind, new in images.items():
            first = new.repeat(1, 1, 1, self.frames)
            held = self._held.get(kind)
            if held is None:
                stacked[kind] = first
                continue
            moved = torch.cat([held[..., new.shape[-1] :], new], dim=-1)
            stacked[kind] = moved if fresh is None else torch.where(fresh[:, None, None, None], first, moved)
        self._held = stacked
        return dict(stacked)

    def state_dict(self) -> dict[str, Tensor]:
        """What is held, on the CPU."""
        return {kind: image.cpu().clone() for kind, image in self._held.items()}

    def load_state_dict(self, state: dict[str, Tensor], device: torch.device) -> None:
        """Takes back what `state_dict` gave."""
        self._held = {kind: image.to(device) for kind, image in state.items()}


def _small_colours(colours: NDArray[np.uint8] | None, layout: ImageLayout) -> Tensor:
    """Pictures cut to the shape of a layout about their middle column and averaged down. Shape (B, H, W, 3)."""
    if colours is None:
        raise InvalidInputError(
            "images with rgb need a renderer or a camera with colours; use gymnasium.make with a renderer, a "
            "perception that renders ('segmenter'), or 'depth+segmentation', which needs none"
        )
    rows, columns = colours.shape[1:3]
    kept = min(columns, round(rows * layout.width / layout.height))
    left = (columns - kept) // 2
    size = (layout.width, layout.height)
    small = [
        cv2.resize(picture[:, left : left + kept], size, interpolation=cv2.INTER_AREA) for picture in colours
    ]
    return torch.from_numpy(np.stack(small).astype(np.uint8))


def _nearest_pixels(
    layout: ImageLayout, camera: CameraIntrinsics
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Row and column of a camera's picture that each pixel of a layout looks at. Each of shape (H, W)."""
    wanted = layout.intrinsics(camera)
    x = (np.arange(layout.width) + 0.5 - wanted.cx) / wanted.fx
    y = (np.arange(layout.height) + 0.5 - wanted.cy) / wanted.fy
    columns = np.clip(np.floor(x * camera.fx + camera.cx), 0, camera.width - 1).astype(np.int64)
    rows = np.clip(np.floor(y * camera.fy + camera.cy), 0, camera.height - 1).astype(np.int64)
    return rows[:, None], columns[None, :]
