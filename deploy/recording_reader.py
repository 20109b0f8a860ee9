"""Reads recordings of runs: of today's format, and of the first, whose messages were all JSON."""

import base64
import struct
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.deploy.deploy_errors import CutOffError, RecordingError
from maniskill_tomato.deploy.recording import DESCRIPTION, FORMAT
from maniskill_tomato.segmentation.datasets.picture_files import LARGEST_PICTURE, pixels_of
from maniskill_tomato.text_files import parse_json

JSON_FORMAT: Final = "maniskill-tomato-deploy-1"
"""Of recordings whose pictures are in JSON."""

FORMATS: Final = (FORMAT, JSON_FORMAT)

LARGEST_RECORD: Final = 256 * 2**20
"""Of a file, in bytes."""


def read_messages(path: Path) -> Iterator[tuple[str, Any]]:
    """Topic and content of every message of a recording, in the order in which they were written.

    Yields:
        The topic, and what JSON says or a message of Protobuf with the fields of its schema. `/robot_description` is
        left out.

    Raises:
        CutOffError: The file ends early; everything before that was given.
        RecordingError: The file is missing, damaged, or no recording of ours.
    """
    try:
        from google.protobuf.message import DecodeError
        from mcap.exceptions import EndOfFile, McapError
        from mcap.records import Channel, Message, Schema
        from mcap.stream_reader import StreamReader
        from mcap_protobuf.decoder import DecoderFactory
        from zstandard import ZstdError
    except ImportError as error:
        raise RecordingError(
            f"recordings need a package that is missing ({error}): install maniskill-tomato[deploy]"
        ) from error

    if not path.is_file():
        raise RecordingError(f"no recording at {path}; `deploy run` writes run.mcap into its --out folder")
    topics: dict[int, str] = {}
    schemas: dict[int, Any] = {}
    decoders: dict[int, Callable[[bytes], Any]] = {}
    protobuf = DecoderFactory()
    with path.open("rb") as file:
        try:
            for record in StreamReader(file, validate_crcs=True, record_size_limit=LARGEST_RECORD).records:
                if isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel):
                    topics[record.id] = record.topic
                    decoder = protobuf.decoder_for(record.message_encoding, schemas.get(record.schema_id))
                    decoders[record.id] = decoder or _decoded_json
                elif isinstance(record, Message) and topics[record.channel_id] != DESCRIPTION:
                    yield topics[record.channel_id], decoders[record.channel_id](record.data)
        except (
            *(McapError, DecodeError, ValueError, KeyError, TypeError, EOFError, OSError),
            *(struct.error, zlib.error, ZstdError, RuntimeError, OverflowError, MemoryError),
        ) as error:
            if isinstance(error, EndOfFile | EOFError | struct.error) and not file.read(1):
                raise CutOffError(
                    f"{path} is cut off; `deploy replay` plays the looks that are whole"
                ) from error
            raise RecordingError(
                f"{path} is no readable recording ({type(error).__name__}: {error}); it may have been cut off"
            ) from error


def _decoded_json(data: bytes) -> dict[str, Any]:
    content = parse_json(data.decode())
    if not isinstance(content, dict):
        raise ValueError("a message is no object")
    return content


def color_picture(messages: dict[str, Any]) -> NDArray[np.uint8]:
    """The colour picture of a look's messages by topic. RGB, shape (H, W, 3).

    Raises:
        KeyError, ValueError, AttributeError, TypeError: It is missing or damaged.
    """
    message = messages["/camera/color"]
    content = base64.b64decode(message["data"]) if isinstance(message, dict) else message.data
    return np.ascontiguousarray(decode_png(content)[..., ::-1])


def depth_picture(messages: dict[str, Any], shape: tuple[int, int]) -> NDArray[np.float32]:
    """The depth of a look's messages by topic, bit by bit as it was, in [m]. Shape (H, W).

    Raises:
        KeyError, ValueError, AttributeError, TypeError: It is missing or damaged.
    """
    message = messages.get("/camera/depth_m", messages["/camera/depth"])
    if isinstance(message, dict):
        content = base64.b64decode(message["data"])
        if message["format"] == "png":
            return (decode_png(content).astype(np.float64) / 1000.0).astype(np.float32)
        unpacked = zlib.decompressobj().decompress(content, 4 * shape[0] * shape[1] + 1)
        return np.frombuffer(unpacked, dtype=np.float32).reshape(shape).copy()
    if message.encoding == "32FC1":
        return np.frombuffer(message.data, dtype="<f4").reshape(shape).astype(np.float32)
    return (np.frombuffer(message.data, dtype="<u2").reshape(shape) / 1000.0).astype(np.float32)


def decode_png(content: bytes) -> NDArray[Any]:
    """The pixels of a PNG, channels as OpenCV gives them.

    Raises:
        ValueError: It is none.
    """
    if pixels_of(content) > LARGEST_PICTURE:
        raise ValueError(f"a picture has more than {LARGEST_PICTURE} pixels")
    pixels: Any = cv2.imdecode(np.frombuffer(content, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise ValueError("a picture is damaged")
    found: NDArray[Any] = pixels
    return found


def unpack(packed: dict[str, Any]) -> NDArray[Any]:
    """What `pack` gave; numbers only.

    Raises:
        ValueError: It is something else.
    """
    kind = np.dtype(str(packed["dtype"]))
    if kind.kind not in "fiub":
        raise ValueError(f"{packed['dtype']} is no kind of number")
    return np.frombuffer(base64.b64decode(packed["data"]), dtype=kind).reshape(packed["shape"]).copy()
