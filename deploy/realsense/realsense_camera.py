"""The driver `realsense`: pictures with depth seen from the colour camera, calibrated, filtered and fresh."""

import time
from collections.abc import Mapping
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.deploy.clock import Clock
from maniskill_tomato.deploy.deploy_errors import (
    DeployError,
    DeviceTimeoutError,
    FaultError,
    NotConnectedError,
    ProtocolError,
    StaleError,
)
from maniskill_tomato.deploy.drivers import DriverContext
from maniskill_tomato.deploy.interface import Camera, Float64, Frame
from maniskill_tomato.deploy.realsense.playback_time import PlaybackTime
from maniskill_tomato.deploy.realsense.realsense_config import RealSenseConfig
from maniskill_tomato.deploy.realsense.source import FrameSource, load_sdk
from maniskill_tomato.deploy.toml_tables import parse_table
from maniskill_tomato.robot.d435 import CameraIntrinsics, min_depth

T = TypeVar("T")

MAX_DISTORTION_PX: Final = 1.0
"""Colour pictures are taken for undistorted, as a D435's are; beyond this at a corner they are refused, in [px]."""

PLAUSIBLE_LAG_S: Final = 2.0
"""A picture whose own time stamp is older than this when it arrives has a clock that means something else, in [s]."""

MAX_SKIP_S: Final = 60.0
"""So long a recording may take to get to the moment that is asked for, in [s]: its pictures are read one by one."""


