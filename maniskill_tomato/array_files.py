"""Files of arrays that others wrote: `.npz` within limits, read without running code."""

import zipfile
import zlib
from pathlib import Path
from typing import IO, Any, Final

import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.errors import InvalidInputError

LARGEST_ARRAYS: Final = 4_000_000_000
"""Of all arrays of a file together, unpacked, in [bytes]."""


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """The arrays of an `.npz` file by their names.

    Raises:
        InvalidInputError: There is no such file, it is damaged, unpacks to more than `LARGEST_ARRAYS`, or holds
            objects.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(member.file_size for member in archive.infolist())
            if size > LARGEST_ARRAYS:
                raise InvalidInputError(f"it unpacks to {size} bytes; {LARGEST_ARRAYS} are allowed")
            for member in archive.infolist():
                with archive.open(member) as file:
                    _check_head(file, member)
        with np.load(path, allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files}
    except (
        OSError,
        ValueError,
        EOFError,
        KeyError,
        NotImplementedError,
        RuntimeError,
        SyntaxError,
        TypeError,
        MemoryError,
        zipfile.BadZipFile,
        zlib.error,
    ) as error:
        raise InvalidInputError(f"{path} cannot be read as .npz: {error}") from error


def _check_head(file: IO[bytes], member: zipfile.ZipInfo) -> None:
    """Refuses an array whose head promises more than its file holds, before memory is set aside for it."""
    version = np.lib.format.read_magic(file)
    head = (
        np.lib.format.read_array_header_1_0(file)
        if version == (1, 0)
        else np.lib.format.read_array_header_2_0(file)
    )
    shape, _, dtype = head
    if dtype.hasobject:
        raise InvalidInputError(f"{member.filename} holds Python objects, which could run code")
    count = 1
    for length in shape:
        count *= length
    if count * dtype.itemsize > member.file_size:
        raise InvalidInputError(f"{member.filename} says that it has shape {shape}, which it does not hold")
