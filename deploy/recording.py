"""Recordings of runs as MCAP files that Foxglove, rerun and `deploy replay` open.

As `foxglove.*` messages in Protobuf: `/tf` (every link), `/joint_states`, `/camera/calibration`, `/camera/color`,
`/camera/mask` (PNG), `/camera/depth` (16UC1, in [mm]), `/camera/depth_m` (32FC1, in [m], where millimetres lose
something), `/camera/points`, `/arm/shape` (once) and `/log`. As ROS 2's string: `/robot_description` (once). As JSON:
`/info` (once: profile, policy, seed), `/step` (everything else of a look, numbers as they were), `/truth` (simulated
cameras only) and `/fault` (the last message of a run that a fault ended). All times are the run's clock, counted from
the date at which the recording began.
"""

import base64
import json
import logging
import struct
import time
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.deploy.clock import Clock
from maniskill_tomato.deploy.deploy_errors import RecordingError
from maniskill_tomato.deploy.depth_units import in_millimetres
from maniskill_tomato.deploy.fault_state import FaultState
from maniskill_tomato.deploy.interface import Float64, Frame
from maniskill_tomato.deploy.recording_schemas import FAULT, INFO, STEP, TRUTH
from maniskill_tomato.deploy.run_records import Step
from maniskill_tomato.deploy.viewer_arm import link_frames, simple_urdf
from maniskill_tomato.robot.arm_model import ArmModel
from maniskill_tomato.robot.iiwa14 import IIWA14

_logger = logging.getLogger(__name__)

CHUNK: Final = 32 * 1024
"""So much is kept in memory before it goes to the disk, in bytes: less than one look."""

FORMAT: Final = "maniskill-tomato-deploy-2"

JSON_TOPICS: Final = {
    "/info": ("maniskill_tomato.RunInfo", INFO),
    "/step": ("maniskill_tomato.Step", STEP),
    "/truth": ("maniskill_tomato.Truth", TRUTH),
    "/fault": ("maniskill_tomato.Fault", FAULT),
}
"""Name and JSON Schema of our own messages."""

VIEWER_TOPICS: Final = {
    "/tf": "FrameTransforms",
    "/joint_states": "JointStates",
    "/camera/calibration": "CameraCalibration",
    "/camera/color": "CompressedImage",
    "/camera/mask": "CompressedImage",
    "/camera/depth": "RawImage",
    "/camera/depth_m": "RawImage",
    "/camera/points": "PointCloud",
    "/arm/shape": "SceneUpdate",
    "/log": "Log",
}
"""The `foxglove` message of each topic for viewers."""

DESCRIPTION: Final = "/robot_description"


