"""Weights from a file put into a network: real numbers of its own kind, finite and of a plausible size."""

from collections.abc import Mapping
from typing import Final

import torch
from torch import Tensor, nn

from maniskill_tomato.errors import InvalidInputError

LARGEST_WEIGHT: Final = 1e9
"""Larger ones overflow within a few layers. The largest that ships is a variance of 6e5."""


def fill_network(network: nn.Module, state: Mapping[str, Tensor]) -> None:
    """Replaces the weights of a network.

    Args:
        network: Built for these weights.
        state: A tensor for each name of its `state_dict()`.

    Raises:
        InvalidInputError: A tensor is missing, too many, of another shape or of another kind of number, or holds
            numbers that are not finite or beyond `LARGEST_WEIGHT`. The network is as it was.
    """
    own = network.state_dict()
    names = set(state) if isinstance(state, Mapping) else set()
    if names != set(own):
        differing = ", ".join(sorted(str(name) for name in names ^ set(own))[:5])
        raise InvalidInputError(f"its weights have other names ({differing})")
    for name, expected in own.items():
        check_weight(name, state[name], expected)
    network.load_state_dict(dict(state))


def check_weight(name: str, given: object, expected: Tensor) -> None:
    """Accepts a tensor of a file that can take the place of a network's own.

    Raises:
        InvalidInputError: It cannot; the message says why.
    """
    if not isinstance(given, Tensor) or given.layout != torch.strided:
        raise InvalidInputError(f"{name} must be a plain tensor, got {type(given).__name__}")
    if given.dtype != expected.dtype or given.shape != expected.shape:
        raise InvalidInputError(
            f"{name} must be {expected.dtype} of shape {tuple(expected.shape)}, got {given.dtype} of shape "
            f"{tuple(given.shape)}"
        )
    if given.is_floating_point() and not bool((given.abs() <= LARGEST_WEIGHT).all()):
        raise InvalidInputError(f"{name} holds numbers that are not finite or beyond {LARGEST_WEIGHT:g}")
