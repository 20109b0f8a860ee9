"""Images as policies observe them: what the wrist's camera shows, small, with the role of every pixel.

The images of a simulated world, of a simulated camera with its errors and of the robot's camera have the same layout,
so that a policy that learned on one acts on the others.
"""

from collections.abc import Sequence
from typing import Any, Final, Protocol

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.plants.organs import Role
from maniskill_tomato.raycast.images import CastImages
from maniskill_tomato.raycast.view_rays import RANGE
from maniskill_tomato.robot.d435 import CameraIntrinsics
from maniskill_tomato.sensing.image_layout import LARGEST_DEPTH_MM, ImageLayout
from maniskill_tomato.sensing.measurement import Measurement
from maniskill_tomato.sensing.perception_kinds import ImageKind

Observation = Tensor | dict[str, Tensor]
"""A state vector of shape (B, D), or `state` of that shape with images of shape (B, H, W, C), and for the critics of a
training perhaps `privileged`."""

STATE: Final = "state"
"""Key of what is known beside the images. Shape (B, D)."""

PRIVILEGED: Final = "privileged"
"""Key of what only the critics of a training see. Shape (B, D)."""


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

    def push(
        self, images: dict[str, Tensor], fresh: Tensor | None = None, *, others_moved: bool = True
    ) -> dict[str, Tensor]:
        """Takes new views in.

        Args:
            images: By kind, each of shape (B, H, W, C).
            fresh: The environments whose episode begins with this view, all the first time. Shape (B,), bool.
            others_moved: Whether the view is new to the others as well; else they keep what they hold.

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
            moved = torch.cat([held[..., new.shape[-1] :], new], dim=-1) if others_moved else held
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
