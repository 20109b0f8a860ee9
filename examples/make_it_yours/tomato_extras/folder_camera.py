"""A driver of a camera: reads the pictures that another camera left in a folder, one after the other.

[camera]
driver = "folder"
folder = "pictures"     # color_000.png, depth_000.png (16 bits, in mm), color_001.png, ...; camera.json
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from maniskill_tomato.deploy.clock import Clock
from maniskill_tomato.deploy.deploy_errors import NotConnectedError, ProtocolError
from maniskill_tomato.deploy.drivers import DriverContext
from maniskill_tomato.deploy.interface import Camera, Frame
from maniskill_tomato.deploy.toml_tables import parse_table
from maniskill_tomato.robot.d435 import CameraIntrinsics


@dataclass(frozen=True, kw_only=True)
class FolderOptions:
    """The table `[camera]` of a profile."""

    folder: str
    """Of the pictures."""
    period: float = 0.1
    """From one picture to the next, in [s]."""


class FolderCamera(Camera):
    """Begins anew at the end of the folder."""

    name = "folder"
    simulated = True

    def __init__(self, options: FolderOptions, clock: Clock) -> None:
        self._folder, self._period, self._clock = Path(options.folder), options.period, clock
        self._files: list[Path] = []
        self._number = 0

    @property
    def is_connected(self) -> bool:
        return bool(self._files)

    def connect(self) -> None:
        self._files = sorted(self._folder.glob("color_*.png"))
        if not self._files or not (self._folder / "camera.json").is_file():
            self._files = []
            raise NotConnectedError(f"{self._folder} must hold color_*.png, depth_*.png and camera.json")
        missing = [str(_depth_of(path)) for path in self._files if not _depth_of(path).is_file()]
        if missing:
            self._files = []
            raise NotConnectedError(
                f"every picture needs its depth, and there is no {', '.join(missing[:3])}"
            )

    def disconnect(self) -> None:
        self._files = []

    @property
    def intrinsics(self) -> CameraIntrinsics:
        """As camera.json has them: width, height, fx, fy, cx, cy in [px]."""
        if not self._files:
            raise NotConnectedError("the camera is not connected; call connect() first")
        return CameraIntrinsics(**json.loads((self._folder / "camera.json").read_text()))

    def read(self, max_age_s: float = 0.5, after: float | None = None) -> Frame:
        intrinsics = self.intrinsics
        self._clock.sleep(self._period)
        path = self._files[self._number % len(self._files)]
        color = cv2.imread(str(path))
        depth = cv2.imread(str(_depth_of(path)), cv2.IMREAD_UNCHANGED)
        if color is None or depth is None:
            raise ProtocolError(f"{path} or its depth is no picture")
        self._number += 1
        return Frame(
            color=color[..., ::-1].astype(np.uint8),
            depth=(depth / 1000.0).astype(np.float32),
            intrinsics=intrinsics,
            stamp=self._clock.now(),
            number=self._number,
        )


def _depth_of(color: Path) -> Path:
    return color.with_name(color.name.replace("color", "depth"))


def make_camera(options: Mapping[str, Any], context: DriverContext) -> FolderCamera:
    """What the entry point names; nothing is opened yet."""
    return FolderCamera(parse_table(FolderOptions, options, "camera"), context.clock)
