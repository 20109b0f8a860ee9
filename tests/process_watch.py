"""What tests ask about processes that end by themselves."""

import time
from collections.abc import Callable
from pathlib import Path

PATIENCE = 120.0
"""Seconds that a busy machine may take to start or end two processes."""


def until(condition: Callable[[], object]) -> bool:
    """Whether a condition comes true in time."""
    end = time.monotonic() + PATIENCE
    while not condition():
        if time.monotonic() > end:
            return False
        time.sleep(0.05)
    return True


def is_running(pid: int) -> bool:
    """Whether a process exists and is not only waiting to be forgotten."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
