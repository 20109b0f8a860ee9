"""The D435's driver on recordings made with a device in software: what comes out is what went in, aligned and fresh."""

import importlib
import importlib.util
import math
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from maniskill_tomato.deploy.clock import MonotonicClock, SimulatedClock
from maniskill_tomato.deploy.deploy_errors import (
    DeviceTimeoutError,
    FaultError,
    NotConnectedError,
    ProfileError,
    ProtocolError,
    RecordingError,
    StaleError,
)
from maniskill_tomato.deploy.drivers import DriverContext, make_camera
from maniskill_tomato.deploy.interface import Camera
from maniskill_tomato.deploy.realsense import source as sdk_module
from maniskill_tomato.deploy.realsense.playback_time import PlaybackTime
from maniskill_tomato.deploy.realsense.realsense_camera import RealSenseCamera
from maniskill_tomato.deploy.realsense.realsense_config import RealSenseConfig
from maniskill_tomato.deploy.realsense.realsense_recording import write_recording
from maniskill_tomato.deploy.realsense.source import FrameSource
from maniskill_tomato.robot import d435

# Importing the SDK itself is the driver's business: it may need libusb first.
if importlib.util.find_spec("pyrealsense2") is None:
    pytest.skip("the extra `hardware` is not installed", allow_module_level=True)

COLOR = d435.color_intrinsics(640, 480, "measured")
DEPTH = d435.depth_intrinsics(424, 240)
# A camera as it may come out of calibration: 15 mm, and turned a little.
ANGLE = 0.01
T_COLOR_DEPTH = np.array(
    [
        [np.cos(ANGLE), 0.0, np.sin(ANGLE), 0.0148],
        [0.0, 1.0, 0.0, -0.0003],
        [-np.sin(ANGLE), 0.0, np.cos(ANGLE), 0.0002],
        [0.0, 0.0, 0.0, 1.0],
    ]
)

Picture = tuple[NDArray[np.uint8], NDArray[np.uint16]]


def picture(seed: int, depth_mm: int | None = None) -> Picture:
    rng = np.random.default_rng(seed)
    color = rng.integers(0, 256, (480, 640, 3), dtype=np.uint8)
    if depth_mm is None:
        return color, rng.integers(300, 900, (240, 424), dtype=np.uint16)
    return color, np.full((240, 424), depth_mm, np.uint16)


def record(path: Path, pictures: list[Picture], **options: Any) -> Path:
    write_recording(path, pictures, COLOR, DEPTH, T_COLOR_DEPTH, **options)
    return path


def camera(path: Path | None, clock: Any = None, **options: Any) -> Camera:
    table = options | ({"recording": str(path)} if path else {})
    return make_camera("realsense", table, DriverContext(clock=clock or SimulatedClock()))


@pytest.fixture(scope="module")
def random_recording(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, list[Picture]]]:
    pictures = [picture(seed) for seed in range(6)]
    yield record(tmp_path_factory.mktemp("recording") / "random.db3", pictures), pictures


def test_depth_and_colour_come_back_bit_for_bit(random_recording: tuple[Path, list[Picture]]) -> None:
    path, pictures = random_recording
    source = FrameSource(sdk_module.load_sdk(), RealSenseConfig(recording=str(path)))
    try:
        for color, depth in pictures:
            frames = source.next(2.0)
            np.testing.assert_array_equal(np.asanyarray(frames.get_depth_frame().get_data()), depth)
            np.testing.assert_array_equal(np.asanyarray(frames.get_color_frame().get_data()), color)
    finally:
        source.close()


def test_frames_carry_the_colour_picture_its_number_and_the_devices_calibration(
    random_recording: tuple[Path, list[Picture]],
) -> None:
    path, pictures = random_recording
    with camera(path, temporal=False) as device:
        assert isinstance(device, RealSenseCamera)
        for number, (color, _) in enumerate(pictures, start=1):
            frame = device.read()
            assert frame.number == number
            np.testing.assert_array_equal(frame.color, color)
        for name in ("fx", "fy", "cx", "cy"):
            assert getattr(device.intrinsics, name) == pytest.approx(getattr(COLOR, name), abs=1e-4)
            assert getattr(device.depth_intrinsics, name) == pytest.approx(getattr(DEPTH, name), abs=1e-4)
        np.testing.assert_allclose(device.T_color_depth, T_COLOR_DEPTH, atol=1e-6)
        assert device.describe()["nearest_depth_m"] == pytest.approx(0.084, abs=5e-4)


