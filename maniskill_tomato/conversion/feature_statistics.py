"""What LeRobot keeps of every feature to scale it by: extremes, mean, deviation and quantiles.

As in LeRobot, those of a data set are put together from those of its episodes, so that what its tools work out after an
episode was taken away is the same; quantiles are then means, weighted by the episodes' lengths.
"""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

Statistics = dict[str, NDArray[Any]]
"""`min`, `max`, `mean`, `std` and the quantiles, all of one shape, and `count`, of shape (1,)."""

QUANTILES: Final = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}


def number_statistics(values: NDArray[Any]) -> Statistics:
    """Of numbers over their frames.

    Args:
        values: Shape (N, D).

    Returns:
        Each of shape (D,).
    """
    numbers = values.astype(np.float64)
    found: Statistics = {
        "min": numbers.min(axis=0),
        "max": numbers.max(axis=0),
        "mean": numbers.mean(axis=0),
        "std": numbers.std(axis=0),
        "count": np.array([len(numbers)]),
    }
    for name, share in QUANTILES.items():
        found[name] = np.quantile(numbers, share, axis=0, method="inverted_cdf")
    return found


class PixelStatistics:
    """Of the pixels of images, which are counted by their values: exact, and no image is kept."""

    def __init__(self, channels: int, values: int, scale: float) -> None:
        """Begins without an image.

        Args:
            channels: C.
            values: How many values a pixel can have, from 0 on.
            scale: By what they are divided.
        """
        self._counts = np.zeros((channels, values), dtype=np.int64)
        self._scale = scale
        self._images = 0

    def add(self, image: NDArray[Any]) -> None:
        """Counts an image. Shape (H, W, C)."""
        for channel, counts in enumerate(self._counts):
            counts += np.bincount(image[..., channel].reshape(-1), minlength=len(counts))
        self._images += 1

    def result(self) -> Statistics:
        """Each of shape (C, 1, 1); there must be an image."""
        found = [self._of_channel(counts) for counts in self._counts]
        joined = {name: np.array([one[name] for one in found])[:, None, None] for name in found[0]}
        return {**joined, "count": np.array([self._images])}

    def _of_channel(self, counts: NDArray[np.int64]) -> dict[str, float]:
        present = np.flatnonzero(counts)
        values, weights = present / self._scale, counts[present] / counts.sum()
        mean = float(values @ weights)
        reached = np.cumsum(counts[present])
        found = {
            "min": float(values[0]),
            "max": float(values[-1]),
            "mean": mean,
            "std": float(np.sqrt((values - mean) ** 2 @ weights)),
        }
        for name, share in QUANTILES.items():
            found[name] = float(values[np.searchsorted(reached, share * reached[-1])])
        return found


def joined_statistics(episodes: Sequence[Statistics]) -> Statistics:
    """Of a feature over all episodes, from those of each."""
    counts = np.array([int(one["count"][0]) for one in episodes])
    weights = counts / counts.sum()

    def mean_of(values: Sequence[NDArray[Any]]) -> NDArray[Any]:
        return np.asarray(np.tensordot(weights, np.stack(values), axes=1))

    mean = mean_of([one["mean"] for one in episodes])
    spread = mean_of([one["std"] ** 2 + (one["mean"] - mean) ** 2 for one in episodes])
    found: Statistics = {
        "min": np.min([one["min"] for one in episodes], axis=0),
        "max": np.max([one["max"] for one in episodes], axis=0),
        "mean": mean,
        "std": np.sqrt(spread),
        "count": np.array([counts.sum()]),
    }
    return found | {name: mean_of([one[name] for one in episodes]) for name in QUANTILES}
