"""The `camera` table of a profile: which RealSense camera, streams and filters to use."""

from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

from maniskill_tomato.errors import InvalidInputError, check_ranges

Preset = Literal["default", "hand", "high_accuracy", "high_density", "medium_density"]
"""Settings of the depth processor that the SDK knows by name."""

COLOR_SIZES: Final = ((424, 240), (640, 360), (640, 480), (848, 480), (960, 540), (1280, 720), (1920, 1080))
"""Sizes of the D435's colour pictures, in [px]."""

DEPTH_SIZES: Final = ((424, 240), (480, 270), (640, 360), (640, 480), (848, 480), (1280, 720))
"""Sizes of the D435's depth pictures, in [px]."""


@dataclass(frozen=True, kw_only=True)
class RealSenseConfig:
    """Options of the driver `realsense`."""

    serial: str | None = None
    """Serial number of the camera; may be left out where there is one only."""
    recording: str | None = None
    """A recording of the SDK (.db3, or .bag of older versions) to play instead of a camera."""
    repeat: bool = False
    """Whether the recording starts again at its end."""
    color_size: tuple[int, int] = (640, 480)
    """Width and height of the colour pictures, in [px]."""
    depth_size: tuple[int, int] = (424, 240)
    """Width and height of the depth pictures, in [px]: the smaller, the nearer the depth begins. 424 x 240 measures
    from 0.084 m on, 640 x 480 from 0.152 m, 848 x 480 from 0.168 m, 1280 x 720 from 0.254 m (fx baseline / 126)."""
    fps: int = 30
    """Pictures a second."""
    preset: Preset | None = None
    """Settings of the depth processor; None leaves them as they are."""
    decimation: int = 1
    """Depth is reduced by this factor; 1 leaves it."""
    spatial: bool = False
    """Whether to smooth depth within its edges."""
    temporal: bool = True
    """Whether to average depth over the pictures of one viewpoint."""
    temporal_frames: int = 4
    """Over how many; the first frame of a viewpoint comes after so many."""
    hole_filling: bool = False
    """Whether to fill pixels without depth from their neighbours. What is made up so can hide a leaf."""
    warm_up_frames: int = 15
    """Pictures thrown away after connecting, until exposure and white balance have settled; none of a recording."""
    frame_timeout_s: float = 1.0
    """The longest wait for one picture, in [s]."""
    latency_s: float = 0.1
    """Subtracted from the time at which a picture arrives, where the camera's own clock cannot be read, in [s]."""

    def __post_init__(self) -> None:
        for name, allowed in (("color_size", COLOR_SIZES), ("depth_size", DEPTH_SIZES)):
            if tuple(getattr(self, name)) not in allowed and self.recording is None:
                raise InvalidInputError.choice(name, list(getattr(self, name)), [list(s) for s in allowed])
        check_ranges(
            self,
            fps=(6, 90),
            decimation=(1, 8),
            temporal_frames=(1, 30),
            warm_up_frames=(0, 300),
            frame_timeout_s=(0.05, 10.0),
            latency_s=(0.0, 1.0),
        )
        if self.recording is not None and self.serial is not None:
            raise InvalidInputError("serial and recording exclude each other; leave one out")
        if self.recording is not None and Path(self.recording).suffix not in (".db3", ".bag"):
            raise InvalidInputError(f"recording must be a .db3 or .bag file, got {self.recording!r}")
