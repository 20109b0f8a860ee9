"""Intervals and paired tests against values worked out by hand and published ones."""

import itertools
import math

import numpy as np
import pytest
from numpy.typing import NDArray

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.experiments.statistics import (
    RESAMPLES,
    Interval,
    interquartile_band,
    interquartile_interval,
    interquartile_mean,
    interval_text,
    mcnemar_p,
    mean_interval,
    paired_test,
    sign_flip_p,
    wilson_interval,
)


def test_mcnemar_by_hand() -> None:
    # 8 discordant episodes, 1 of them won by A: 2 * (C(8,0) + C(8,1)) / 2^8 = 18 / 256.
    assert mcnemar_p(1, 7) == pytest.approx(18 / 256)
    assert mcnemar_p(7, 1) == pytest.approx(18 / 256)
    assert mcnemar_p(0, 0) == 1.0
    assert mcnemar_p(4, 4) == 1.0


@pytest.mark.parametrize(("a", "b"), [(0, 5), (3, 11), (40, 61), (900, 1020)])
def test_mcnemar_agrees_with_the_binomial_tail_in_whole_numbers(a: int, b: int) -> None:
    tail = sum(math.comb(a + b, k) for k in range(min(a, b) + 1))
    assert mcnemar_p(a, b) == pytest.approx(min(2 * tail / 2 ** (a + b), 1.0), rel=1e-9)


def test_wilson_intervals_agree_with_published_values() -> None:
    # Newcombe (1998), Statistics in Medicine 17, table I, method 3.
    for successes, trials, low, high in (
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0, 0.1611),
        (1, 29, 0.0061, 0.1718),
    ):
        assert wilson_interval(successes, trials) == pytest.approx((low, high), abs=5e-5)
    assert wilson_interval(20, 20) == pytest.approx((1 - 0.1611, 1.0), abs=5e-5)
    with pytest.raises(InvalidInputError):
        wilson_interval(1, 0)
    with pytest.raises(InvalidInputError):
        wilson_interval(5, 4)
    with pytest.raises(InvalidInputError):
        wilson_interval(0, 0)
    with pytest.raises(InvalidInputError):
        wilson_interval(-1, 4)
    # One success in one trial: (p + z^2 / 2n) / (1 + z^2 / n) -+ ... is from 1 / (1 + z^2) to 1.
    assert wilson_interval(1, 1) == pytest.approx((1 / (1 + 1.959964**2), 1.0), abs=1e-6)


def test_mean_interval_agrees_with_the_normal_one_for_many_values() -> None:
    values = np.random.default_rng(1).exponential(2.0, 2000)
    low, high = mean_interval(values)
    half = 1.96 * values.std(ddof=1) / np.sqrt(len(values))
    assert low == pytest.approx(values.mean() - half, abs=0.1 * half)
    assert high == pytest.approx(values.mean() + half, abs=0.1 * half)
    assert mean_interval(values) == (low, high)


def test_mean_interval_of_three_seeds_can_be_counted_by_hand() -> None:
    # All seeds equal: no spread. One of two seeds: the means 0, 0.5, 1 have probabilities 1/4, 1/2, 1/4.
    assert mean_interval([3.0, 3.0, 3.0]) == (3.0, 3.0)
    assert mean_interval([0.25]) == (0.25, 0.25)
    assert mean_interval([0.0, 1.0]) == (0.0, 1.0)
    # One success of five: the mean is at most 0.4 with probability 0.942 and at most 0.6 with 0.993.
    assert mean_interval([0.0, 0.0, 0.0, 0.0, 1.0]) == pytest.approx((0.0, 0.6))


def exact_sign_flip_p(differences: NDArray[np.float64]) -> float:
    signs = np.array(list(itertools.product((-1, 1), repeat=len(differences))))
    return float(np.mean(np.abs(signs @ differences) >= abs(differences.sum()) - 1e-9))


def test_sign_flip_counts_every_flip_of_a_few_differences() -> None:
    differences = np.array([1.0, 2.0, -1.0, 3.0, 2.0, 4.0, -2.0, 1.0])
    assert sign_flip_p(differences) == pytest.approx(exact_sign_flip_p(differences), abs=1e-12)
    assert sign_flip_p([5.0]) == 1.0
    assert sign_flip_p([5.0, 0.0, 2.0]) == 0.5  # Of the sums 7, 3, -3 and -7 two are as far from zero.


