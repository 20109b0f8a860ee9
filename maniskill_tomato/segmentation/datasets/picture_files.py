"""Image files: RGB in memory, JPEG or PNG on the disk."""

import io
import warnings
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image as PillowImage

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.files import write_atomically

LARGEST_PICTURE: Final = 178_000_000
"""In [px]. Pillow, which reads the head, stops at 179 million."""


def is_truncated_jpeg(content: bytes) -> bool:
    """Whether a file begins as a JPEG and lacks its end; decoders fill such pictures with grey."""
    if not content.startswith(b"\xff\xd8\xff"):
        return False
    # Within the data of a scan this pair of bytes does not occur.
    scan = content.rfind(b"\xff\xda")
    return scan < 0 or content.find(b"\xff\xd9", scan) < 0


def read_picture(path: Path) -> NDArray[np.uint8]:
    """An image file as RGB. Shape (height, width, 3).

    Raises:
        InvalidInputError: There is no such file, or it is not an image that OpenCV can decode, cut off, or
            too large.
    """
    picture = _decoded(path, cv2.IMREAD_COLOR)
    return np.ascontiguousarray(picture[..., ::-1], dtype=np.uint8)


def read_depth(path: Path) -> NDArray[np.float64]:
    """An image of 16 bits in millimetres as depth, in [m]. Shape (height, width).

    Raises:
        InvalidInputError: As of `read_picture`, or it has other pixels.
    """
    depth = _decoded(path, cv2.IMREAD_UNCHANGED)
    if depth.dtype != np.uint16 or depth.ndim != 2:
        raise InvalidInputError(f"{path} must be an image of one channel of 16 bits, in millimetres")
    return np.asarray(depth, dtype=np.float64) / 1000.0


def _decoded(path: Path, flags: int) -> NDArray[Any]:
    if not path.is_file():
        raise InvalidInputError(f"there is no image {path}")
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InvalidInputError(f"{path} cannot be read: {error.strerror or error}") from error
    if is_truncated_jpeg(content):
        raise InvalidInputError(f"{path} is a JPEG that ends too early; copy or download it again")
    if (size := pixels_of(content)) > LARGEST_PICTURE:
        raise InvalidInputError(f"{path} has more than {LARGEST_PICTURE} pixels, which are allowed")
    try:
        picture: Any = cv2.imdecode(np.frombuffer(content, np.uint8), flags) if size else None
    except (cv2.error, MemoryError) as error:
        raise InvalidInputError(f"{path} cannot be read as an image: {error}") from error
    if picture is None:
        raise InvalidInputError(f"{path} cannot be read as an image; use JPEG or PNG")
    decoded: NDArray[Any] = picture
    return decoded


def pixels_of(content: bytes) -> int:
    """Pixels of an image by its head, before memory is set aside for them; 0 for what is no image."""
    try:
        with warnings.catch_warnings(action="ignore"), PillowImage.open(io.BytesIO(content)) as picture:
            return picture.width * picture.height
    except PillowImage.DecompressionBombError:
        return LARGEST_PICTURE + 1
    except Exception:  # A broken head makes Pillow's readers raise whatever they meet.
        return 0


def write_picture(path: Path, image: NDArray[Any], jpeg_quality: int | None = None) -> None:
    """Writes an image as JPEG or PNG, as its name says, whole or not at all. Other names get a PNG.

    Args:
        path: The file.
        image: RGB, or one channel of 8 or 16 bits. Shape (height, width, 3) or (height, width).
        jpeg_quality: 1 to 100; OpenCV's own by default.

    Raises:
        CheckpointError: The file cannot be written.
    """
    suffix = path.suffix.lower() if path.suffix.lower() in (".jpg", ".jpeg", ".png") else ".png"
    options = [] if jpeg_quality is None else [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality]
    pixels = image[..., ::-1] if image.ndim == 3 else image
    encoded, content = cv2.imencode(suffix, np.ascontiguousarray(pixels), options)
    if not encoded:
        raise InvalidInputError(
            f"an image of shape {image.shape} and type {image.dtype} cannot be written to {path}"
        )
    write_atomically(path, content.tobytes())
