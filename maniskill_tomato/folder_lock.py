"""A folder for one process at a time; the lock goes with the process, however that ends."""

import contextlib
import fcntl
import logging
import os
from collections.abc import Iterator
from pathlib import Path

from maniskill_tomato.errors import CheckpointError

logger = logging.getLogger(__name__)


@contextlib.contextmanager
def only_writer(folder: Path, does: str = "writes", option: str = "--out") -> Iterator[None]:
    """Holds a folder, which is made if it is missing; one that was made and stays empty goes again after an error.

    Args:
        folder: Which.
        does: What the processes do that must not meet there, for the message.
        option: Names the folder, likewise.

    Raises:
        CheckpointError: Another process holds it, or it cannot be made.
    """
    is_new = not folder.exists()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(folder, os.O_RDONLY)
    except OSError as error:
        raise CheckpointError(
            f"cannot write to {folder}: {error.strerror or error}; choose another {option}"
        ) from error
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise CheckpointError(
                f"another process {does} in {folder}; wait for it, or stop it first"
            ) from error
        except OSError as error:  # Some network file systems have no locks.
            logger.warning("%s cannot be locked (%s); take care that only one process uses it", folder, error)
        yield
    except BaseException:
        if is_new:
            with contextlib.suppress(OSError):
                folder.rmdir()
        raise
    finally:
        os.close(descriptor)
