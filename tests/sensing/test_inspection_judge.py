"""What inspection lists are worth, counted by hand."""

import pytest

from maniskill_tomato.sensing.inspection_judge import NO_FRUIT, JudgedFruit, score_lists, truly_seen


def judged(
    fruit: int,
    fraction: float,
    *,
    ripe: bool = True,
    truly: bool = True,
    full: bool = True,
    error: float = 0.0,
) -> JudgedFruit:
    return JudgedFruit(
        fruit=fruit,
        is_ripe=ripe,
        is_truly_ripe=truly,
        is_fully_seen=full,
        true_fraction=fraction,
        position_error_m=error,
        radius_error_m=-error,
    )


FIRST = [
    judged(0, 0.95, error=0.001),
    judged(0, 0.90, error=0.004),  # listed twice
    judged(1, 0.70, error=0.002),  # called full, and is not
    judged(2, 0.99, full=False, error=0.003),  # is full, and is not called so
    judged(3, 0.99, truly=False),  # unripe
    judged(NO_FRUIT, 0.0, truly=False, full=False, error=-1.0),
    judged(4, 0.99, ripe=False, truly=False),  # not listed as ripe
]
SECOND = [judged(0, 0.85, error=0.005), judged(9, 0.9, error=0.006)]


def test_the_lists_of_two_rows_are_counted_together() -> None:
    score = score_lists([(FIRST, [0, 1, 2, 5]), (SECOND, {0})], 0.8)
    assert (score.wanted, score.seen) == (5, 2), "fruit 0 of both rows; fruit 9 was not asked for"
    assert (score.listed, score.claimed, score.truly_full) == (8, 6, 4)
    assert sorted(fruit.fruit for fruit in score.right) == [0, 0, 1, 2, 9]
    assert score.recall == pytest.approx(2 / 5)
    assert score.precision == pytest.approx(5 / 8)
    assert score.full_precision == pytest.approx(4 / 6)
    assert score.position_error_median_m == pytest.approx(0.003), (
        "of 1, 2, 3, 5 and 6 mm: the first of a double"
    )
    assert score.radius_error_median_m == pytest.approx(0.003)


def test_a_fruit_was_truly_seen_when_the_list_says_so_and_the_truth_too() -> None:
    assert truly_seen(FIRST, 0.8) == {0}
    assert truly_seen(FIRST, 0.6) == {0, 1}


def test_where_there_is_nothing_there_is_no_share() -> None:
    score = score_lists([([], [])], 0.8)
    assert score.recall is score.precision is score.full_precision is None
    assert score.position_error_median_m is score.radius_error_median_m is None
