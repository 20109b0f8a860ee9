"""What tensors of a world become in Gymnasium's vector interface: NumPy arrays, and masks beside an info's entries."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

Mask = NDArray[np.bool_]


def numpy_of(values: Any) -> Any:
    """Tensors, or dictionaries of them, as NumPy arrays of the same shape."""
    if isinstance(values, Mapping):
        return {name: numpy_of(value) for name, value in values.items()}
    return values.detach().cpu().numpy() if isinstance(values, Tensor) else values


def masked_info(info: Mapping[str, Any], mask: Mask) -> dict[str, Any]:
    """An info as arrays, each entry `k` with a mask `_k` of the environments that told it.

    `is_success` is `success` once more, under the name by which Stable-Baselines3 and LeRobot count successes.

    Args:
        info: Tensors with a row for each environment.
        mask: Whose info it is. Shape (N,).
    """
    arrays: dict[str, Any] = numpy_of(info)
    if "success" in arrays:
        arrays["is_success"] = arrays["success"].copy()
    return arrays | {f"_{name}": mask.copy() for name in arrays}


def rows_apart(observations: Any, mask: Mask) -> NDArray[np.object_]:
    """Batched observations as Gymnasium's `final_obs`: one object for each environment.

    Args:
        observations: An array, or a dictionary of them, with N rows.
        mask: Whose are kept; the others are None. Shape (N,).

    Returns:
        Shape (N,).
    """
    apart = np.full(len(mask), None, dtype=object)
    for i in np.flatnonzero(mask).tolist():
        apart[i] = _row(observations, i)
    return apart


def _row(observations: Any, i: int) -> Any:
    if isinstance(observations, dict):
        return {name: _row(value, i) for name, value in observations.items()}
    return observations[i].copy()
