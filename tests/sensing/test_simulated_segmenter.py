"""Masks with a segmenter's errors: none without errors, rates as given, hidden fruits missed and taken in."""

from dataclasses import replace

import numpy as np
import pytest

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.robot.d435 import color_intrinsics
from maniskill_tomato.segmentation.instances import Instances
from maniskill_tomato.sensing.fruit_detector import FruitDetector
from maniskill_tomato.sensing.posed_frame import PosedFrame
from maniskill_tomato.sensing.simulated_segmenter import (
    KINDS,
    SegmenterErrors,
    flat_colours,
    silhouette_of,
    simulated_masks,
)
from maniskill_tomato.sensing.visible_fraction.crop import FLATNESS

WIDTH, HEIGHT = 320, 240
INTRINSICS = color_intrinsics(WIDTH, HEIGHT)
RADIUS, DISTANCE = 0.03, 0.4
EXACT = SegmenterErrors(
    detection=(50.0, 0.0, 0.0),
    edge_shift=0.0,
    score=(0.9, 0.0, 0.0),
    confusion=((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    false_rate=0.0,
)


def pose() -> np.ndarray:
    """Optical axis along x, picture upright, at the origin."""
    matrix = np.eye(4)
    matrix[:3, :3] = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    return matrix


def flat_disc(centre: np.ndarray) -> np.ndarray:
    """The outline of a hanging, flat fruit straight ahead: an ellipse drawn by hand."""
    x = INTRINSICS.cx - INTRINSICS.fx * centre[1] / centre[0]
    y = INTRINSICS.cy - INTRINSICS.fy * centre[2] / centre[0]
    size = INTRINSICS.fx * RADIUS / np.sqrt(centre[0] ** 2 - RADIUS**2)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    return np.asarray((columns - x) ** 2 + ((rows - y) / FLATNESS) ** 2 < size**2)


def scene(hide: float = 0.0) -> tuple[PosedFrame, dict[int, np.ndarray], dict[int, float]]:
    """Two fruits that touch, numbers 4 and 7, ripe and turning; of the first that share of its width is hidden."""
    centres = {4: np.array([DISTANCE, 0.0303, 0.0]), 7: np.array([DISTANCE, -0.0303, 0.0])}
    first, second = flat_disc(centres[4]), flat_disc(centres[7])
    columns = np.flatnonzero(first.any(axis=0))
    first[:, : columns[0] + round(hide * len(columns))] = False
    depth = np.full((HEIGHT, WIDTH), 0.6, np.float32)
    depth[first | second] = DISTANCE - 0.5 * RADIUS
    frame = PosedFrame(
        depth_m=depth,
        intrinsics=INTRINSICS,
        T_world_camera=pose(),
        true_fruits=Instances.from_masks(np.stack([first, second]), categories=KINDS[:2]),
        true_numbers=(4, 7),
    )
    return frame, centres, {4: RADIUS, 7: RADIUS}


def test_without_errors_the_masks_are_the_true_ones() -> None:
    frame, centres, radii = scene()
    found = simulated_masks(frame, centres, radii, np.random.default_rng(0), EXACT)
    assert frame.true_fruits is not None
    assert found.categories == frame.true_fruits.categories
    np.testing.assert_array_equal(found.masks, frame.true_fruits.masks)


def test_a_whole_fruit_fills_the_outline_that_its_size_says() -> None:
    frame, centres, radii = scene()
    assert frame.true_fruits is not None
    drawn = np.count_nonzero(frame.true_fruits.masks[0])
    assert silhouette_of(frame, centres[4], radii[4]) == pytest.approx(drawn, rel=0.02)


@pytest.mark.parametrize("hide", [0.0, 0.7])
def test_a_fruit_is_found_as_often_as_the_log_odds_say(hide: float) -> None:
    frame, centres, radii = scene(hide)
    assert frame.true_fruits is not None
    errors = replace(EXACT, detection=(-3.0, 3.0, 0.1), merged_share=0.0)
    pixels = np.count_nonzero(frame.true_fruits.masks[0])
    whole = np.count_nonzero(scene()[0].true_fruits.masks[0])  # type: ignore[union-attr]
    # Pixels count in a picture of twice the width.
    odds = -3.0 + 3.0 * pixels / whole + 0.1 * np.log(4.0 * pixels)
    rng = np.random.default_rng(1)
    draws = 300
    found = sum(
        "tomato_ripe" in simulated_masks(frame, centres, radii, rng, errors).categories for _ in range(draws)
    )
    assert found / draws == pytest.approx(1.0 / (1.0 + np.exp(-odds)), abs=0.09)


def test_the_pixels_of_a_missed_fruit_go_to_the_one_that_touches_it() -> None:
    frame, centres, radii = scene(hide=0.8)
    assert frame.true_fruits is not None
    both = frame.true_fruits.masks.any(axis=0)
    errors = replace(EXACT, detection=(-20.0, 40.0, 0.0), merged_share=1.0)
    (taken,) = simulated_masks(frame, centres, radii, np.random.default_rng(2), errors).masks
    np.testing.assert_array_equal(taken, both)
    apart = replace(errors, merged_share=0.0)
    (left,) = simulated_masks(frame, centres, radii, np.random.default_rng(2), apart).masks
    np.testing.assert_array_equal(left, frame.true_fruits.masks[1])


def test_ragged_edges_change_the_border_and_nothing_else() -> None:
    frame, centres, radii = scene()
    assert frame.true_fruits is not None
    errors = replace(EXACT, edge_shift=1.5)
    found = simulated_masks(frame, centres, radii, np.random.default_rng(3), errors)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    true = frame.true_fruits.masks[0]
    changed = found.masks[0] != true
    assert 0.005 < changed.sum() / true.sum() < 0.2
    edge = true & ~(np.roll(true, 1, 0) & np.roll(true, -1, 0) & np.roll(true, 1, 1) & np.roll(true, -1, 1))
    away = np.hypot(
        rows[changed][:, None] - rows[edge][None], columns[changed][:, None] - columns[edge][None]
    ).min(axis=1)
    assert away.max() < 5 * 1.5


def test_ripeness_is_mistaken_and_leaves_are_taken_for_fruits_at_the_rates_given() -> None:
    frame, centres, radii = scene()
    errors = replace(
        EXACT,
        confusion=((1.0, 0.0, 0.0), (0.3, 0.7, 0.0), (0.0, 0.0, 1.0)),
        false_rate=0.5,
        false_kinds=(0, 0, 1),
    )
    rng = np.random.default_rng(4)
    drawn = [simulated_masks(frame, centres, radii, rng, errors) for _ in range(200)]
    kinds = [kind for found in drawn for kind in found.categories]
    assert kinds.count("tomato_turning") / 200 == pytest.approx(0.7, abs=0.1)
    assert kinds.count("tomato_unripe") / 200 == pytest.approx(0.5, abs=0.15)
    assert frame.true_fruits is not None
    fruits = frame.true_fruits.masks.any(axis=0)
    false = [
        m
        for found in drawn
        for m, kind in zip(found.masks, found.categories, strict=True)
        if kind == KINDS[2]
    ]
    assert not any((mask & fruits).any() for mask in false)


def test_the_same_random_numbers_give_the_same_masks() -> None:
    frame, centres, radii = scene(hide=0.5)
    one, other = (simulated_masks(frame, centres, radii, np.random.default_rng(5)) for _ in range(2))
    np.testing.assert_array_equal(one.masks, other.masks)
    np.testing.assert_array_equal(one.scores, other.scores)


def test_a_detector_takes_the_told_fruits_and_their_flat_colours_tell_ripeness() -> None:
    frame, centres, radii = scene()
    told = simulated_masks(frame, centres, radii, np.random.default_rng(6), EXACT)
    measured = FruitDetector(None).measure(replace(frame, told_fruits=told, rgb=flat_colours(frame)))
    redness = {fruit.category: fruit.redness for fruit in measured.fruits}
    assert redness["tomato_ripe"] > 0.58
    assert redness["tomato_turning"] < 0.44


def test_errors_need_true_fruits_and_shares_that_are_shares() -> None:
    frame, centres, radii = scene()
    with pytest.raises(InvalidInputError, match="true masks"):
        simulated_masks(replace(frame, true_fruits=None), centres, radii, np.random.default_rng(0))
    with pytest.raises(InvalidInputError, match="from 0 to 1"):
        SegmenterErrors(merged_share=1.5)
