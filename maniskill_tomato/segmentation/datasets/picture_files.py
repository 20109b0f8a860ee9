"""Image files: RGB in memory, JPEG or PNG on the disk."""

from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.files import write_atomically

LARGEST_PICTURE: Final = 200_000_000
"""In [px]."""


def is_truncated_jpeg(content: bytes) -> bool:
    """Whether a file begins as a JPEG and lacks its end; decoders fill such pictures with grey."""
    if not content.startswith(b"\xff\xd8\xff"):
        return False
    # Within the data of a scan this pair of bytes does not occur.
    scan = content.rfind(b"\xff\xda")
    return scan < 0 or content.find(b"\xff\xd9", scan) < 0


def _png_size(content: bytes) -> int | None:
    """Pixels of a PNG by its head; None for other files."""
    if not content.startswith(b"\x89PNG\r\n\x1a\n") or len(content) < 24:
        return None
    return int.from_bytes(content[16:20], "big") * int.from_bytes(content[20:24], "big")


def read_picture(path: Path) -> NDArray[np.uint8]:
    """An image file as RGB. Shape (height, width, 3).

    Raises:
        InvalidInputError: There is no such file, or it is not an image that OpenCV can decode, cut off, or
            too large.
    """
    if not path.is_file():
        raise InvalidInputError(f"there is no image {path}")
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InvalidInputError(f"{path} cannot be read: {error.strerror or error}") from error
    if is_truncated_jpeg(content):
        raise InvalidInputError(f"{path} is a JPEG that ends too early; copy or download it again")
    if (size := _png_size(content)) is not None and size > LARGEST_PICTURE:
        raise InvalidInputError(f"{path} has {size} pixels; {LARGEST_PICTURE} are allowed")
    try:
        picture = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR) if content else None
    except (cv2.error, MemoryError) as error:
        raise InvalidInputError(f"{path} cannot be read as an image: {error}") from error
    if picture is None:
        raise InvalidInputError(f"{path} cannot be read as an image; use JPEG or PNG")
    return np.ascontiguousarray(picture[..., ::-1], dtype=np.uint8)


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