def test_sign_flip_estimates_the_share_of_many_differences() -> None:
    differences = np.random.default_rng(5).integers(-3, 5, 16).astype(float)
    differences[differences == 0.0] = 1.0
    # 10,000 flips estimate a probability of about 0.1 to within 4 standard errors, 0.012.
    assert sign_flip_p(differences) == pytest.approx(exact_sign_flip_p(differences), abs=0.012)


def test_sign_flip_is_never_zero() -> None:
    # Of 2^200 flips two are as far from zero; a random one never is, so that the observed one alone counts.
    assert sign_flip_p(np.ones(200)) == pytest.approx(1 / (RESAMPLES + 1), rel=1e-12)
    assert sign_flip_p(-np.arange(1.0, 100.0)) == pytest.approx(1 / (RESAMPLES + 1), rel=1e-12)
    # Two of 2^10 flips, all of which are counted.
    assert sign_flip_p(np.full(10, 2.5)) == pytest.approx(2 / 2**10, rel=1e-12)


def test_sign_flip_says_nothing_where_nothing_differs() -> None:
    assert sign_flip_p([0.0, 0.0]) == 1.0


def test_the_interquartile_mean_leaves_out_a_quarter_at_either_end() -> None:
    assert interquartile_mean([5.0]) == 5.0
    assert interquartile_mean([9.0, 0.0, 0.0]) == 3.0  # Fewer than four: none is left out.
    assert interquartile_mean([100.0, 2.0, 0.0, 1.0]) == 1.5
    assert interquartile_mean([7.0, 1.0, 2.0, 3.0, 90.0]) == 4.0
    assert interquartile_mean([0.0, 0.0, 1.0, 2.0, 3.0, 4.0, 50.0, 60.0]) == 2.5
    with pytest.raises(InvalidInputError, match="one value or more"):
        interquartile_mean([])


def test_the_interquartile_mean_agrees_with_a_plain_loop_along_either_axis() -> None:
    values = np.random.default_rng(0).normal(size=(11, 7))
    for axis, cut in ((0, 2), (1, 1)):
        lines = values.T if axis == 0 else values
        expected = [float(np.mean(sorted(line)[cut : len(line) - cut])) for line in lines]
        np.testing.assert_allclose(interquartile_mean(values, axis=axis), expected, rtol=1e-12)
    np.testing.assert_array_equal(interquartile_mean(values), interquartile_mean(values, axis=1))


def test_the_bootstrap_of_two_runs_has_the_three_means_that_they_can_give() -> None:
    # Redrawing {0, 1} gives the means 0, 1/2, 1 with probabilities 1/4, 1/2, 1/4.
    wide = interquartile_interval([[0.0, 1.0]])
    assert (wide.estimate, wide.low, wide.high) == (0.5, 0.0, 1.0)
    narrow = interquartile_interval([[0.0, 1.0]], confidence=0.4)
    assert (narrow.low, narrow.high) == (0.5, 0.5)


def test_runs_are_redrawn_within_their_task_only() -> None:
    stratified = interquartile_interval([[0.0, 0.0], [1.0, 1.0]])
    assert (stratified.estimate, stratified.low, stratified.high) == (0.5, 0.5, 0.5)
    mixed = interquartile_interval([[0.0, 0.0, 1.0, 1.0]])
    assert (mixed.low, mixed.high) == (0.0, 1.0)


def test_the_bootstrap_interval_agrees_with_a_plain_loop() -> None:
    scores = np.random.default_rng(3).normal(size=20)
    redrawn = np.random.default_rng(1).choice(scores, size=(10_000, 20))
    means = [np.mean(sorted(sample)[5:15]) for sample in redrawn]
    ours = interquartile_interval([scores])
    # Each end has a random error of about 0.01 with 10,000 redraws of scores whose deviation is 1.
    assert ours.low == pytest.approx(np.percentile(means, 2.5), abs=0.04)
    assert ours.high == pytest.approx(np.percentile(means, 97.5), abs=0.04)


def test_a_task_with_a_single_run_counts_with_that_run() -> None:
    # The value 1 of the second task is always there; the first gives the sums 0, 1 or 2 of its two.
    interval = interquartile_interval([[0.0, 1.0], [1.0]])
    assert (interval.estimate, interval.low, interval.high) == pytest.approx((2 / 3, 1 / 3, 1.0))


