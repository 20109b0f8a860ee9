"""Starting NVIDIA Warp quietly."""

import os
import sys
from functools import cache

import torch
import warp as wp


@cache
def start_warp() -> None:
    """Starts Warp, once, without its greeting and its notes on every kernel that it loads.

    A log level that the user has set is left as it is. Where there is no GPU, Warp's native library says so
    on the process's standard error, past Python's streams; that line is dropped as well.
    """
    if wp.config.log_level != wp.LOG_INFO:
        wp.init()
        return
    wp.config.log_level = wp.LOG_WARNING
    if torch.cuda.is_available():
        wp.init()
        return
    sys.stderr.flush()
    kept = os.dup(2)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        wp.init()
    finally:
        os.dup2(kept, 2)
        os.close(nowhere)
        os.close(kept)