class RealSenseCamera(Camera):
    """A D400 camera, live or played from a file."""

    name = "realsense"

    def __init__(self, config: RealSenseConfig, clock: Clock) -> None:
        """Touches nothing.

        Args:
            config: Which camera or recording, streams and filters.
            clock: Where the time stamps come from.
        """
        self._config = config
        self._clock = clock
        # What a file shows is not where the arm is.
        self.simulated = config.recording is not None
        self._source: FrameSource | None = None
        self._intrinsics: CameraIntrinsics | None = None
        self._depth_intrinsics: CameraIntrinsics | None = None
        self._T_color_depth: Float64 | None = None
        self._depth_units = 0.001
        self._depth_map: DepthMap | None = None
        self._filters: DepthFilters | None = None
        self._align: Any = None
        self._taken_in_view = 0
        self._last_number: int | None = None
        self._playback_time: PlaybackTime | None = None
        self._not_due: Any = None

    @property
    def is_connected(self) -> bool:
        return self._source is not None

    @property
    def intrinsics(self) -> CameraIntrinsics:
        return _connected(self._intrinsics)

    @property
    def announced_size(self) -> tuple[int, int] | None:
        # Those of a recording are the recording's.
        return None if self._config.recording is not None else self._config.color_size

    @property
    def depth_intrinsics(self) -> CameraIntrinsics:
        """Of the depth stream before it is aligned, once connected; its focal length sets the nearest depth.

        Raises:
            NotConnectedError: It is not connected.
        """
        return _connected(self._depth_intrinsics)

    @property
    def T_color_depth(self) -> Float64:
        """From the depth camera's optical frame to the colour camera's, as calibrated at the factory. Shape (4, 4).

        Raises:
            NotConnectedError: It is not connected.
        """
        return _connected(self._T_color_depth)

    @property
    def serial(self) -> str:
        return "" if self._source is None else self._source.serial or ""

    def connect(self) -> None:
        if self._source is not None:
            return
        sdk = load_sdk()
        source = FrameSource(sdk, self._config)
        try:
            self._read_calibration(sdk, source)
            self._align = sdk.align(sdk.stream.color)
            self._filters = DepthFilters(sdk, self._config)
            self._last_number, self._not_due = None, None
            self._playback_time = self._began(sdk, source)
            for _ in range(0 if source.is_recording else self._config.warm_up_frames):
                source.next(max(2.0, self._config.frame_timeout_s))
        except (DeployError, RuntimeError) as error:
            source.close()
            if isinstance(error, DeployError):
                raise
            raise FaultError(f"the camera does not tell its calibration: {error}") from error
        self._source = source
        self.begin_view()

    def disconnect(self) -> None:
        if self._source is not None:
            self._source.close()
            self._source = None

    def begin_view(self) -> None:
        if self._filters is not None:
            self._filters.restart()
        self._taken_in_view = 0

    def read(self, max_age_s: float = 0.5, after: float | None = None) -> Frame:
        source = _connected(self._source)
        allowed = max(self._config.frame_timeout_s, max_age_s)
        if self._config.temporal:
            allowed += self._config.temporal_frames / self._config.fps
        began = time.monotonic()
        deadline = began + allowed
        why_not = ""
        while time.monotonic() < deadline:
            frames, self._not_due = self._not_due or source.next(self._config.frame_timeout_s), None
            color = frames.get_color_frame()
            if not color or not frames.get_depth_frame():
                why_not = "only one of colour and depth came"
                continue
            number, stamp = int(color.get_frame_number()), self._stamp(color)
            if after is not None and stamp <= after:
                why_not = f"frame {number} was taken {after - stamp:.3f} s too early"
                if source.is_recording:
                    deadline = min(time.monotonic() + allowed, began + MAX_SKIP_S)
                continue
            if source.is_recording:
                self._wait_for(stamp, frames)
            if self._last_number is not None and number == self._last_number:
                why_not = f"frame {number} came again"
                continue
            self._last_number = number
            assert self._filters is not None
            frames = self._filters.process(frames)
            self._taken_in_view += 1
            if self._config.temporal and self._taken_in_view < self._config.temporal_frames:
                why_not = "frames for the temporal filter are missing"
                continue
            age = self._clock.now() - stamp
            if age > max_age_s:
                why_not = f"frame {number} is {age:.3f} s old, allowed are {max_age_s:g} s"
                continue
            return self._frame(frames, number, stamp)
        raise StaleError(f"no fresh picture: {why_not}; is the camera frozen, or the machine too busy?")

    def describe(self) -> dict[str, Any]:
        facts: dict[str, Any] = {"driver": self.name}
        if self._source is None or self._depth_intrinsics is None or self._T_color_depth is None:
            return facts
        color = self.intrinsics
        return facts | {
            "serial": self.serial,
            "recording": self._config.recording or "",
            "color_size": [color.width, color.height],
            "color_focal_px": [round(color.fx, 2), round(color.fy, 2)],
            "depth_size": [self._depth_intrinsics.width, self._depth_intrinsics.height],
            "nearest_depth_m": round(min_depth(self._depth_intrinsics), 3),
            "depth_units_m": round(self._depth_units, 9),
            "color_from_depth_mm": [round(1000.0 * float(v), 2) for v in self._T_color_depth[:3, 3]],
        }

    def _read_calibration(self, sdk: Any, source: FrameSource) -> None:
        color = source.profile.get_stream(sdk.stream.color).as_video_stream_profile()
        depth = source.profile.get_stream(sdk.stream.depth).as_video_stream_profile()
        self._intrinsics = _pinhole(sdk, color.get_intrinsics(), "colour")
        self._depth_intrinsics = _pinhole(sdk, depth.get_intrinsics(), "depth")
        extrinsics = depth.get_extrinsics_to(color)
        pose = np.eye(4)
        pose[:3, :3] = np.array(extrinsics.rotation, dtype=np.float64).reshape(3, 3, order="F")
        pose[:3, 3] = extrinsics.translation
        if not np.all(np.isfinite(pose)) or np.linalg.norm(pose[:3, 3]) > 0.2:
            raise FaultError(f"depth and colour are said to be {pose[:3, 3]} m apart; calibrate the camera")
        pose.setflags(write=False)
        self._T_color_depth = pose
        sensor = source.depth_sensor()
        if self._config.preset is not None and not source.is_recording:
            preset = getattr(sdk.rs400_visual_preset, self._config.preset)
            sensor.set_option(sdk.option.visual_preset, float(int(preset)))
        self._depth_units = float(sensor.get_depth_scale())
        if not 1e-6 <= self._depth_units <= 0.01:
            raise FaultError(f"the camera says that its depth counts {self._depth_units} m, which cannot be")
        self._depth_map = DepthMap(self._intrinsics, pose, self._depth_units)

    def _stamp(self, frame: Any) -> float:
        """When a frame was taken, by our clock."""
        now = self._clock.now()
        if self._playback_time is not None:
            return self._playback_time.moment(float(frame.get_timestamp()) / 1000.0, now)
        domain = load_sdk().timestamp_domain
        if frame.get_frame_timestamp_domain() in (domain.global_time, domain.system_time):
            lag = time.time() - float(frame.get_timestamp()) / 1000.0
            if -0.005 <= lag <= PLAUSIBLE_LAG_S:
                return now - max(0.0, lag)
        return now - self._config.latency_s

    def _began(self, sdk: Any, source: FrameSource) -> PlaybackTime | None:
        """A recording's time, of which nothing has been played yet; None for a camera."""
        if not source.is_recording:
            return None
        rate = float(source.profile.get_stream(sdk.stream.color).fps())
        if not 1.0 <= rate <= 1000.0:
            raise FaultError(f"the recording says that it has {rate:g} pictures a second; record it again")
        return PlaybackTime(1.0 / rate, self._config.repeat)

    def _wait_for(self, stamp: float, frames: Any) -> None:
        """Until a recording has played to a picture.

        Raises:
            DeviceTimeoutError: That takes too long; the picture is kept.
        """
        wait = stamp - self._clock.now()
        if wait > self._config.frame_timeout_s:
            self._not_due = frames
            self._clock.sleep(self._config.frame_timeout_s)
            raise DeviceTimeoutError(
                f"no picture within {self._config.frame_timeout_s:g} s; the recording's next one comes in {wait:.1f} s"
            )
        self._clock.sleep(wait)

    def _frame(self, frames: Any, number: int, stamp: float) -> Frame:
        aligned = self._align.process(frames)
        color = np.asanyarray(aligned.get_color_frame().get_data())
        depth = np.asanyarray(aligned.get_depth_frame().get_data())
        if color.dtype != np.uint8 or depth.dtype != np.uint16:
            raise ProtocolError(f"colour must be uint8 and depth uint16, got {color.dtype} and {depth.dtype}")
        return Frame(
            color=color.copy(),
            depth=_connected(self._depth_map)(depth),
            intrinsics=self.intrinsics,
            stamp=stamp,
            number=number,
        )