def test_the_band_of_several_curves_is_the_interval_at_every_point() -> None:
    runs = np.random.default_rng(2).normal(size=(6, 4))
    low, high = interquartile_band(runs, resamples=10_000)
    for point in range(4):
        interval = interquartile_interval([runs[:, point]])
        assert (low[point], high[point]) == pytest.approx((interval.low, interval.high), abs=0.05)
    low, high = interquartile_band(runs[:1])
    np.testing.assert_array_equal(low, runs[0])
    np.testing.assert_array_equal(high, runs[0])


def test_a_single_run_gives_no_interval_and_no_run_is_refused() -> None:
    single = interquartile_interval([[0.7]])
    assert (single.estimate, single.low, single.high) == (0.7, None, None)
    with pytest.raises(InvalidInputError, match="every task"):
        interquartile_interval([[0.7], []])


def test_paired_test_counts_and_directions() -> None:
    rng = np.random.default_rng(0)
    moves_b = rng.integers(3, 12, 300).astype(float)
    moves_a = moves_b - rng.integers(0, 3, 300)
    success_b = np.arange(300) % 10 != 0
    success_a = np.ones(300, dtype=bool)
    success_a[1] = False
    test = paired_test(success_a, moves_a, success_b, moves_b)
    assert (test.only_a, test.only_b, test.episodes) == (30, 1, 300)
    assert test.moves_difference == pytest.approx(float((moves_a - moves_b).mean()))
    assert test.moves_interval_95[0] < test.moves_difference < test.moves_interval_95[1] < 0
    assert test.success_p < 1e-6
    assert test.moves_p < 1e-3
    turned = paired_test(success_b, moves_b, success_a, moves_a)
    assert turned.moves_difference == pytest.approx(-test.moves_difference)
    assert (turned.only_a, turned.only_b) == (1, 30)


def test_the_seed_alone_decides_what_is_drawn_and_is_0_unless_given() -> None:
    rng = np.random.default_rng(4)
    a, b = rng.normal(0.3, 1.0, (2, 40))
    won = a > 0.0
    for drawn in (
        lambda **seed: mean_interval(a, **seed),
        lambda **seed: interquartile_interval([a, b], **seed),
        lambda **seed: sign_flip_p(a, **seed),
        lambda **seed: paired_test(won, a, won, b, **seed),
    ):
        assert drawn() == drawn(seed=0) != drawn(seed=1)


def test_false_alarms_of_the_paired_test_on_moves_are_as_rare_as_the_p_value_says() -> None:
    rng = np.random.default_rng(3)
    p = [sign_flip_p(rng.normal(size=40), seed=i) for i in range(60)]
    # 60 tests of a true null at 5 %: more than 8 alarms happen once in 500 times.
    assert sum(value < 0.05 for value in p) <= 8


def test_bad_input_is_refused() -> None:
    with pytest.raises(InvalidInputError, match="one or more numbers"):
        mean_interval([])
    with pytest.raises(InvalidInputError, match="one or more numbers"):
        mean_interval([[1.0, 2.0], [3.0, 4.0]])
    with pytest.raises(InvalidInputError, match="one or more numbers"):
        mean_interval(3.0)
    with pytest.raises(InvalidInputError, match="one value or more"):
        interquartile_band(np.empty((0, 4)))
    with pytest.raises(InvalidInputError, match="0 or more"):
        mcnemar_p(-1, 2)
    with pytest.raises(InvalidInputError, match="0 or more"):
        mcnemar_p(2, -1)
    with pytest.raises(InvalidInputError, match="same episodes"):
        paired_test([True], [1.0], [True, False], [1.0, 2.0])


def test_an_interval_is_written_with_its_ends_where_it_has_them() -> None:
    whole = Interval(estimate=0.975, low=0.95, high=0.99)
    assert interval_text(whole, 100.0, "{:.1f}", " %") == "97.5 [95.0, 99.0] %"
    half = Interval(estimate=1.5, low=1.0, high=2.0)
    assert interval_text(half, 3.0, "{:.2f}", " moves") == "4.50 [3.00, 6.00] moves"
    assert interval_text(Interval(estimate=3.0, low=None, high=None), 2.0, "{:.2f}", " moves") == "6.00 moves"
    assert interval_text(None, 100.0, "{:.1f}", " %") == "not evaluated"
