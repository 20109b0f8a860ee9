"""Files of planners that carry a network: its sizes and weights with settings, as tensors, numbers and text."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from maniskill_tomato.errors import CheckpointError
from maniskill_tomato.files import read_tensors, write_tensors
from maniskill_tomato.network_weights import fill_network

P = TypeVar("P")


def save_network(
    path: Path, kind: str, sizes: dict[str, int], weights: dict[str, Tensor], **content: Any
) -> None:
    """Writes a planner's file, whole or not at all.

    Args:
        path: Where to.
        kind: What it holds, with the version of its form.
        sizes: What builds the network.
        weights: Its state.
        content: What else the planner needs.

    Raises:
        CheckpointError: It cannot be written.
    """
    write_tensors(path, {"format": kind, "sizes": sizes, "weights": weights, **content})


def load_network(
    path: Path,
    kind: str,
    device: str | torch.device,
    build: Callable[[dict[str, Any]], tuple[P, nn.Module]],
    missing: str,
) -> P:
    """The planner of a file.

    Args:
        path: The file.
        kind: What it must hold.
        device: Where the network runs.
        build: Makes the planner and its empty network from the file's content.
        missing: What a file of another kind lacks and what makes one, for the message.

    Raises:
        CheckpointError: The file is missing, damaged, or of something else.
    """
    data = read_tensors(path, device)
    if not isinstance(data, dict) or data.get("format") != kind:
        raise CheckpointError(f"{path} holds no {missing}")
    try:
        planner, network = build(data)
        fill_network(network.to(device), data["weights"])
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise CheckpointError(f"{path} does not fit itself: {error}; train the policy again") from error
    return planner
