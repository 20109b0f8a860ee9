"""Random generators of environments: seeds for many from one, and states as plain data."""

from collections.abc import MutableSequence, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from maniskill_tomato.errors import InvalidInputError


def spread_seed(seed: int | Sequence[int], count: int) -> list[int]:
    """A seed for each of `count` environments.

    Args:
        seed: One for each; or one number, which the first takes and those of the others follow from as in ManiSkill.
        count: How many, at least 1.

    Raises:
        InvalidInputError: There are neither one nor `count` seeds.
    """
    seeds = [int(seed)] if isinstance(seed, int | np.integer) else [int(s) for s in seed]
    if len(seeds) == 1 and count > 1:
        seeds += [int(s) for s in np.random.RandomState(seeds[0]).randint(2**31, size=count - 1)]
    if len(seeds) != count:
        raise InvalidInputError(
            f"seed must be one number or {count}, one for each environment; got {len(seeds)}"
        )
    return seeds


def seed_some(
    rngs: list[np.random.RandomState],
    seeds: MutableSequence[int] | NDArray[np.int64],
    rows: Sequence[int],
    seed: int | Sequence[int],
) -> None:
    """Seeds the generators of some environments and leaves those of the others as they are.

    Args:
        rngs: Of all environments.
        seeds: What they were last seeded with.
        rows: Which are seeded.
        seed: As for `spread_seed`.
    """
    for i, one in zip(rows, spread_seed(seed, len(rows)), strict=True):
        rngs[i], seeds[i] = np.random.RandomState(one), one


def random_state(rng: np.random.RandomState) -> dict[str, Any]:
    """The state of one of NumPy's Mersenne twisters."""
    _, key, position, has_gauss, cached = rng.get_state(legacy=True)
    return {
        "key": torch.as_tensor(np.asarray(key, dtype=np.int64)),
        "position": int(position),
        "has_gauss": int(has_gauss),
        "cached_gaussian": float(cached),
    }


def set_random_state(rng: np.random.RandomState, state: dict[str, Any]) -> None:
    """Puts `rng` into the state that `random_state` gave."""
    rng.set_state(numpy_state(state))


def numpy_state(state: dict[str, Any]) -> tuple[str, Any, int, int, float]:
    """The same in NumPy's form."""
    key = state["key"].cpu().numpy().astype(np.uint32)
    return "MT19937", key, state["position"], state["has_gauss"], state["cached_gaussian"]