def _connected(value: T | None) -> T:
    if value is None:
        raise NotConnectedError("the camera is not connected; call connect()")
    return value


def _pinhole(sdk: Any, raw: Any, name: str) -> CameraIntrinsics:
    """The intrinsics of a stream without distortion worth mentioning.

    Raises:
        FaultError: It has some.
    """
    corner = [0.0, 0.0]
    point = sdk.rs2_deproject_pixel_to_point(raw, corner, 1.0)
    straight = [raw.fx * point[0] / point[2] + raw.ppx, raw.fy * point[1] / point[2] + raw.ppy]
    shift = float(np.hypot(*(np.array(straight) - corner)))
    if not shift <= MAX_DISTORTION_PX:
        raise FaultError(
            f"the {name} stream is distorted by {shift:.1f} px at its corner; this driver takes cameras that send "
            "undistorted pictures, as the D435 does"
        )
    return CameraIntrinsics.from_realsense(
        width=raw.width, height=raw.height, fx=raw.fx, fy=raw.fy, ppx=raw.ppx, ppy=raw.ppy
    )


class DepthMap:
    """The SDK's alignment moves pixels but leaves their values, which are distances along the depth camera's axis."""

    def __init__(self, color: CameraIntrinsics, T_color_depth: Float64, depth_units: float) -> None:
        """Computes each pixel's scale once.

        Args:
            color: Of the colour camera, to which depth is aligned.
            T_color_depth: From the depth camera's optical frame to the colour camera's. Shape (4, 4).
            depth_units: Metres that one count stands for.
        """
        ones = np.ones((color.height, color.width, 1))
        focal, centre = np.array([color.fx, color.fy]), np.array([color.cx, color.cy])
        rays = np.concatenate([(color.pixel_centres() - centre) / focal, ones], axis=-1)
        depth_axis = T_color_depth[:3, 2]
        # A point z ray lies at z (ray . axis) - t . axis along the depth camera's axis.
        self._scale = (1.0 / (rays @ depth_axis)).astype(np.float32)
        self._offset = np.float32(T_color_depth[:3, 3] @ depth_axis)
        self._units = np.float32(depth_units)

    def __call__(self, aligned: NDArray[np.uint16]) -> NDArray[np.float32]:
        """Depth seen from the colour camera, in [m], 0 where there is none.

        Args:
            aligned: Counts, as the SDK aligned them. Shape (H, W).

        Returns:
            Shape (H, W).
        """
        depth = (aligned * self._units + self._offset) * self._scale
        return np.where(aligned > 0, depth, np.float32(0.0)).astype(np.float32)


class DepthFilters:
    """Decimation, then in disparity spatial and temporal smoothing, then back in depth the filling of holes."""

    def __init__(self, sdk: Any, config: RealSenseConfig) -> None:
        """Makes the filters that the configuration asks for.

        Args:
            sdk: The module `pyrealsense2`.
            config: Which ones.
        """
        self._sdk = sdk
        self._config = config
        self._chain: list[Any] = []
        self.restart()

    def restart(self) -> None:
        """Forgets earlier pictures: the temporal filter takes for granted that nothing moves."""
        sdk, config = self._sdk, self._config
        in_disparity = []
        if config.spatial:
            in_disparity.append(sdk.spatial_filter())
        if config.temporal:
            in_disparity.append(sdk.temporal_filter())
        self._chain = []
        if config.decimation > 1:
            decimation = sdk.decimation_filter()
            decimation.set_option(sdk.option.filter_magnitude, config.decimation)
            self._chain.append(decimation)
        if in_disparity:
            self._chain += [sdk.disparity_transform(True), *in_disparity, sdk.disparity_transform(False)]
        if config.hole_filling:
            self._chain.append(sdk.hole_filling_filter())

    def process(self, frames: Any) -> Any:
        """The frameset with its depth filtered; colour is left alone."""
        for block in self._chain:
            frames = block.process(frames).as_frameset()
        return frames


def make_camera(options: Mapping[str, Any], context: DriverContext) -> RealSenseCamera:
    """The driver of a profile's `camera` table.

    Raises:
        ProfileError: An option is unknown or wrong.
    """
    return RealSenseCamera(parse_table(RealSenseConfig, options, "camera"), context.clock)
