"""Ctrl-C, which is not lost while a package is imported that takes any exception for a missing package."""

import contextlib
import os
import signal
import threading
from collections.abc import Iterator
from types import FrameType
from typing import Final

SWALLOWS: Final = "trimesh"
"""Imports its optional packages with `except BaseException`, which takes KeyboardInterrupt too."""

PAUSE_SECONDS: Final = 0.05


@contextlib.contextmanager
def keyboard_interrupts() -> Iterator[None]:
    """Raises KeyboardInterrupt at Ctrl-C as Python does, but only after an import of `SWALLOWS`.

    Outside the main thread, and where Ctrl-C is ignored or handled already, nothing is changed.
    """
    main_thread = threading.current_thread() is threading.main_thread()
    if not main_thread or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return
    signal.signal(signal.SIGINT, _interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _interrupt(number: int, frame: FrameType | None) -> None:
    while frame is not None:
        package = str(frame.f_globals.get("__name__", "")).partition(".")[0]
        if package == SWALLOWS and frame.f_code.co_name == "<module>":
            again = threading.Timer(PAUSE_SECONDS, os.kill, (os.getpid(), number))
            again.daemon = True
            again.start()
            return
        frame = frame.f_back
    raise KeyboardInterrupt
