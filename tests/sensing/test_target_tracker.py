"""Which of the fruits that were found is the target."""

from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from maniskill_tomato.robot.d435 import color_intrinsics
from maniskill_tomato.sensing.measurement import DetectedFruit, Measurement
from maniskill_tomato.sensing.posed_frame import PosedFrame
from maniskill_tomato.sensing.target_tracker import (
    COARSE_GATE,
    LEAST_MEASURED,
    LOCATED_GATE,
    MEASURED_MARGIN,
    SAME_FRUIT,
    SURE_SCORE,
    TargetTracker,
    choose_new_target,
)

Place = NDArray[np.float64]

TARGET = np.array([0.9, 0.0, 0.6])
NEIGHBOUR = TARGET + [0.0, 0.045, 0.0]
CAMERA = np.array([0.4, 0.0, 0.6])


def fruit(
    place: Place | None,
    fraction: float = 0.5,
    category: str = "tomato_ripe",
    *,
    score: float = 1.0,
    pixels: int = 20,
    towards: Place = TARGET,
) -> DetectedFruit:
    direction = towards - CAMERA
    return DetectedFruit(
        category=category,
        score=score,
        corner=(0, 0),
        crop=np.ones((1, pixels), np.bool_),
        visible_fraction=fraction,
        centre_w=place,
        radius_m=0.03,
        direction_w=direction / np.linalg.norm(direction),
    )


def view(*fruits: DetectedFruit) -> Measurement:
    pose = np.eye(4)
    pose[:3, 3] = CAMERA
    frame = PosedFrame(
        depth_m=np.zeros((24, 32), np.float32), intrinsics=color_intrinsics(32, 24), T_world_camera=pose
    )
    return Measurement(frame=frame, fruits=fruits)


def chosen(fruits: Sequence[DetectedFruit], believed: Place = TARGET, located: bool = True) -> int | None:
    return TargetTracker(believed, is_located=located).update(view(*fruits))


@pytest.mark.parametrize("order", [1, -1])
def test_the_nearest_fruit_inside_the_gate_is_the_target_in_any_order(order: int) -> None:
    fruits = [fruit(TARGET, 0.1), fruit(NEIGHBOUR, 0.9)][::order]
    believed = TARGET + [0.0, -0.02, 0.0]
    assert chosen(fruits, believed) == (0 if order == 1 else 1)


@pytest.mark.parametrize("located", [False, True])
def test_a_fruit_beyond_the_gate_is_another_one(located: bool) -> None:
    gate = LOCATED_GATE if located else COARSE_GATE
    for away, expected in ((gate - 1e-6, 0), (gate + 1e-6, None)):
        place = TARGET + [away, 0.0, 0.0]
        assert chosen([fruit(place, category="tomato")], located=located) == expected


def test_the_first_view_of_the_target_says_where_it_is_and_later_ones_do_not() -> None:
    tracker = TargetTracker(TARGET + [0.0, 0.0, 0.03])
    assert tracker.update(view()) is None and not tracker.is_located
    assert tracker.update(view(fruit(TARGET))) == 0 and tracker.is_located
    np.testing.assert_array_equal(tracker.position_w, TARGET)
    tracker.update(view(fruit(TARGET + 0.01)))
    np.testing.assert_array_equal(tracker.position_w, TARGET)


def test_what_the_first_view_of_a_hidden_target_shows_well_is_never_the_target() -> None:
    tracker = TargetTracker(NEIGHBOUR + [0.0, 0.005, 0.0], hidden_below=0.3)
    assert tracker.update(view(fruit(NEIGHBOUR, 0.3 + MEASURED_MARGIN + 0.01))) is None
    # Nor later, measured a little beside where it was, though the believed place is its own; the target is found.
    beside = NEIGHBOUR + [0.0, SAME_FRUIT - 0.001, 0.0]
    assert tracker.find(view(fruit(beside, 0.9), fruit(TARGET, 0.2))) == 1
    # A fruit that only later is seen well may be it.
    assert tracker.update(view(fruit(TARGET, 0.95))) == 0


@pytest.mark.parametrize(
    ("hidden_below", "fraction"), [(None, 1.0), (0.3, 0.3 + MEASURED_MARGIN), (0.3, np.nan)]
)
def test_without_that_knowledge_or_below_the_margin_it_may_be(
    hidden_below: float | None, fraction: float
) -> None:
    tracker = TargetTracker(NEIGHBOUR, hidden_below=hidden_below)
    assert tracker.update(view(fruit(NEIGHBOUR, fraction))) == 0
    assert tracker.update(view(fruit(NEIGHBOUR, 1.0))) == 0


def test_fruits_that_are_not_ripe_are_passed_over() -> None:
    fruits = [
        fruit(TARGET, category="tomato_unripe"),
        fruit(TARGET, category="tomato_turning"),
        fruit(TARGET + [0.0, 0.03, 0.0], category="tomato"),
    ]
    assert chosen(fruits) == 2
    assert chosen(fruits[:2]) is None
    assert chosen([]) is None


def test_a_fruit_without_depth_is_followed_by_the_ray_to_it_but_does_not_locate_the_target() -> None:
    aside = TARGET + [0.0, LOCATED_GATE + 0.01, 0.0]
    assert chosen([fruit(None)]) == 0
    assert chosen([fruit(None, towards=aside)]) is None
    assert chosen([fruit(None, towards=2 * CAMERA - TARGET)]) is None, "what lies behind the camera"
    assert chosen([fruit(None)], located=False) is None


def test_a_sliver_does_not_locate_the_target_but_is_followed_once_it_is_located() -> None:
    fruits = [fruit(TARGET, LEAST_MEASURED - 0.01), fruit(NEIGHBOUR, LEAST_MEASURED)]
    assert chosen(fruits, located=False) == 1
    assert chosen(fruits) == 0


def test_a_target_whose_identity_is_known_is_taken_wherever_it_seems_to_be() -> None:
    tracker = TargetTracker(TARGET, identity_known=True)
    assert tracker.update(view()) is None
    assert tracker.update(view(fruit(TARGET + 1.0, 0.01))) == 0
    np.testing.assert_array_equal(tracker.position_w, TARGET + 1.0)


def test_a_new_target_is_the_largest_fruit_that_is_ripe_sure_and_has_a_place() -> None:
    fruits = [
        fruit(TARGET, pixels=30, score=SURE_SCORE - 0.01),
        fruit(TARGET, pixels=40, category="tomato_unripe"),
        fruit(None, pixels=50),
        fruit(TARGET, pixels=10),
        fruit(NEIGHBOUR, pixels=20, score=SURE_SCORE),
    ]
    assert choose_new_target(fruits) == 4
    assert choose_new_target(fruits[:3]) is None