def test_depth_is_aligned_to_colour_as_projecting_by_hand_does(tmp_path: Path) -> None:
    """A box before a wall: the box's edges and both depths, by projecting every depth pixel on its own."""
    depth = np.full((240, 424), 800, np.uint16)
    depth[90:160, 180:260] = 400
    with camera(record(tmp_path / "box.db3", [(picture(0)[0], depth)] * 2), temporal=False) as device:
        aligned = device.read().depth
    rows, columns = np.mgrid[0:240, 0:424]
    z = depth / 1000.0
    points = np.stack(
        [(columns + 0.5 - DEPTH.cx) / DEPTH.fx * z, (rows + 0.5 - DEPTH.cy) / DEPTH.fy * z, z], axis=-1
    )
    in_color = points @ T_COLOR_DEPTH[:3, :3].T + T_COLOR_DEPTH[:3, 3]
    pixels = COLOR.project(in_color)
    inside = np.all((pixels > 1) & (pixels < [639, 479]), axis=-1)
    # Where the box hides the wall from the colour camera, or their blocks touch, the nearer one counts.
    box = (depth == 400) & inside
    u, v = pixels[..., 0], pixels[..., 1]
    left, right, top, bottom = u[box].min(), u[box].max(), v[box].min(), v[box].max()
    near_box = (u > left - 5) & (u < right + 5) & (v > top - 5) & (v < bottom + 5)
    wall = (depth == 800) & inside & ~near_box
    for part in (box, wall):
        got = aligned[v[part].astype(int), u[part].astype(int)]
        assert np.all(got > 0.0)
        # The turn of 10 mrad makes up to 6 mm between both cameras' axes; half a pixel of rounding leaves 0.1 mm.
        assert np.abs(got - in_color[part][:, 2]).max() < 2e-4
    near = aligned < 0.6
    found = np.argwhere(near & (aligned > 0.0))
    # Half a depth pixel is 1.4 colour pixels.
    assert found[:, 1].min() == pytest.approx(left - 1.4, abs=1.5)
    assert found[:, 1].max() == pytest.approx(right + 1.4, abs=1.5)
    assert found[:, 0].min() == pytest.approx(top - 1.4, abs=1.5)
    assert found[:, 0].max() == pytest.approx(bottom + 1.4, abs=1.5)


def test_depth_is_in_metres_whatever_the_devices_unit_and_zero_where_there_is_none(tmp_path: Path) -> None:
    depth = np.full((240, 424), 5000, np.uint16)
    depth[:, :212] = 0
    with camera(
        record(tmp_path / "fine.db3", [(picture(0)[0], depth)] * 2, depth_units=0.0001), temporal=False
    ) as device:
        aligned = device.read().depth
    assert aligned.dtype == np.float32
    np.testing.assert_allclose(aligned[240, 450:], 0.5, atol=0.005)  # Along the other camera's axis.
    np.testing.assert_array_equal(aligned[:, :250], 0.0)


