"""Recordings of runs as MCAP files: pictures, joints, masks, decisions. Foxglove and other viewers open them.

Topics, all JSON: `/info` (once: profile, policy, seed), `/camera/color`, `/camera/depth`, `/camera/mask`
(`foxglove.CompressedImage`: PNG; depth in whole millimetres), `/arm/state`, `/step` (everything else of a look, numbers
as they were), `/truth` (simulated cameras only), `/log` (`foxglove.Log`).
"""

import base64
import json
import logging
import struct
import zlib
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.deploy.deploy_errors import CutOffError, RecordingError
from maniskill_tomato.deploy.interface import Frame
from maniskill_tomato.deploy.run_records import Step

_logger = logging.getLogger(__name__)

CHUNK: Final = 32 * 1024
"""So much is kept in memory before it goes to the disk, in bytes: less than one look."""

FORMAT: Final = "maniskill-tomato-deploy-1"

_IMAGE: Final = {
    "type": "object",
    "properties": {
        "timestamp": {
            "type": "object",
            "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}},
        },
        "frame_id": {"type": "string"},
        "data": {"type": "string", "contentEncoding": "base64"},
        "format": {"type": "string"},
    },
}
_LOG: Final = {
    "type": "object",
    "properties": {
        "timestamp": _IMAGE["properties"]["timestamp"],  # type: ignore[index]
        "level": {"type": "integer"},
        "message": {"type": "string"},
        "name": {"type": "string"},
    },
}
_ANY: Final = {"type": "object"}

TOPICS: Final[dict[str, tuple[str, dict[str, Any]]]] = {
    "/info": ("maniskill_tomato.RunInfo", _ANY),
    "/camera/color": ("foxglove.CompressedImage", _IMAGE),
    "/camera/depth": ("foxglove.CompressedImage", _IMAGE),
    "/camera/mask": ("foxglove.CompressedImage", _IMAGE),
    "/arm/state": ("maniskill_tomato.ArmState", _ANY),
    "/step": ("maniskill_tomato.Step", _ANY),
    "/truth": ("maniskill_tomato.Truth", _ANY),
    "/log": ("foxglove.Log", _LOG),
}
"""Schema of each topic."""


