"""How sure one can be of a rate or a mean, and whether two policies differ on the same episodes."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from maniskill_tomato.errors import InvalidInputError

Float64 = NDArray[np.float64]

RESAMPLES = 10_000
"""Bootstrap resamples and random sign flips; the Monte-Carlo error of a p-value near 0.05 is then about 0.002."""

BATCH = 500
"""Resamples at a time, so that thousands of episodes fit in memory."""


@dataclass(frozen=True, kw_only=True)
class Interval:
    """An interquartile mean and how sure one can be of it."""

    estimate: float
    low: float | None
    """Lower end of the 95 % interval; None for fewer than two runs, from which none follows."""
    high: float | None
    """Its upper end."""


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


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a success probability.

    Unlike the textbook interval it stays within [0, 1] and has a width when all trials succeed.

    Raises:
        InvalidInputError: There is no trial, or the successes are not among them.
    """
    if trials < 1 or not 0 <= successes <= trials:
        raise InvalidInputError(
            f"need 0 <= successes <= trials and at least one trial, got {successes} of {trials}"
        )
    interval = stats.binomtest(successes, trials).proportion_ci(confidence_level=0.95, method="wilson")
    return float(interval.low), float(interval.high)


def mean_interval(values: ArrayLike, seed: int = 0) -> tuple[float, float]:
    """95 % percentile bootstrap interval of the mean (Efron and Tibshirani 1993, section 13.3).

    Args:
        values: One number per episode or training seed. Shape (N,).
        seed: Of the resamples, so that the same values give the same interval.

    Raises:
        InvalidInputError: There is no value.
    """
    series = np.asarray(values, dtype=np.float64)
    if series.ndim != 1 or len(series) == 0:
        raise InvalidInputError(f"values must be a list of one or more numbers, got shape {series.shape}")
    if len(series) == 1:
        return float(series[0]), float(series[0])
    low, high = _percentile_interval([series], np.mean, 0.95, RESAMPLES, seed, batch=BATCH)
    return float(low), float(high)


def interquartile_mean(values: ArrayLike, axis: int = -1) -> Float64:
    """Mean of the middle half: floor(n / 4) values are left out at either end, none of fewer than four.

    It is what Agarwal et al. (2021) advise for few runs: less noisy than the median, less bent by one failed
    run than the mean.

    Raises:
        InvalidInputError: There is no value.
    """
    series = np.asarray(values, dtype=np.float64)
    if series.shape[axis] == 0:
        raise InvalidInputError("an interquartile mean needs one value or more, got none")
    return np.asarray(stats.trim_mean(series, 0.25, axis=axis), dtype=np.float64)


def interquartile_interval(strata: Sequence[ArrayLike], confidence: float = 0.95, seed: int = 0) -> Interval:
    """Interquartile mean of all values, with the percentile interval of a stratified bootstrap.

    Args:
        strata: The runs' scores, one sequence per task; runs are redrawn within their task only.
        confidence: Probability that the interval is made for.
        seed: Seed of the redrawing.

    Raises:
        InvalidInputError: A task has no score.
    """
    tasks = [np.asarray(values, dtype=np.float64) for values in strata]
    if not tasks or min(len(values) for values in tasks) == 0:
        raise InvalidInputError("every task needs the score of one run or more")
    estimate = float(interquartile_mean(np.concatenate(tasks)))
    low, high = _interquartile_bounds(tasks, confidence, RESAMPLES, seed)
    if low is None or high is None:
        return Interval(estimate=estimate, low=None, high=None)
    return Interval(estimate=estimate, low=float(low), high=float(high))


def interquartile_band(runs: Float64, resamples: int = 1000) -> tuple[Float64, Float64]:
    """Pointwise 95 % bootstrap interval of the interquartile mean over several runs.

    Args:
        runs: Shape (runs, points).
        resamples: How often to redraw the runs.

    Returns:
        Lower and upper ends, the mean itself for a single run. Shape (points,) each.
    """
    low, high = _interquartile_bounds([runs], 0.95, resamples, 0)
    if low is None or high is None:
        mean = interquartile_mean(runs, axis=0)
        return mean, mean
    return low, high


