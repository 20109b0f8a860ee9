"""NVIDIA Warp: a quiet start, and kernels recorded with their arguments."""

import atexit
import logging
import os
import shutil
import sys
import tempfile
from collections.abc import Sequence
from functools import cache, lru_cache
from typing import Any, Final

import torch
import warp as wp

from maniskill_tomato.errors import UnsoundEnvironmentError

logger = logging.getLogger(__name__)

SIMULTANEOUS_LANES: Final = (
    "-march=native -mllvm=-inline-threshold=9000 -mllvm=-inline-cold-callsite-threshold=3000 "
    "-mllvm=-slp-recursion-max-depth=12 -mprefer-vector-width=256"
)
"""The module option `cpu_compiler_flags` of kernels that do the same for eight lanes: Warp's default flags but for the
depth to which LLVM looks for operations to do at once, and the bits that it does them on. Warp's depth of 4 saves
compile time and splits such loops up again. Wider than eight numbers of 32 bits LLVM joins what does not belong
together, and shuffles it apart in every round."""

CACHE_VARIABLE: Final = "WARP_CACHE_PATH"
"""Names the folder in which Warp keeps its kernels; by default it is one below the home."""


@cache
def start_warp() -> None:
    """Starts Warp, once, without its greeting and its notes on every kernel that it loads.

    A log level that the user has set is left as it is. Where there is no GPU, Warp's native library says so
    on the process's standard error, past Python's streams; that line is dropped as well.

    A home that may not be written costs the kernels, which then go to a folder that lives as long as the process.

    Raises:
        UnsoundEnvironmentError: The folder that `CACHE_VARIABLE` names cannot be written.
    """
    level = wp.config.log_level
    try:
        _start_quietly()
    except OSError as error:
        if CACHE_VARIABLE in os.environ:
            raise UnsoundEnvironmentError(
                f"warp cannot keep its kernels in {os.environ[CACHE_VARIABLE]} ({error.strerror}); set "
                f"{CACHE_VARIABLE} to a folder that may be written"
            ) from error
        folder = tempfile.mkdtemp(prefix="warp-kernels-")
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        os.environ[CACHE_VARIABLE] = folder  # For processes that this one starts.
        wp.config.kernel_cache_dir = folder
        wp.config.log_level = level
        logger.warning(
            "%s cannot be written (%s), so that kernels are compiled anew in every run; set %s to a folder that may be "
            "written",
            error.filename,
            error.strerror,
            CACHE_VARIABLE,
        )
        _start_quietly()


def _start_quietly() -> None:
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


def load_kernels() -> None:
    """Compiles and loads all Warp kernels of this package that are imported, for the CPU.

    Warp otherwise does so when each is first called: seconds for every module where its cache is empty, such as after
    an update.
    """
    start_warp()
    wp.load_module(__name__.partition(".")[0], device="cpu", recursive=True)


LARGEST_KEPT_BATCH: Final = 4096
"""Tensors of larger batches are not kept between calls."""


def room_for(rows: int) -> int:
    """The power of two in which this number of rows fits: a batch whose size changes needs few recorded launches."""
    return 1 << max(rows - 1, 0).bit_length()


RowType = tuple[tuple[int, ...], torch.dtype, Any]
"""Shape and type of a row of a batch in torch, and what Warp takes it for."""


class BatchKernel:
    """A Warp kernel over the rows of a batch: inputs, then constants, then outputs.

    The tensors and the recorded launch of each `room_for` a batch are kept, so that a call costs about ten
    microseconds. Not for use from several threads at once.
    """

    def __init__(
        self, kernel: Any, inputs: Sequence[RowType], constants: Sequence[Any], outputs: Sequence[RowType]
    ) -> None:
        """Keeps what describes the launch.

        Args:
            kernel: One thread a row.
            inputs: What a row of each input is.
            constants: Arguments between inputs and outputs that stay.
            outputs: What a row of each output is.
        """
        self._kernel, self._rows, self._constants = kernel, (*inputs, *outputs), constants
        self._inputs = len(inputs)
        self._kept = lru_cache(maxsize=16)(self._prepare)

    def __call__(self, *inputs: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Runs the kernel.

        Args:
            inputs: On one device, of any floating-point type. Shape (B, ...), B at least 1.

        Returns:
            The outputs; the next call writes into the same tensors.
        """
        batch, device = len(inputs[0]), inputs[0].device
        room = room_for(batch)
        launch, own, outputs = (
            self._kept(room, device) if room <= LARGEST_KEPT_BATCH else self._prepare(batch, device)
        )
        if batch < room <= LARGEST_KEPT_BATCH:
            own, outputs = (tuple(tensor[:batch] for tensor in tensors) for tensors in (own, outputs))
        for tensor, given in zip(own, inputs, strict=True):
            tensor.copy_(given.detach())
        launch(batch)
        return outputs

    def _prepare(
        self, batch: int, device: torch.device
    ) -> tuple["RecordedLaunch", tuple[torch.Tensor, ...], tuple[torch.Tensor, ...]]:
        start_warp()
        tensors = tuple(
            torch.zeros(batch, *shape, dtype=kind, device=device) for shape, kind, _ in self._rows
        )
        arrays = [wp.from_torch(t, dtype=kind) for t, (_, _, kind) in zip(tensors, self._rows, strict=True)]
        arguments = [*arrays[: self._inputs], *self._constants, *arrays[self._inputs :]]
        launch = RecordedLaunch(device, (self._kernel, batch, arguments))
        return launch, tensors[: self._inputs], tensors[self._inputs :]


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
