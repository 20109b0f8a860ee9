"""Intervals and paired tests against values worked out by hand and against SciPy."""

import numpy as np
import pytest
from scipy import stats

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.experiments.statistics import mcnemar_p, mean_interval, paired_test, sign_flip_p


def test_mcnemar_by_hand() -> None:
    # 8 discordant episodes, 1 of them won by A: 2 * (C(8,0) + C(8,1)) / 2^8 = 18 / 256.
    assert mcnemar_p(1, 7) == pytest.approx(18 / 256)
    assert mcnemar_p(7, 1) == pytest.approx(18 / 256)
    assert mcnemar_p(0, 0) == 1.0
    assert mcnemar_p(4, 4) == 1.0


@pytest.mark.parametrize(("a", "b"), [(0, 5), (3, 11), (40, 61), (900, 1020)])
def test_mcnemar_agrees_with_scipys_binomial_test(a: int, b: int) -> None:
    expected = stats.binomtest(a, a + b, 0.5).pvalue
    assert mcnemar_p(a, b) == pytest.approx(expected, rel=1e-9)


def test_mean_interval_agrees_with_the_normal_one_for_many_values() -> None:
    values = np.random.default_rng(1).exponential(2.0, 2000)
    low, high = mean_interval(values)
    half = 1.96 * values.std(ddof=1) / np.sqrt(len(values))
    assert low == pytest.approx(values.mean() - half, abs=0.1 * half)
    assert high == pytest.approx(values.mean() + half, abs=0.1 * half)
    assert mean_interval(values) == (low, high)


def test_mean_interval_of_equal_values_has_no_width() -> None:
    assert mean_interval([3.0, 3.0, 3.0]) == (3.0, 3.0)


def test_sign_flip_agrees_with_the_exact_permutation_test() -> None:
    differences = np.array([1.0, 2.0, -1.0, 3.0, 2.0, 4.0, -2.0, 1.0])
    signs = np.array(np.meshgrid(*[[-1, 1]] * len(differences))).reshape(len(differences), -1)
    exact = np.mean(np.abs(differences @ signs) >= abs(differences.sum()))
    # 10,000 flips estimate a probability of about 0.1 to within 4 standard errors, 0.012.
    assert sign_flip_p(differences) == pytest.approx(exact, abs=0.012)


def test_sign_flip_says_nothing_where_nothing_differs() -> None:
    assert sign_flip_p([0.0, 0.0]) == 1.0


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


def test_false_alarms_of_the_paired_test_on_moves_are_as_rare_as_the_p_value_says() -> None:
    rng = np.random.default_rng(3)
    p = [sign_flip_p(rng.normal(size=40), seed=i) for i in range(60)]
    # 60 tests of a true null at 5 %: more than 8 alarms happen once in 500 times.
    assert sum(value < 0.05 for value in p) <= 8


def test_bad_input_is_refused() -> None:
    with pytest.raises(InvalidInputError, match="one or more numbers"):
        mean_interval([])
    with pytest.raises(InvalidInputError, match="0 or more"):
        mcnemar_p(-1, 2)
    with pytest.raises(InvalidInputError, match="same episodes"):
        paired_test([True], [1.0], [True, False], [1.0, 2.0])
