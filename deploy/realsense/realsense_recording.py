"""Recordings of the SDK made from given pictures, for tests and rehearsals without a camera."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.deploy.deploy_errors import RecordingError
from maniskill_tomato.deploy.interface import Float64
from maniskill_tomato.deploy.realsense.source import load_sdk
from maniskill_tomato.robot.d435 import STEREO_BASELINE, CameraIntrinsics


def write_recording(
    path: Path,
    pictures: Iterable[tuple[NDArray[np.uint8], NDArray[np.uint16]]],
    color: CameraIntrinsics,
    depth: CameraIntrinsics,
    T_color_depth: Float64,
    *,
    depth_units: float = 0.001,
    fps: int = 30,
    stamps_s: Sequence[float] | None = None,
) -> int:
    """Writes a recording as a D435 would, through a device in software.

    Args:
        path: The file, which must end in .db3.
        pictures: Colour, RGB, shape (H, W, 3), and raw depth seen from the depth camera, in `depth_units`,
            shape (h, w).
        color: Of the colour pictures.
        depth: Of the depth pictures.
        T_color_depth: From the depth camera's optical frame to the colour camera's. Shape (4, 4).
        depth_units: Metres that one count of depth stands for.
        fps: Pictures a second.
        stamps_s: When each picture was taken, in [s]; None for one after the other at that rate.

    Returns:
        How many pairs were written.

    Raises:
        RecordingError: The name is wrong, the file cannot be written, or a picture does not fit its intrinsics.
        NotConnectedError: The SDK cannot be loaded.
    """
    sdk = load_sdk()
    if path.suffix != ".db3":
        raise RecordingError(f"a recording's name must end in .db3, got {path.name!r}")
    device = sdk.software_device()
    sensor = device.add_sensor("Stereo Module")
    profiles = {
        name: sensor.add_video_stream(_video_stream(sdk, kind, uid, pixel_format, size, intrinsics, fps))
        for name, kind, uid, pixel_format, size, intrinsics in (
            ("depth", sdk.stream.depth, 0, sdk.format.z16, 2, depth),
            ("color", sdk.stream.color, 1, sdk.format.rgb8, 3, color),
        )
    }
    extrinsics = sdk.extrinsics()
    extrinsics.rotation = T_color_depth[:3, :3].flatten(order="F").tolist()
    extrinsics.translation = T_color_depth[:3, 3].tolist()
    profiles["depth"].register_extrinsics_to(profiles["color"], extrinsics)
    sensor.add_read_only_option(sdk.option.depth_units, depth_units)
    sensor.add_read_only_option(sdk.option.stereo_baseline, 1000.0 * STEREO_BASELINE)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        recorder = sdk.recorder(str(path), device)
    except (OSError, RuntimeError) as error:
        raise RecordingError(f"cannot write {path}: {error}") from error
    recorded = recorder.query_sensors()[0]
    queue = sdk.frame_queue(100, keep_frames=False)
    recorded.open([profiles["depth"], profiles["color"]])
    recorded.start(queue)
    count = 0
    try:
        for count, (color_picture, depth_picture) in enumerate(pictures, start=1):
            for name, picture, intrinsics, size in (
                ("depth", depth_picture, depth, 2),
                ("color", color_picture, color, 3),
            ):
                if picture.shape[:2] != (intrinsics.height, intrinsics.width):
                    raise RecordingError(
                        f"{name} picture {count} has shape {picture.shape}, its intrinsics say "
                        f"{(intrinsics.height, intrinsics.width)}"
                    )
                frame = sdk.software_video_frame()
                frame.pixels = np.ascontiguousarray(picture)
                frame.bpp, frame.stride = size, size * intrinsics.width
                frame.timestamp = 1000.0 * (count / fps if stamps_s is None else stamps_s[count - 1])
                frame.domain = sdk.timestamp_domain.hardware_clock
                frame.frame_number = count
                frame.profile = profiles[name].as_video_stream_profile()
                if name == "depth":
                    frame.depth_units = depth_units
                sensor.on_video_frame(frame)
            # The recorder writes in the background and drops what comes too fast.
            for _ in range(2):
                queue.wait_for_frame(2000)
    finally:
        recorded.stop()
        recorded.close()
    return count


def _video_stream(
    sdk: Any, kind: Any, uid: int, pixel_format: Any, size: int, intrinsics: CameraIntrinsics, fps: int
) -> Any:
    stream = sdk.video_stream()
    stream.type, stream.index, stream.uid, stream.fmt = kind, 0, uid, pixel_format
    stream.width, stream.height, stream.fps, stream.bpp = intrinsics.width, intrinsics.height, fps, size
    raw = sdk.intrinsics()
    raw.width, raw.height = intrinsics.width, intrinsics.height
    # The SDK counts from the centre of the first pixel.
    raw.fx, raw.fy, raw.ppx, raw.ppy = intrinsics.fx, intrinsics.fy, intrinsics.cx - 0.5, intrinsics.cy - 0.5
    raw.model, raw.coeffs = sdk.distortion.none, [0.0] * 5
    stream.intrinsics = raw
    return stream