class McapRecorder:
    """Writes a run while it happens; a context manager that finishes the file."""

    def __init__(self, path: Path, info: dict[str, Any]) -> None:
        """Begins the file.

        Args:
            path: Where to; the folder is made.
            info: What was run: profile text, policy, seed, and so on.

        Raises:
            RecordingError: It cannot be written, or the package `mcap` is missing.
        """
        try:
            from mcap.writer import Writer
        except ImportError as error:
            raise RecordingError(
                "recordings need the package mcap: install maniskill-tomato[deploy], or pass --no-record"
            ) from error
        self.path = path
        self._failed = False
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file: BinaryIO = path.open("wb")
            self._writer: Any = Writer(self._file, chunk_size=CHUNK)
            self._writer.start(library="maniskill-tomato")
            self._channels = {
                topic: self._writer.register_channel(
                    topic=topic,
                    message_encoding="json",
                    schema_id=self._writer.register_schema(
                        name=name, encoding="jsonschema", data=json.dumps(schema).encode()
                    ),
                )
                for topic, (name, schema) in TOPICS.items()
            }
        except OSError as error:
            raise self._error(error) from error
        self._write("/info", 0.0, {"format": FORMAT, **info})

    def __enter__(self) -> "McapRecorder":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Finishes the file; on a full disk what was written stays readable up to there. Never raises."""
        if not self._failed:
            try:
                self._writer.finish()
            except OSError as error:
                _logger.warning("%s", self._error(error))
        with suppress(OSError):
            self._file.close()

    def step(self, step: Step) -> None:
        frame, stamp = step.frame, step.frame.stamp
        self._write("/camera/color", stamp, _image(stamp, "camera_color_optical_frame", _bgr(frame.color)))
        depth, encoding = encode_depth(frame.depth)
        message = {"timestamp": _time(stamp), "frame_id": "camera_color_optical_frame", "format": encoding}
        self._write("/camera/depth", stamp, {**message, "data": depth})
        mask = step.view.mask.astype(np.uint8) * 255
        self._write("/camera/mask", stamp, _image(stamp, "camera_color_optical_frame", mask))
        self._write(
            "/arm/state", stamp, {"timestamp": _time(stamp), "position": step.joint_positions.tolist()}
        )
        if frame.truth is not None:
            self._write("/truth", stamp, _truth(frame))
        self._write("/step", stamp, _step(step))

    def event(self, stamp: float, text: str) -> None:
        self._write(
            "/log",
            stamp,
            {"timestamp": _time(stamp), "level": 2, "message": text, "name": "deploy"},
        )

    def _write(self, topic: str, stamp: float, message: dict[str, Any]) -> None:
        if self._failed:
            raise RecordingError(f"the recording {self.path} ended early: its disk is full or gone")
        nanoseconds = max(0, round(stamp * 1e9))
        try:
            self._writer.add_message(
                channel_id=self._channels[topic],
                log_time=nanoseconds,
                publish_time=nanoseconds,
                data=json.dumps(message).encode(),
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


def read_messages(path: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """Topic and content of every message of a recording, in the order in which they were written.

    Raises:
        CutOffError: The file ends early; everything before that was given.
        RecordingError: The file is missing, damaged, or no recording of ours.
    """
    try:
        from mcap.exceptions import EndOfFile, McapError
        from mcap.records import Channel, Message
        from mcap.stream_reader import StreamReader
    except ImportError as error:
        raise RecordingError("recordings need the package mcap: install maniskill-tomato[deploy]") from error

    if not path.is_file():
        raise RecordingError(f"no recording at {path}; `deploy run` writes run.mcap into its --out folder")
    topics: dict[int, str] = {}
    with path.open("rb") as file:
        try:
            for record in StreamReader(file, record_size_limit=256 * 2**20).records:
                if isinstance(record, Channel):
                    topics[record.id] = record.topic
                elif isinstance(record, Message):
                    content = json.loads(record.data)
                    if not isinstance(content, dict):
                        raise ValueError("a message is no object")
                    yield topics[record.channel_id], content
        except (McapError, ValueError, KeyError, EOFError, OSError, struct.error, zlib.error) as error:
            if isinstance(error, EndOfFile | EOFError | struct.error) and not file.read(1):
                raise CutOffError(
                    f"{path} is cut off; `deploy replay` plays the looks that are whole"
                ) from error
            raise RecordingError(
                f"{path} is no readable recording ({type(error).__name__}: {error}); it may have been cut off"
            ) from error


def encode_depth(depth: NDArray[np.float32]) -> tuple[str, str]:
    """A depth image without loss: PNG of whole millimetres where it has no others, else packed numbers.

    Returns:
        Base64, and the format: `png` or `zlib-float32`.
    """
    millimetres = np.round(depth.astype(np.float64) * 1000.0)
    whole = np.array_equal((millimetres / 1000.0).astype(np.float32), depth)
    if whole and float(millimetres.max(initial=0.0)) <= 65535:
        return _png(millimetres.astype(np.uint16)), "png"
    return base64.b64encode(zlib.compress(np.ascontiguousarray(depth).tobytes(), 3)).decode(), "zlib-float32"


def decode_depth(data: str, encoding: str, shape: tuple[int, int]) -> NDArray[np.float32]:
    """What `encode_depth` packed. Shape (H, W)."""
    if encoding == "png":
        return (decode_png(data).astype(np.float64) / 1000.0).astype(np.float32)
    content = zlib.decompress(base64.b64decode(data))
    return np.frombuffer(content, dtype=np.float32).reshape(shape).copy()


def decode_png(data: str) -> NDArray[Any]:
    """The pixels of a PNG in base64, channels as OpenCV gives them.

    Raises:
        ValueError: It is none.
    """
    pixels: Any = cv2.imdecode(np.frombuffer(base64.b64decode(data), dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise ValueError("a picture is damaged")
    found: NDArray[Any] = pixels
    return found


def pack(array: NDArray[Any]) -> dict[str, Any]:
    """An array as JSON, bit by bit."""
    data = base64.b64encode(np.ascontiguousarray(array).tobytes()).decode()
    return {"dtype": str(array.dtype), "shape": list(array.shape), "data": data}


def unpack(packed: dict[str, Any]) -> NDArray[Any]:
    """What `pack` gave; numbers only.

    Raises:
        ValueError: It is something else.
    """
    kind = np.dtype(str(packed["dtype"]))
    if kind.kind not in "fiub":
        raise ValueError(f"{packed['dtype']} is no kind of number")
    return np.frombuffer(base64.b64decode(packed["data"]), dtype=kind).reshape(packed["shape"]).copy()


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
        "ripe_fractions": list(truth.ripe_fractions),
        "rays": {
            "direction_c": pack(truth.rays.direction_c.numpy()),
            "distance": pack(truth.rays.distance.numpy()),
            "label": pack(truth.rays.label.numpy()),
        },
    }


def _image(stamp: float, frame_id: str, pixels: NDArray[Any]) -> dict[str, Any]:
    return {"timestamp": _time(stamp), "frame_id": frame_id, "data": _png(pixels), "format": "png"}


def _png(pixels: NDArray[Any]) -> str:
    ok, content = cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 3])
    if not ok:
        raise RecordingError(f"a picture of shape {pixels.shape} cannot be packed as PNG")
    return base64.b64encode(content.tobytes()).decode()


def _bgr(color: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.ascontiguousarray(color[..., ::-1])


def _time(stamp: float) -> dict[str, int]:
    nanoseconds = max(0, round(stamp * 1e9))
    return {"sec": nanoseconds // 10**9, "nsec": nanoseconds % 10**9}
