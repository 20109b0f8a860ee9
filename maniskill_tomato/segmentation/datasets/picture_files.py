"""Image files: RGB in memory, JPEG or PNG on the disk."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.files import write_atomically


def read_picture(path: Path) -> NDArray[np.uint8]:
    """An image file as RGB. Shape (height, width, 3).

    Raises:
        InvalidInputError: There is no such file, or it is not an image that OpenCV can decode.
    """
    if not path.is_file():
        raise InvalidInputError(f"there is no image {path}")
    picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
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
