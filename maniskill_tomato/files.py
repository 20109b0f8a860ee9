"""Files that are written whole or not at all: JSON, and tensors, which are read without running code."""

import contextlib
import io
import json
import os
import shutil
import zipfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    import torch

from maniskill_tomato.errors import CheckpointError, InvalidInputError, NotWrittenError

LARGEST_TENSORS: Final = 8_000_000_000
"""Of a file of tensors, in [bytes], packed and unpacked: a full buffer of experience has 2 GB."""


def write_atomically(path: Path, content: bytes) -> None:
    """Replaces the file `path` by one with `content` in a single step.

    Raises:
        NotWrittenError: The file cannot be written.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with temporary.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
        _sync_folder(path.parent)
    except OSError as error:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        if isinstance(error, (FileExistsError, NotADirectoryError)):
            raise NotWrittenError(
                f"cannot write {path}: a file stands where its folder should be; choose another place"
            ) from error
        raise NotWrittenError(
            f"cannot write {path}: {error.strerror or error}; what was there before is kept. Free some space "
            "or choose another place; a run goes on with --resume"
        ) from error


@contextlib.contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """A new folder that appears under its name once it is complete, or not at all.

    Args:
        path: Its name; nothing may be there but an empty folder.

    Yields:
        Where to write meanwhile, beside that.

    Raises:
        InvalidInputError: Something is there.
        NotWrittenError: It cannot be written.
    """
    if path.is_symlink() or (path.exists() and (not path.is_dir() or any(path.iterdir()))):
        raise InvalidInputError(f"{path} exists; choose another place, or delete it")
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        temporary.mkdir(parents=True)
        yield temporary
        temporary.replace(path)
        _sync_folder(path.parent)
    except OSError as error:
        shutil.rmtree(temporary, ignore_errors=True)
        raise NotWrittenError(
            f"cannot write {path}: {error.strerror or error}; nothing was left there. Free some space or choose "
            "another place"
        ) from error
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise


def refuse_inputs(option: str, out: Path, inputs: Iterable[Path]) -> None:
    """Accepts a place of a result that is none of what it is made from.

    Args:
        option: Names it in the message.
        out: The file to be written.
        inputs: The files that are read.

    Raises:
        InvalidInputError: It is one of them, whatever path leads there.
    """
    for path in inputs:
        if out.exists() and path.exists() and out.samefile(path):
            raise InvalidInputError(
                f"{option}: {out} would take the place of what is read; choose another file"
            )


def write_json(path: Path, content: Any) -> None:
    """Replaces a file by JSON with numbers that any reader accepts (no NaN).

    Raises:
        NotWrittenError: The file cannot be written.
    """
    write_atomically(path, (json.dumps(content, indent=2, allow_nan=False) + "\n").encode())


def write_tensors(path: Path, content: Any) -> None:
    """Replaces a file by what `read_tensors` reads.

    Raises:
        NotWrittenError: The file cannot be written.
    """
    import torch

    buffer = io.BytesIO()
    torch.save(content, buffer)
    write_atomically(path, buffer.getvalue())


def read_tensors(path: Path | str, device: "torch.device | str" = "cpu") -> Any:
    """What `write_tensors` wrote into a file: tensors, numbers, strings and containers of them, never code.

    Raises:
        CheckpointError: The file is missing or damaged.
    """
    import torch

    path = Path(path)
    if not path.is_file():
        raise CheckpointError(
            f"no checkpoint at {path}; `maniskill-tomato train` writes policy.pt into its run folder"
        )
    try:
        if (size := path.stat().st_size) > LARGEST_TENSORS:
            raise ValueError(f"it has {size} bytes; {LARGEST_TENSORS} are allowed")
        content = io.BytesIO(path.read_bytes())
        # torch does not compare the archive's checksums, so that flipped bits would become weights.
        with zipfile.ZipFile(content) as archive:
            if (size := sum(member.file_size for member in archive.infolist())) > LARGEST_TENSORS:
                raise ValueError(f"it unpacks to {size} bytes; {LARGEST_TENSORS} are allowed")
            if (bad := archive.testzip()) is not None:
                raise zipfile.BadZipFile(f"wrong checksum of {bad}")
        content.seek(0)
        data = torch.load(content, map_location=device, weights_only=True)
    except (
        Exception
    ) as error:  # What a broken file makes the readers of archives and tensors raise has no common base.
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise CheckpointError(
            f"{path} is not a readable checkpoint ({reason}); it may be truncated: "
            "use an earlier one from its run folder"
        ) from error
    return data


def _sync_folder(folder: Path) -> None:
    """Makes a rename in `folder` last through a power failure, where the file system can."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        with contextlib.suppress(OSError):
            os.fsync(descriptor)
    finally:
        os.close(descriptor)
