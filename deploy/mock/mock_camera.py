"""The twin's camera behind the `Camera` interface, in flat colours or SAPIEN's, with optional faults."""

import logging
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.deploy.deploy_errors import DeviceTimeoutError, NotConnectedError, ProfileError
from maniskill_tomato.deploy.drivers import DriverContext
from maniskill_tomato.deploy.interface import Camera, Frame
from maniskill_tomato.deploy.mock.twin_world import (
    CameraFault,
    Renderer,
    TwinOptions,
    TwinWorld,
    twin_options,
    twin_world,
)
from maniskill_tomato.raycast.images import ROBOT_LABEL, Picture
from maniskill_tomato.raycast.view_rays import DEPTH_MODE
from maniskill_tomato.robot.d435 import CameraIntrinsics, min_depth
from maniskill_tomato.robot.depth_noise import DepthNoise, measure_depth

_logger = logging.getLogger(__name__)


EXPOSURE = 1.0 / 30.0
"""Between two pictures, in [s]."""

BACKGROUND = 4.0
"""Depth of what stands behind the row, in [m]: a glasshouse is no void, and a D435 sees as far."""


class MockCamera(Camera):
    """A camera that draws what the twin's arm points it at."""

    name = "mock"
    simulated = True

    def __init__(self, world: TwinWorld, options: TwinOptions, seed: int) -> None:
        self._world = world
        self._options = options
        self._seed = seed
        self._rendered = None if options.renderer == "rays" else _rendered_view(world, options.renderer)
        self._connected = False
        self._number = 0
        self._last: Frame | None = None

    @property
    def is_connected(self) -> bool:
        return self._connected

    @property
    def intrinsics(self) -> CameraIntrinsics:
        self._check()
        return self._world.intrinsics

    @property
    def announced_size(self) -> tuple[int, int] | None:
        return self._options.width, self._options.height

    def connect(self) -> None:
        self._connected = True

    def disconnect(self) -> None:
        self._connected = False

    def describe(self) -> dict[str, Any]:
        i = self._world.intrinsics
        return {
            "driver": self.name,
            "width": i.width,
            "height": i.height,
            "colours": "flat" if self._rendered is None else "sapien",
        }

    def read(self, max_age_s: float = 0.5, after: float | None = None) -> Frame:
        self._check()
        fault = self._fault()
        number, self._number = self._number, self._number + 1
        if fault == "unplugged":
            self._connected = False
            raise NotConnectedError("the camera is gone; is its USB cable plugged in?")
        if fault == "silent":
            self._world.clock.sleep(1.0)
            raise DeviceTimeoutError("the camera sent no picture within 1 s")
        self._world.clock.sleep(EXPOSURE)
        if fault == "frozen" and self._last is not None:
            return self._last
        frame = self._take(number)
        self._last = frame
        return frame if fault is None else _spoilt(frame, fault)

    def _take(self, number: int) -> Frame:
        stamp = self._world.advance()
        picture = self._world.picture()
        rng = np.random.default_rng((self._seed, number))
        exact = np.where(picture.labels == 0, np.float32(BACKGROUND), picture.depth)
        return Frame(
            color=self._color(picture),
            depth=self._measured(exact, rng),
            intrinsics=self._world.intrinsics,
            stamp=stamp,
            number=number,
            truth=self._world.truth(picture),
        )

    def _color(self, picture: Picture) -> NDArray[np.uint8]:
        """Flat colours; with a renderer the plant is SAPIEN's, and the robot, which one seldom sees, is flat."""
        flat = self._world.color(picture)
        if self._rendered is None:
            return flat
        rendered: NDArray[np.uint8] = self._rendered.color(self._world.camera_pose())
        return np.where((picture.labels == ROBOT_LABEL)[..., None], flat, rendered)

    def _measured(self, exact: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float32]:
        """What the D435's 424 x 240 mode makes of true depths [m]; without noise what it could make. Shape (H, W)."""
        factor = self._options.depth_noise
        if factor == 0.0:
            return np.where(exact >= min_depth(DEPTH_MODE), exact, np.float32(0.0))
        noise = DepthNoise().times(factor)
        depth = measure_depth(exact.astype(np.float64), self._world.intrinsics, noise, rng, stereo=DEPTH_MODE)
        return depth.astype(np.float32)

    def _fault(self) -> CameraFault | None:
        faults = self._options.faults
        first = faults.camera_from_read
        return faults.camera if first <= self._number < first + faults.camera_reads else None

    def _check(self) -> None:
        if not self._connected:
            raise NotConnectedError("the camera is not connected; call connect() first")


def _spoilt(frame: Frame, fault: CameraFault) -> Frame:
    """A picture as a broken camera gives it."""
    if fault == "late":
        return replace(frame, stamp=frame.stamp - 30.0)
    if fault == "black":
        return replace(frame, color=np.zeros_like(frame.color))
    if fault == "zero_depth":
        return replace(frame, depth=np.zeros_like(frame.depth))
    if fault == "wrong_size":
        half = frame.intrinsics.scaled(frame.intrinsics.width // 2, frame.intrinsics.height // 2)
        every_second = slice(None, 2 * half.height, 2), slice(None, 2 * half.width, 2)
        color, depth = frame.color[every_second], frame.depth[every_second]
        return replace(frame, color=color, depth=depth, intrinsics=half, truth=None)
    return frame


def make_camera(options: Mapping[str, Any], context: DriverContext) -> MockCamera:
    """The twin's camera; `options` are those of `[twin]`."""
    twin = twin_options(options)
    world = twin_world(twin, context)
    return MockCamera(world, twin, context.seed)


def _rendered_view(world: TwinWorld, renderer: Renderer) -> Any:
    """The plant as SAPIEN renders it for the simulated tasks, which needs Vulkan and ManiSkill; None without them.

    Raises:
        ProfileError: The renderer is `sapien`, and it cannot render here.
    """
    try:
        from maniskill_tomato.deploy.mock.sapien_view import SapienView

        episode = world.episode
        return SapienView(episode.plant, episode.T_world_plant.double().numpy(), world.intrinsics)
    except (ImportError, RuntimeError) as error:
        if renderer == "sapien":
            raise ProfileError(
                f"twin.renderer is 'sapien', which cannot render here ({error}); use 'rays' or 'auto', or "
                "`maniskill-tomato doctor`, which says what is missing"
            ) from error
        _logger.info("no SAPIEN renderer here (%s); the twin's pictures have flat colours", error)
        return None
