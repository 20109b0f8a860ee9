"""NVIDIA Warp: a quiet start, and kernels recorded with their arguments."""

import os
import sys
from functools import cache
from typing import Any

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


class RecordedLaunch:
    """Warp kernels with their arguments, ready to run one after the other again and again at little cost.

    Warp keeps the addresses of what a recorded launch reads and writes, not the arrays themselves. They live as long
    as this object does, which holds on to the arguments.
    """

    def __init__(self, device: torch.device, *calls: tuple[Any, int | tuple[int, ...], list[Any]]) -> None:
        """Records the launches without running them.

        Args:
            device: Where they run.
            calls: For each kernel the Warp kernel, the number of its threads along each dimension, and its arguments:
                Warp arrays, structs and numbers in the order of its parameters.
        """
        self._device = device
        self._arguments = [arguments for _, _, arguments in calls]
        self._threads = [(n,) if isinstance(n, int) else n for _, n, _ in calls]
        self._rows: int | None = None
        warp_device = wp.device_from_torch(device)
        self._commands: list[Any] = [
            wp.launch(kernel, threads, inputs=arguments, device=warp_device, record_cmd=True)
            for kernel, threads, arguments in calls
        ]

    def __call__(self, rows: int | None = None) -> None:
        """Runs the kernels, on CUDA in torch's current stream.

        Args:
            rows: Runs only this number of threads along the first dimension; None for all.
        """
        if rows != self._rows:
            for command, threads in zip(self._commands, self._threads, strict=True):
                command.set_dim(threads if rows is None else (rows, *threads[1:]))
            self._rows = rows
        stream = None
        if self._device.type == "cuda":
            stream = wp.stream_from_torch(torch.cuda.current_stream(self._device))
        for command in self._commands:
            command.launch(stream)
