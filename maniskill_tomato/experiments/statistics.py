"""How sure one can be of a mean, and whether two policies differ on the same episodes."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from maniskill_tomato.errors import InvalidInputError

RESAMPLES = 10_000
"""Bootstrap resamples and random sign flips; the Monte-Carlo error of a p-value near 0.05 is then about 0.002."""


@dataclass(frozen=True, kw_only=True)
class PairedTest:
    """Policy A against policy B on the same episodes."""

    episodes: int
    only_a: int
    """Episodes that only A solved."""
    only_b: int
    """Episodes that only B solved."""
    success_p: float
    """Two-sided p-value of the exact McNemar test that both solve the same share."""
    moves_difference: float
    """Mean of A's moves minus B's; negative where A is faster."""
    moves_interval_95: tuple[float, float]
    """Percentile bootstrap interval of that mean."""
    moves_p: float
    """Two-sided p-value of the sign-flip permutation test that the mean difference is zero."""


def mean_interval(values: ArrayLike, seed: int = 0) -> tuple[float, float]:
    """95 % percentile bootstrap interval of the mean (Efron and Tibshirani 1993, section 13.3).

    Args:
        values: One number per episode. Shape (N,).
        seed: Of the resamples, so that the same values give the same interval.

    Raises:
        InvalidInputError: There is no value.
    """
    series = np.asarray(values, dtype=np.float64)
    if series.ndim != 1 or len(series) == 0:
        raise InvalidInputError(f"values must be a list of one or more numbers, got shape {series.shape}")
    means = _resampled_means(series, np.random.default_rng(seed))
    low, high = np.percentile(means, [2.5, 97.5])
    return float(low), float(high)


def mcnemar_p(only_a: int, only_b: int) -> float:
    """Two-sided exact McNemar test: under the null each discordant episode is a fair coin's throw.

    The p-value is twice the binomial tail of the smaller count, at most 1 (McNemar 1947; exact form: Fagerland,
    Lydersen and Laake 2013).

    Raises:
        InvalidInputError: A count is negative.
    """
    if only_a < 0 or only_b < 0:
        raise InvalidInputError(f"counts must be 0 or more, got {only_a} and {only_b}")
    trials, fewer = only_a + only_b, min(only_a, only_b)
    tail = sum(math.comb(trials, k) for k in range(fewer + 1))
    # Integers keep the tail exact for thousands of trials, where 0.5 ** n would vanish.
    return min(float(2 * tail / 2**trials), 1.0)


def sign_flip_p(differences: ArrayLike, seed: int = 0) -> float:
    """Two-sided permutation test that paired differences are symmetric about zero (Fisher 1935, section 21).

    Args:
        differences: One per pair. Shape (N,).
        seed: Of the random flips.

    Returns:
        The share of sign flips, the observed one among them, whose mean is as far from zero.
    """
    series = np.asarray(differences, dtype=np.float64)
    series = series[series != 0.0]
    if len(series) == 0:
        return 1.0
    observed = abs(series.sum())
    rng = np.random.default_rng(seed)
    as_far = 1
    for first in range(0, RESAMPLES, 1000):
        count = min(1000, RESAMPLES - first)
        signs = rng.integers(0, 2, (count, len(series)), dtype=np.int8) * 2 - 1
        as_far += int((np.abs(signs @ series) >= observed * (1.0 - 1e-12)).sum())
    return as_far / (RESAMPLES + 1)


def paired_test(
    success_a: ArrayLike, moves_a: ArrayLike, success_b: ArrayLike, moves_b: ArrayLike, seed: int = 0
) -> PairedTest:
    """Compares two policies, episode by episode.

    Args:
        success_a: Whether A solved each episode. Shape (N,).
        moves_a: Its moves; a failure counts as the horizon. Shape (N,).
        success_b: The same of B, in the same order. Shape (N,).
        moves_b: The same of B. Shape (N,).
        seed: Of the resamples.

    Raises:
        InvalidInputError: The lists have different lengths or are empty.
    """
    won_a, won_b = np.asarray(success_a, dtype=bool), np.asarray(success_b, dtype=bool)
    took_a, took_b = np.asarray(moves_a, dtype=np.float64), np.asarray(moves_b, dtype=np.float64)
    if not len(won_a) or len({won_a.shape, won_b.shape, took_a.shape, took_b.shape}) != 1:
        raise InvalidInputError(
            "both policies must have the same episodes, one or more; got "
            f"{won_a.shape}, {took_a.shape}, {won_b.shape} and {took_b.shape}"
        )
    difference = took_a - took_b
    only_a, only_b = int((won_a & ~won_b).sum()), int((won_b & ~won_a).sum())
    return PairedTest(
        episodes=len(won_a),
        only_a=only_a,
        only_b=only_b,
        success_p=mcnemar_p(only_a, only_b),
        moves_difference=float(difference.mean()),
        moves_interval_95=mean_interval(difference, seed),
        moves_p=sign_flip_p(difference, seed),
    )


def _resampled_means(series: NDArray[np.float64], rng: np.random.Generator) -> NDArray[Any]:
    """Means of resamples with replacement, a block at a time so that thousands of episodes fit in memory."""
    blocks = []
    for first in range(0, RESAMPLES, 500):
        rows = rng.integers(0, len(series), (min(500, RESAMPLES - first), len(series)))
        blocks.append(series[rows].mean(axis=1))
    return np.concatenate(blocks)
