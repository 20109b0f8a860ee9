"""How often work waits for a GPU: where the host asks for a number, a size or a copy of what the device holds.

On CUDA, PyTorch itself tells (`torch.cuda.set_sync_debug_mode`). On a CPU nothing waits; the calls are counted that
would, so that a change which adds one is seen without a GPU. A copy from the host to the host, which only looks like
one from the device, is counted too: the count on a CPU is an upper bound.
"""

import sys
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

ROOT: Final = Path(__file__).resolve().parents[2]
OWN_FOLDERS: Final = ("maniskill_tomato", "tasks", "deploy", "scripts", "tests")

NUMBER_OR_SIZE: Final = frozenset(
    {
        "aten::_local_scalar_dense",  # item(), bool(), float(), int() and indices that are tensors of one number.
        "aten::nonzero",
        "aten::masked_select",
        "aten::equal",
        "aten::is_nonzero",
        "aten::_unique2",
        "aten::unique_dim",
        "aten::unique_consecutive",
        "aten::repeat_interleave.Tensor",
        "aten::bincount",
        "aten::multinomial",
        "aten::_linalg_check_errors",
    }
)
"""Operations whose result, or its size, the host has to know."""

FROM_DEVICE: Final = frozenset({"tolist", "cpu", "numpy", "__array__"})
"""Methods of tensors that copy to the host; on a CPU no operation of PyTorch's is called."""

TO_DEVICE: Final = frozenset({"tensor", "as_tensor", "from_numpy", "new_tensor"})
"""Functions that copy lists and arrays to the device."""

ON_CPU_ONLY: Final = frozenset({"maniskill_tomato/raycast/scene.py _check_targets"})
"""Places that are not visited on CUDA."""

CUDA_WARNING: Final = "called a synchronizing CUDA operation"


def synchronisations(work: Callable[[], object], device: str | torch.device) -> "Counter[str]":
    """How often work synchronises with a device, by where in this package it does so.

    Args:
        work: Called once; what it compiles or allocates for the first time counts as well, so warm it up before.
        device: On CUDA PyTorch's own warnings are counted, else the calls that would synchronise.

    Returns:
        Counts by place, such as `tasks/world.py check_action`.
    """
    if torch.device(device).type == "cuda":
        return _counted_by_cuda(work)
    places: Counter[str] = Counter()
    with _Operations(places), _Copies(places):
        work()
    for place in ON_CPU_ONLY & places.keys():
        del places[place]
    return places


def _counted_by_cuda(work: Callable[[], object]) -> "Counter[str]":
    places: Counter[str] = Counter()

    def count(message: Warning | str, *_: Any, **__: Any) -> None:
        if CUDA_WARNING in str(message):
            places[_place()] += 1

    before = torch.cuda.get_sync_debug_mode()
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        warnings.showwarning = count
        torch.cuda.set_sync_debug_mode("warn")
        try:
            work()
        finally:
            torch.cuda.set_sync_debug_mode(before)
    return places


class _Operations(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Counts operations whose result the host must know."""

    def __init__(self, places: "Counter[str]") -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self._places = places

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        name = func.name()
        if name in NUMBER_OR_SIZE or _picks_by_mask(name, args):
            self._places[_place()] += 1
        return func(*args, **(kwargs or {}))


class _Copies(TorchFunctionMode):
    """Counts copies between the host and the device, which on a CPU call no operation."""

    def __init__(self, places: "Counter[str]") -> None:
        super().__init__()
        self._places = places

    def __torch_function__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        name = getattr(func, "__name__", "")
        if name in FROM_DEVICE or (name in TO_DEVICE and any(_of_host(argument) for argument in args[:2])):
            self._places[_place()] += 1
        return func(*args, **(kwargs or {}))


def _of_host(data: Any) -> bool:
    """Whether data lies in the host's memory."""
    return isinstance(data, np.ndarray | np.generic | list | tuple | float)


def _picks_by_mask(name: str, args: tuple[Any, ...]) -> bool:
    """Whether an operation reads or writes where a mask says so, and thereby counts the mask.

    Writing one number by a mask is a fill, for which nothing is counted.
    """
    if name not in ("aten::index.Tensor", "aten::index_put", "aten::index_put_", "aten::_index_put_impl_"):
        return False
    if name != "aten::index.Tensor" and args[2].numel() == 1:
        return False
    return any(index is not None and index.dtype in (torch.bool, torch.uint8) for index in args[1])


def _place() -> str:
    """The innermost function of this package that is under way."""
    frame = sys._getframe(1)
    while frame is not None:
        path = Path(frame.f_code.co_filename)
        if path != Path(__file__):
            resolved = path.resolve()
            if resolved.is_relative_to(ROOT) and resolved.relative_to(ROOT).parts[0] in OWN_FOLDERS:
                return f"{resolved.relative_to(ROOT)} {frame.f_code.co_name}"
        frame = frame.f_back  # type: ignore[assignment]
    return "elsewhere"