def test_the_temporal_filter_averages_within_a_viewpoint(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    noisy = [(picture(0)[0], rng.normal(500, 3, (240, 424)).round().astype(np.uint16)) for _ in range(8)]
    path = record(tmp_path / "noisy.db3", noisy)
    with camera(path, temporal=False) as device:
        raw = device.read().depth[100:380, 150:500]
    with camera(path, temporal_frames=8) as device:
        frame = device.read()
        smooth = frame.depth[100:380, 150:500]
    assert frame.number == 8
    assert smooth.std() < 0.7 * raw.std()


def test_nothing_of_an_earlier_viewpoint_is_left_after_the_next_begins(tmp_path: Path) -> None:
    full, hole = picture(0, 500), picture(1, 500)
    hole[1][60:180, 100:300] = 0
    # More than are read: on a busy machine the SDK may drop one.
    path = record(tmp_path / "hole.db3", [full] * 4 + [hole] * 12)
    with camera(path, temporal_frames=4) as device:
        assert device.read().depth[240, 320] == pytest.approx(0.5, abs=0.002)
        device.begin_view()
        assert device.read().depth[240, 320] == 0.0
    # The test can fail: without a new viewpoint the filter keeps what was there.
    with camera(path, temporal_frames=5) as device:
        assert device.read().depth[240, 320] == pytest.approx(0.5, abs=0.002)


def test_a_frozen_camera_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with camera(record(tmp_path / "a.db3", [picture(0)] * 3), temporal=False, frame_timeout_s=0.2) as device:
        assert isinstance(device, RealSenseCamera)
        source = device._source
        assert source is not None
        frames = source.next(1.0)
        monkeypatch.setattr(source, "next", lambda timeout_s: frames)
        device.read()
        with pytest.raises(StaleError, match="frame 1 came again"):
            device.read(max_age_s=0.1)


def test_a_frame_from_before_the_arm_settled_is_not_taken(
    random_recording: tuple[Path, list[Picture]],
) -> None:
    path, _ = random_recording
    clock = SimulatedClock(50.0)
    with camera(path, clock, temporal=False, repeat=True) as device:
        frame = device.read(after=50.11)
        assert frame.number == 4 and frame.stamp == pytest.approx(50.0 + 4 / 30)
        # The file again and again: its 6 pictures last 0.2 s.
        clock.sleep(4.9)
        frame = device.read(after=55.01)
        assert 55.01 < frame.stamp < 55.06 and frame.stamp == pytest.approx(clock.now())
        with pytest.raises(DeviceTimeoutError, match="the recording's next one comes in 60"):
            device.read(max_age_s=0.1, after=clock.now() + 60.0)


def test_pictures_of_a_recording_are_as_old_as_its_own_stamps_say(
    random_recording: tuple[Path, list[Picture]], tmp_path: Path
) -> None:
    """Not as the moment says at which they happen to be read."""
    path, pictures = random_recording
    clock = SimulatedClock(10.0)
    with camera(path, clock, temporal=False) as device:
        stamps = [device.read().stamp for _ in range(2)]
        np.testing.assert_allclose(stamps, [10.0 + 1 / 30, 10.0 + 2 / 30], atol=1e-6)
        assert clock.now() == pytest.approx(stamps[-1]), "it plays no faster than the clock"
        clock.sleep(1.0)
        with pytest.raises(NotConnectedError, match="recording is over"):  # All others are too old by now.
            device.read(max_age_s=0.5)

    clock = SimulatedClock(10.0)
    spaced = record(tmp_path / "spaced.db3", pictures[:3], stamps_s=[7.0, 7.5, 12.0])
    with camera(spaced, clock, temporal=False) as device:
        assert device.read().stamp == pytest.approx(10.0 + 1 / 30)
        assert device.read().stamp == pytest.approx(10.5 + 1 / 30)
        for waited in (1.0, 2.0, 3.0):
            with pytest.raises(DeviceTimeoutError, match="the recording's next one comes in"):
                device.read()
            assert clock.now() == pytest.approx(10.5 + 1 / 30 + waited), (
                "a camera would be waited for as long"
            )
        clock.sleep(1.2)
        third = device.read()
        assert third.number == 3, "it was not lost meanwhile"
        assert third.stamp == pytest.approx(15.0 + 1 / 30)


def test_a_recording_in_real_time_is_waited_for(random_recording: tuple[Path, list[Picture]]) -> None:
    with camera(random_recording[0], MonotonicClock(), temporal=False) as device:
        first = device.read()
        began = time.monotonic()
        fourth = device.read(after=first.stamp + 0.09)
        assert fourth.number >= 4 and time.monotonic() - began > 0.05


def test_a_recording_whose_time_goes_back_is_refused(
    random_recording: tuple[Path, list[Picture]], tmp_path: Path
) -> None:
    path = record(tmp_path / "back.db3", random_recording[1][:3], stamps_s=[3.0, 3.1, 2.0])
    with camera(path, temporal=False) as device:
        for _ in range(2):
            device.read()
        with pytest.raises(ProtocolError, match=r"time goes back from 3.100 s to 2.000 s"):
            device.read()
    time_of = PlaybackTime(0.1, repeats=False)
    with pytest.raises(ProtocolError, match="nan"):
        time_of.moment(math.nan, 0.0)


def test_the_end_of_a_recording_is_said_at_once_and_repeating_goes_on(tmp_path: Path) -> None:
    path = record(tmp_path / "short.db3", [picture(seed) for seed in range(3)])
    with camera(path, temporal=False) as device:
        for _ in range(3):
            device.read()
        with pytest.raises(NotConnectedError, match="recording is over"):  # Not that no picture came in time.
            device.read()
    with camera(path, temporal=False, repeat=True) as device:
        assert [device.read().number for _ in range(5)] == [1, 2, 3, 1, 2]


def test_without_a_camera_connecting_fails_without_waiting_for_pictures() -> None:
    if len(sdk_module.load_sdk().context().query_devices()) > 0:
        pytest.skip("a camera is connected")
    for options in ({}, {"serial": "012345678901"}):
        with pytest.raises(NotConnectedError, match="no RealSense camera found"):
            camera(None, **options).connect()


def test_a_file_that_is_no_recording_is_said(tmp_path: Path) -> None:
    broken = tmp_path / "broken.db3"
    broken.write_bytes(b"SQLite format 3\0" + b"\xff" * 5000)
    with pytest.raises(NotConnectedError, match=r"recording .*broken.db3 cannot be started"):
        camera(broken).connect()
    with pytest.raises(NotConnectedError, match="no recording at"):
        camera(tmp_path / "none.db3").connect()


def test_distorted_colour_is_refused_rather_than_taken_for_straight(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from maniskill_tomato.deploy.realsense import realsense_recording as recording

    made = recording._video_stream

    def bent(sdk: Any, *rest: Any) -> Any:
        stream = made(sdk, *rest)
        raw = stream.intrinsics
        raw.model, raw.coeffs = sdk.distortion.brown_conrady, [-0.05, 0.06, 0.0, 0.0, -0.02]
        stream.intrinsics = raw
        return stream

    monkeypatch.setattr(recording, "_video_stream", bent)
    path = record(tmp_path / "bent.db3", [picture(0)])
    with pytest.raises(FaultError, match="distorted by"):
        camera(path).connect()


def test_reading_before_connecting_and_after_disconnecting_is_an_error(
    random_recording: tuple[Path, list[Picture]],
) -> None:
    device = camera(random_recording[0])
    with pytest.raises(NotConnectedError):
        device.read()
    device.connect()
    device.connect()
    device.disconnect()
    device.disconnect()
    assert not device.is_connected
    with pytest.raises(NotConnectedError):
        device.read()


def test_options_are_checked_when_the_profile_is_read() -> None:
    for options, match in (
        ({"seral": "1"}, "camera.seral is unknown"),
        ({"depth_size": [123, 45]}, "depth_size must be one of"),
        ({"serial": "1", "recording": "a.db3"}, "exclude each other"),
        ({"recording": "a.mp4"}, "must be a .db3"),
        ({"temporal_frames": 0}, "temporal_frames"),
    ):
        with pytest.raises(ProfileError, match=match):
            camera(None, **options)


def test_the_sdk_missing_is_said_with_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str, *rest: Any) -> Any:
        raise ImportError("libusb-1.0.so.0: cannot open shared object file")

    monkeypatch.setattr(importlib, "import_module", missing)
    with pytest.raises(NotConnectedError, match="extra `hardware`"):
        sdk_module.load_sdk.__wrapped__()


def test_the_sdk_is_not_loaded_before_a_camera_is_connected() -> None:
    code = (
        "import sys; from maniskill_tomato.deploy.drivers import *; from maniskill_tomato.deploy.clock import *;"
        "make_camera('realsense', {}, DriverContext(clock=MonotonicClock())); print('pyrealsense2' in sys.modules)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300)
    assert result.stdout.strip() == "False", result.stderr


def test_pictures_that_do_not_fit_are_not_recorded(tmp_path: Path) -> None:
    small = np.zeros((10, 10, 3), np.uint8), np.zeros((240, 424), np.uint16)
    with pytest.raises(RecordingError, match="color picture 1 has shape"):
        record(tmp_path / "small.db3", [small])
    with pytest.raises(RecordingError, match="must end in .db3"):
        record(tmp_path / "name.bag", [picture(0)])