def ends(interval: Interval) -> tuple[float, float, float] | float:
    """An interquartile mean with the ends of its interval, or alone where none follows."""
    if interval.low is None or interval.high is None:
        return interval.estimate
    return interval.estimate, interval.low, interval.high


def interval_text(interval: Interval | None, factor: float, form: str, unit: str) -> str:
    """An interquartile mean with its interval, as `97.5 [95.0, 99.0] %`.

    Args:
        interval: None for runs that were not evaluated.
        factor: What the numbers are multiplied by.
        form: Format of each number.
        unit: What follows them.
    """
    if interval is None:
        return "not evaluated"
    text = form.format(factor * interval.estimate)
    if interval.low is None or interval.high is None:
        return text + unit
    return f"{text} [{form.format(factor * interval.low)}, {form.format(factor * interval.high)}]{unit}"


def mcnemar_p(only_a: int, only_b: int) -> float:
    """Two-sided exact McNemar test: under the null each discordant episode is a fair coin's throw.

    Raises:
        InvalidInputError: A count is negative.
    """
    if only_a < 0 or only_b < 0:
        raise InvalidInputError(f"counts must be 0 or more, got {only_a} and {only_b}")
    if only_a + only_b == 0:
        return 1.0
    return float(stats.binomtest(only_a, only_a + only_b, 0.5).pvalue)


def sign_flip_p(differences: ArrayLike, seed: int = 0) -> float:
    """Two-sided permutation test that paired differences are symmetric about zero (Fisher 1935, section 21).

    Args:
        differences: One per pair. Shape (N,).
        seed: Of the random flips.

    Returns:
        The share of sign flips whose mean is as far from zero as the observed one. All flips are counted where there
        are at most `RESAMPLES`, otherwise that many random ones and the observed one, so that it is never 0.
    """
    series = np.asarray(differences, dtype=np.float64)
    series = series[series != 0.0]
    if len(series) < 2:
        return 1.0  # Both signs of a single difference are as far from zero.

    def distance(values: Float64, axis: int) -> Float64:
        return np.asarray(np.abs(values.mean(axis=axis)))

    result = stats.permutation_test(
        (series,),
        distance,
        permutation_type="samples",
        n_resamples=RESAMPLES,
        batch=BATCH,
        alternative="greater",
        vectorized=True,
        rng=np.random.default_rng(seed),
    )
    return float(result.pvalue)


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


def _interquartile_bounds(
    strata: Sequence[Float64], confidence: float, resamples: int, seed: int
) -> tuple[Any, Any]:
    """Bounds of the interquartile mean over runs, the first axis; None where every stratum has one run."""
    redrawn = [runs for runs in strata if len(runs) > 1]
    if not redrawn:
        return None, None
    single = [runs for runs in strata if len(runs) == 1]

    def statistic(*samples: Float64, axis: int) -> Float64:
        fixed = [np.broadcast_to(np.moveaxis(runs, 0, -1), (*samples[0].shape[:-1], 1)) for runs in single]
        return interquartile_mean(np.concatenate([*samples, *fixed], axis=axis), axis=axis)

    return _percentile_interval(
        [np.moveaxis(runs, 0, -1) for runs in redrawn], statistic, confidence, resamples, seed
    )


def _percentile_interval(
    samples: Sequence[Float64],
    statistic: Any,
    confidence: float,
    resamples: int,
    seed: int,
    batch: int | None = None,
) -> tuple[Any, Any]:
    interval = stats.bootstrap(
        samples,
        statistic,
        n_resamples=resamples,
        batch=batch,
        axis=-1,
        confidence_level=confidence,
        vectorized=True,
        method="percentile",
        rng=np.random.default_rng(seed),
    ).confidence_interval
    return interval.low, interval.high
