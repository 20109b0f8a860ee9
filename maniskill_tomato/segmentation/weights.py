"""Files of segmenter weights: name of the segmenter, configuration, training, tensors in half precision."""

import io
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import maniskill_tomato
from maniskill_tomato.errors import CheckpointError
from maniskill_tomato.files import read_tensors, write_atomically

FORMAT = 1
"""Version of the layout that `save_weights` documents."""


def save_weights(
    path: Path,
    kind: str,
    config: dict[str, Any],
    state: dict[str, Tensor],
    training: dict[str, Any] | None = None,
    half: bool = True,
) -> None:
    """Writes the weights of a segmenter, whole or not at all.

    Args:
        path: Where to.
        kind: Name of the segmenter that they are for.
        config: What builds its network.
        state: The network's weights.
        training: How it was trained: data, pictures seen, measured results.
        half: Keep floating-point matrices in 16 bits, for half the size; vectors, such as a normalisation's variances,
            are small and can be too large for it.

    Raises:
        CheckpointError: The file cannot be written.
    """
    kept = {name: _halved(t) if half else t for name, t in state.items()}
    buffer = io.BytesIO()
    data = {
        "format": FORMAT,
        "package_version": maniskill_tomato.__version__,
        "segmenter": kind,
        "config": config,
        "state": {name: t.detach().cpu().contiguous() for name, t in kept.items()},
        "training": training or {},
    }
    torch.save(data, buffer)
    write_atomically(path, buffer.getvalue())


def _halved(tensor: Tensor) -> Tensor:
    """A matrix in 16 bits where its values allow that; anything else as it is."""
    if not tensor.is_floating_point() or tensor.ndim < 2:
        return tensor
    half = tensor.half()
    return half if bool(half.isfinite().all()) else tensor


def load_weights(path: Path, kind: str) -> dict[str, Any]:
    """What `save_weights` wrote, with tensors in 32 bits.

    Raises:
        CheckpointError: The file is missing, damaged, of another segmenter, or not one of ours.
    """
    data = _read(path)
    if data["segmenter"] != kind:
        raise CheckpointError(f"{path} holds weights of the segmenter {data['segmenter']!r}, not of {kind!r}")
    if not isinstance(data.get("format"), int) or data["format"] > FORMAT:
        raise CheckpointError(
            f"{path} has weight format {data.get('format')}; this version, {maniskill_tomato.__version__}, reads up to "
            f"{FORMAT}: upgrade maniskill-tomato",
            newer_format=True,
        )
    state = data["state"]
    # A tensor whose numbers are not all in the file could ask for any amount of memory.
    if not isinstance(state, dict) or not all(
        isinstance(t, Tensor) and t.layout == torch.strided and t.is_contiguous() for t in state.values()
    ):
        raise CheckpointError(f"{path} holds weights that are no whole tensors; train it again")
    if not isinstance(data.get("training"), dict):
        raise CheckpointError(f"{path} does not tell its training in a table; train it again")
    data["state"] = {n: t.float() if t.is_floating_point() else t for n, t in data["state"].items()}
    return data


def read_kind(path: Path) -> str:
    """The segmenter that a file of weights is for; `yolo` for one that is not ours but named `yolo*.pt`.

    Raises:
        CheckpointError: The file is missing, damaged, or says nothing.
    """
    if path.is_file() and path.name.lower().startswith("yolo"):
        return "yolo"
    return str(_read(path)["segmenter"])


def _read(path: Path) -> dict[str, Any]:
    """The content of a file that `save_weights` wrote."""
    if not path.is_file():
        raise CheckpointError(
            f"no weights at {path}; train some with `maniskill-tomato train-segmenter`, or leave --segmenter out to "
            "use those that ship"
        )
    data = read_tensors(path)
    if not isinstance(data, dict) or not isinstance(data.get("segmenter"), str) or "state" not in data:
        raise CheckpointError(
            f"{path} holds no segmenter's weights; `maniskill-tomato train-segmenter` writes such files"
        )
    return data