class McapRecorder:
    """Writes a run while it happens; a context manager that finishes the file."""

    def __init__(
        self,
        path: Path,
        info: dict[str, Any],
        clock: Clock,
        T_flange_camera: Float64,
        model: ArmModel = IIWA14,
    ) -> None:
        """Begins the file.

        Args:
            path: Where to; the folder is made.
            info: What was run: profile text, policy, seed, and so on.
            clock: The run's, which stamps of pictures and events come from.
            T_flange_camera: The colour camera's optical frame in `link_ee`. Shape (4, 4).
            model: Of the arm.

        Raises:
            RecordingError: It cannot be written, or a package is missing.
        """
        try:
            from foxglove import messages
            from mcap.writer import Writer

            from maniskill_tomato.deploy import viewer_messages
        except ImportError as error:
            raise RecordingError(
                f"recordings need a package that is missing ({error}): install maniskill-tomato[deploy], or pass "
                "--no-record"
            ) from error
        self.path = path
        self._failed = self._is_finished = False
        self._made, self._timestamp = viewer_messages, messages.Timestamp
        self._T_flange_camera, self._model = T_flange_camera, model
        self._clock_start, self._unix_start_ns = clock.now(), time.time_ns()
        schemas = {name: getattr(messages, name).get_schema() for name in VIEWER_TOPICS.values()}
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file: BinaryIO = path.open("wb")
            self._writer: Any = Writer(self._file, chunk_size=CHUNK)
            self._writer.start(library="maniskill-tomato")
            ids = {
                name: self._writer.register_schema(name=s.name, encoding=s.encoding, data=s.data)
                for name, s in schemas.items()
            }
            self._channels = {
                topic: self._channel(topic, "protobuf", ids[name]) for topic, name in VIEWER_TOPICS.items()
            }
            for topic, (name, schema) in JSON_TOPICS.items():
                text = json.dumps({"title": name, **schema}).encode()
                number = self._writer.register_schema(name=name, encoding="jsonschema", data=text)
                self._channels[topic] = self._channel(topic, "json", number)
            text = self._writer.register_schema(
                name="std_msgs/msg/String", encoding="ros2msg", data=b"string data"
            )
            self._channels[DESCRIPTION] = self._channel(DESCRIPTION, "cdr", text)
        except OSError as error:
            raise self._error(error) from error
        start = {"clock_start": self._clock_start, "unix_start_ns": self._unix_start_ns}
        self._write_json(
            "/info", self._clock_start, {"format": FORMAT, "arm_model": model.name, **start, **info}
        )
        urdf = simple_urdf(model)
        self._write(DESCRIPTION, self._clock_start, _ros_string(urdf))
        began = self._time(self._clock_start)
        self._write("/arm/shape", self._clock_start, viewer_messages.arm_shape(began, urdf).encode())

    def __enter__(self) -> "McapRecorder":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Finishes the file; on a full disk what was written stays readable up to there. Never raises."""
        try:
            self._finish()
        except RecordingError as error:
            _logger.warning("%s", error)
        with suppress(OSError):
            self._file.close()

    def fault(self, fault: FaultState) -> None:
        """Writes what is known of a fault, and finishes the file: whoever asks is told whether it is kept.

        Raises:
            RecordingError: It is not.
        """
        stamp = self._clock_start if fault.stamp is None else fault.stamp
        self._write_json("/fault", stamp, fault.to_json())
        self._finish()

    def _finish(self) -> None:
        if self._failed or self._is_finished:
            return
        self._is_finished = True
        try:
            self._writer.finish()
            self._file.flush()
        except OSError as error:
            self._failed = True
            raise self._error(error) from error

    def step(self, step: Step) -> None:
        frame, stamp, made = step.frame, step.frame.stamp, self._made
        at = self._time(stamp)
        millimetres, is_exact = in_millimetres(frame.depth)
        links = link_frames(step.joint_positions, self._T_flange_camera, self._model)
        # Viewers place a picture by the transforms that came before it.
        self._write("/tf", stamp, made.transforms(at, links).encode())
        self._write(
            "/joint_states",
            stamp,
            made.joint_states(at, self._model.joint_names, step.joint_positions).encode(),
        )
        self._write("/camera/calibration", stamp, made.calibration(at, frame.intrinsics).encode())
        self._write("/camera/color", stamp, made.picture(at, frame.color).encode())
        self._write("/camera/depth", stamp, made.depth_image(at, millimetres).encode())
        if not is_exact:
            self._write("/camera/depth_m", stamp, made.depth_image(at, frame.depth).encode())
        self._write("/camera/points", stamp, made.points(at, frame).encode())
        mask = step.view.mask.astype(np.uint8) * 255
        self._write("/camera/mask", stamp, made.picture(at, mask).encode())
        if frame.truth is not None:
            self._write_json("/truth", stamp, _truth(frame))
        self._write_json("/step", stamp, _step(step))

    def event(self, stamp: float, text: str) -> None:
        self._write("/log", stamp, self._made.log_line(self._time(stamp), text).encode())

    def _channel(self, topic: str, encoding: str, schema_id: int) -> int:
        number: int = self._writer.register_channel(
            topic=topic, message_encoding=encoding, schema_id=schema_id
        )
        return number

    def _nanoseconds(self, stamp: float) -> int:
        """A moment of the run's clock as a date, in [ns] since 1970."""
        return self._unix_start_ns + round((stamp - self._clock_start) * 1e9)

    def _time(self, stamp: float) -> Any:
        seconds, nanoseconds = divmod(self._nanoseconds(stamp), 10**9)
        return self._timestamp(seconds, nanoseconds)

    def _write_json(self, topic: str, stamp: float, message: dict[str, Any]) -> None:
        self._write(topic, stamp, json.dumps(message).encode())

    def _write(self, topic: str, stamp: float, data: bytes) -> None:
        if self._failed:
            raise RecordingError(f"the recording {self.path} ended early: its disk is full or gone")
        nanoseconds = self._nanoseconds(stamp)
        try:
            self._writer.add_message(
                channel_id=self._channels[topic], log_time=nanoseconds, publish_time=nanoseconds, data=data
            )
            self._file.flush()
        except OSError as error:
            self._failed = True
            raise self._error(error) from error

    def _error(self, error: OSError) -> RecordingError:
        return RecordingError(
            f"cannot write the recording {self.path}: {error.strerror or error}; free some space, choose another "
            "--out, or pass --no-record"
        )


def pack(array: NDArray[Any]) -> dict[str, Any]:
    """An array as JSON, bit by bit."""
    data = base64.b64encode(np.ascontiguousarray(array).tobytes()).decode()
    return {"dtype": str(array.dtype), "shape": list(array.shape), "data": data}


def _step(step: Step) -> dict[str, Any]:
    i = step.frame.intrinsics
    return {
        "number": step.number,
        "stamp": step.frame.stamp,
        "frame_number": step.frame.number,
        "intrinsics": {
            "width": i.width,
            "height": i.height,
            "fx": i.fx,
            "fy": i.fy,
            "cx": i.cx,
            "cy": i.cy,
        },
        "joint_positions": step.joint_positions.tolist(),
        "T_world_camera": step.T_world_camera.tolist(),
        "target_position": step.target_position.tolist(),
        "visible_fraction": step.view.visible_fraction,
        "fraction_margin": step.view.fraction_margin,
        "fruits_seen": step.view.fruits_seen,
        "moves_left": step.moves_left,
        "action": step.action,
        "commanded": None if step.commanded is None else step.commanded.tolist(),
        "outcome": step.outcome,
        "detail": step.detail,
        "timing_ms": step.timing_ms,
    }


def _truth(frame: Frame) -> dict[str, Any]:
    assert frame.truth is not None
    truth = frame.truth
    return {
        "labels": _png(truth.labels.astype(np.uint16)),
        "target_label": truth.target_label,
        "target_position": truth.target_position.tolist(),
        "visible_fraction": truth.visible_fraction,
        "ripe_labels": list(truth.ripe_labels),
        "fruit_labels": list(truth.fruit_labels),
        "stem_labels": list(truth.stem_labels),
        "ripe_fractions": list(truth.ripe_fractions),
        "rays": {
            "direction_c": pack(truth.rays.direction_c.numpy()),
            "distance": pack(truth.rays.distance.numpy()),
            "label": pack(truth.rays.label.numpy()),
        },
    }


def _png(pixels: NDArray[Any]) -> str:
    ok, content = cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 3])
    if not ok:
        raise RecordingError(f"a picture of shape {pixels.shape} cannot be packed as PNG")
    return base64.b64encode(content.tobytes()).decode()


def _ros_string(text: str) -> bytes:
    """A `std_msgs/msg/String` in CDR, little-endian."""
    content = text.encode() + b"\0"
    return b"\0\1\0\0" + struct.pack("<I", len(content)) + content
