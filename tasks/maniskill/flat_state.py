"""Saved states as nested dictionaries of tensors: one flat vector turned back into them, and entries checked."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError


def unflatten(flat: Tensor, like: Mapping[str, Any]) -> dict[str, Any]:
    """Undoes ManiSkill's flattening, which puts the leaves' columns side by side in the order of the dictionary.

    Args:
        flat: The flat states. Shape (b, D).
        like: A state of the same structure; D is the sum of its leaves' last dimensions.

    Raises:
        InvalidInputError: `flat` has another shape.
    """
    width = sum(leaf.shape[-1] for leaf in _leaves(like))
    if flat.ndim != 2 or flat.shape[-1] != width:
        raise InvalidInputError(f"a flat state must have shape (b, {width}); got {tuple(flat.shape)}")
    columns = iter(flat.split([leaf.shape[-1] for leaf in _leaves(like)], dim=-1))  # type: ignore[no-untyped-call]

    def fill(tree: Mapping[str, Any]) -> dict[str, Any]:
        return {k: fill(v) if isinstance(v, Mapping) else next(columns) for k, v in tree.items()}

    return fill(like)


def checked_rows(state: Mapping[str, Any], path: tuple[str, str], rows: int, device: torch.device) -> Tensor:
    """One entry of a state as float32 rows.

    Args:
        state: A state dictionary.
        path: Keys of the group and of the entry in it.
        rows: How many environments it must be for.
        device: Where the result goes.

    Returns:
        Shape (rows, D).

    Raises:
        InvalidInputError: It is missing, has another number of rows, or is not finite.
    """
    group, name = path
    if group not in state or name not in state[group]:
        raise InvalidInputError(f"a state must have {group}/{name}, as get_state_dict returns it")
    values = torch.as_tensor(state[group][name], dtype=torch.float32, device=device)
    if values.ndim == 1 and rows == 1:
        values = values[None]
    if values.ndim != 2 or values.shape[0] != rows:
        raise InvalidInputError(f"{group}/{name} must have {rows} rows; got shape {tuple(values.shape)}")
    if not bool(values.isfinite().all()):
        raise InvalidInputError(f"{group}/{name} must be finite; got NaN or infinity")
    return values


def _leaves(tree: Mapping[str, Any]) -> list[Tensor]:
    return [leaf for v in tree.values() for leaf in (_leaves(v) if isinstance(v, Mapping) else [v])]
