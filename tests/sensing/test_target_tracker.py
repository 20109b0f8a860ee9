"""Which of the fruits that were found is the target."""

import numpy as np
import pytest

from maniskill_tomato.sensing.target_tracker import (
    GATES,
    LEAST_MEASURED,
    MEASURED_MARGIN,
    SAME_FRUIT,
    TargetTracker,
)

TARGET = np.array([0.9, 0.0, 0.6])
NEIGHBOUR = TARGET + [0.0, 0.045, 0.0]
RIPE = ("tomato_ripe", "tomato_ripe")


@pytest.mark.parametrize("order", [1, -1])
def test_the_nearest_fruit_inside_the_gate_is_the_target_in_any_order(order: int) -> None:
    places = [TARGET, NEIGHBOUR][::order]
    believed = TARGET + [0.0, -0.02, 0.0]
    assert TargetTracker().choose(places, [0.1, 0.9], RIPE, believed, True) == (0 if order == 1 else 1)


@pytest.mark.parametrize("located", [False, True])
def test_gates_are_closed_intervals(located: bool) -> None:
    gate = GATES[0 if located else 1]
    for away, expected in ((gate - 1e-6, 0), (gate + 1e-6, None)):
        place = TARGET + [away, 0.0, 0.0]
        assert TargetTracker().choose([place], [0.5], ("tomato",), TARGET, located) == expected


def test_what_the_first_view_of_a_hidden_target_shows_well_is_never_the_target() -> None:
    believed = NEIGHBOUR + [0.0, 0.005, 0.0]
    choice = TargetTracker(hidden_below=0.3)
    assert choice.choose([NEIGHBOUR], [0.3 + MEASURED_MARGIN + 0.01], RIPE[:1], believed, False) is None
    # Nor later, measured a little beside where it was, though the believed place is its own; the target is found.
    beside = NEIGHBOUR + [0.0, SAME_FRUIT - 0.001, 0.0]
    assert choice.choose([beside, TARGET], [0.9, 0.2], RIPE, believed, False) == 1
    # A fruit that only later is seen well may be it.
    assert choice.choose([TARGET], [0.95], RIPE[:1], believed, False) == 0


@pytest.mark.parametrize(
    ("hidden_below", "fraction"), [(None, 1.0), (0.3, 0.3 + MEASURED_MARGIN), (0.3, np.nan)]
)
def test_without_that_knowledge_or_below_the_margin_it_may_be(
    hidden_below: float | None, fraction: float
) -> None:
    choice = TargetTracker(hidden_below)
    assert choice.choose([NEIGHBOUR], [fraction], RIPE[:1], NEIGHBOUR, False) == 0
    assert choice.choose([NEIGHBOUR], [1.0], RIPE[:1], NEIGHBOUR, False) == 0


def test_fruits_that_are_not_ripe_or_have_no_place_are_passed_over() -> None:
    kinds = ("tomato_unripe", "tomato", "tomato_turning", "tomato")
    places = [TARGET, None, TARGET, NEIGHBOUR]
    assert TargetTracker().choose(places, [1.0] * 4, kinds, TARGET, True) == 3
    assert TargetTracker().choose(places[:3], [1.0] * 3, kinds[:3], TARGET, True) is None
    assert TargetTracker().choose([], [], (), TARGET, True) is None


def test_a_sliver_does_not_locate_the_target_but_is_followed_once_it_is_located() -> None:
    places, kinds = [TARGET, NEIGHBOUR], RIPE
    fractions = [LEAST_MEASURED - 0.01, LEAST_MEASURED]
    assert TargetTracker().choose(places, fractions, kinds, TARGET, False) == 1
    assert TargetTracker().choose(places, fractions, kinds, TARGET, True) == 0
