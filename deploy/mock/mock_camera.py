"""The twin's camera behind the `Camera` interface, with optional faults."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.deploy.deploy_errors import DeviceTimeoutError, NotConnectedError
from maniskill_tomato.deploy.drivers import DriverContext
from maniskill_tomato.deploy.interface import Camera, Frame
from maniskill_tomato.deploy.mock.faults import CameraFault
from maniskill_tomato.deploy.mock.painter import Painter, make_painter
from maniskill_tomato.deploy.mock.twin_options import TwinOptions, twin_options, twin_world
from maniskill_tomato.deploy.mock.twin_world import TwinWorld
from maniskill_tomato.raycast.view_rays import DEPTH_MODE
from maniskill_tomato.robot.d435 import CameraIntrinsics, min_depth
from maniskill_tomato.robot.depth_noise import DepthNoise, measure_depth

EXPOSURE = 1.0 / 30.0
"""Between two pictures, in [s]."""

BACKGROUND = 4.0
"""Depth of what stands behind the row, in [m]: a glasshouse is no void, and a D435 sees as far."""


class MockCamera(Camera):
    """A camera that draws what the twin's arm points it at."""

    name = "mock"
    simulated = True

    def __init__(self, world: TwinWorld, options: TwinOptions, seed: int, painter: Painter) -> None:
        self._world = world
        self._options = options
        self._seed = seed
        self._painter = painter
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

    def connect(self) -> None:
        self._connected = True

    def disconnect(self) -> None:
        self._connected = False

    def describe(self) -> dict[str, Any]:
        i = self._world.intrinsics
        return {"driver": self.name, "width": i.width, "height": i.height, "colours": self._painter.name}

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
            color=self._painter.paint(self._world, picture),
            depth=self._measured(exact, rng),
            intrinsics=self._world.intrinsics,
            stamp=stamp,
            number=number,
            truth=self._world.truth(picture),
        )

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
    color, depth, intrinsics, stamp, truth = (
        frame.color,
        frame.depth,
        frame.intrinsics,
        frame.stamp,
        frame.truth,
    )
    if fault == "late":
        stamp -= 30.0
    if fault == "black":
        color = np.zeros_like(color)
    if fault == "zero_depth":
        depth = np.zeros_like(depth)
    if fault == "wrong_size":
        intrinsics = intrinsics.scaled(intrinsics.width // 2, intrinsics.height // 2)
        color = np.ascontiguousarray(color[::2, ::2][: intrinsics.height, : intrinsics.width])
        depth = np.ascontiguousarray(depth[::2, ::2][: intrinsics.height, : intrinsics.width])
        truth = None
    return Frame(
        color=color, depth=depth, intrinsics=intrinsics, stamp=stamp, number=frame.number, truth=truth
    )


def make_camera(options: Mapping[str, Any], context: DriverContext) -> MockCamera:
    """The twin's camera; `options` are those of `[twin]`."""
    twin = twin_options(options)
    world = twin_world(twin, context)
    return MockCamera(world, twin, context.seed, make_painter(twin.renderer, world))
