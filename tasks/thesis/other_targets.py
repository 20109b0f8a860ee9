"""The other ripe fruits of a plant, which a view may show better than the target."""

from collections.abc import Sequence

import torch
from torch import Tensor


def other_ripe_fruits(
    ripe_fruits: Sequence[Sequence[int]], target: Tensor, count: int
) -> tuple[Tensor, Tensor]:
    """The ripe fruits that follow the target in the order of the plant's, the first again after the last.

    The order makes the choice repeatable without a random draw, and as even as that of the target.

    Args:
        ripe_fruits: Indices of the ripe fruits of each environment's plant.
        target: Index of each environment's target in `Plant.fruits`. Shape (N,).
        count: How many.

    Returns:
        Their indices, that of the target where the plant has fewer, and whether there is such a fruit. Both of
        shape (N, count), the latter bool.
    """
    fruits, exist = [], []
    for ripe, own in zip(ripe_fruits, target.tolist(), strict=True):
        at = ripe.index(own) if own in ripe else -1
        others = [fruit for fruit in (*ripe[at + 1 :], *ripe[: max(at, 0)]) if fruit != own][:count]
        missing = count - len(others)
        fruits.append(others + [own] * missing)
        exist.append([True] * len(others) + [False] * missing)
    device = target.device
    return torch.tensor(fruits, device=device), torch.tensor(exist, device=device)
