"""Rows of plants: what stands where, which seeds it comes from, and that the middle plant is the single one."""

import numpy as np
import pytest

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.plants.generator import generate_plant
from maniskill_tomato.plants.row import ROW_SPACING, generate_row, leaf_density_of, neighbour_seeds
from maniskill_tomato.plants.seed_splits import SEED_SPLITS
from maniskill_tomato.plants.spec import ROW_NEIGHBOURS, PlantSpec


def test_the_middle_of_a_row_is_the_plant_of_its_seed() -> None:
    row, plant = generate_row("one_tomato", 5), generate_plant("one_tomato", 5)
    assert row.middle_organs == len(plant.organs) and row.middle_fruits == len(plant.fruits) == 1
    for ours, single in zip(row.organs, plant.organs, strict=False):
        assert ours.name == single.name
        np.testing.assert_array_equal(ours.vertices, single.vertices)
    np.testing.assert_array_equal(row.fruits[0].centre, plant.fruits[0].centre)


def test_neighbours_are_the_plants_of_their_seeds_moved_along_the_row() -> None:
    row = generate_row("three_tomatoes", 8, seeds=(40, 60))
    first = row.middle_organs
    for k, (side, seed) in enumerate(zip((-1.0, 1.0), row.neighbour_seeds, strict=True)):
        single = generate_plant("three_tomatoes", seed)
        organs = row.organs[first : first + len(single.organs)]
        prefix = ("left/", "right/")[k]
        assert [o.name for o in organs] == [prefix + o.name for o in single.organs]
        # A rigid motion: the stem's foot stands beside the middle plant, and distances stay.
        foot = organs[0].vertices[organs[0].vertices[:, 2] < 0.01].mean(axis=0)
        assert abs(foot[1] - side * ROW_SPACING) < 0.05 and abs(foot[0]) < 0.05
        ours = np.concatenate([o.vertices for o in organs])
        np.testing.assert_allclose(ours[:, 2], single.vertices[:, 2], atol=1e-6)
        np.testing.assert_allclose(
            np.linalg.norm(ours[::50] - ours[7], axis=1),
            np.linalg.norm(single.vertices[::50] - single.vertices[7], axis=1),
            atol=1e-5,
        )
        first += len(single.organs)
    assert first == len(row.organs)


def test_fruits_of_a_row_point_at_their_organs() -> None:
    row = generate_row("full", 3)
    assert len(row.fruits) > row.middle_fruits
    for fruit in row.fruits:
        vertices = row.organs[fruit.organ_index].vertices
        away = np.linalg.norm(vertices - fruit.centre, axis=1)
        assert "fruit" in row.organs[fruit.organ_index].name
        assert away.max() <= fruit.radius + 1e-5
    assert len({organ.name for organ in row.organs}) == len(row.organs)


def test_neighbours_come_from_the_range_and_follow_the_seed() -> None:
    drawn = [neighbour_seeds(seed, (100, 110)) for seed in range(200)]
    assert drawn == [neighbour_seeds(seed, (100, 110)) for seed in range(200)]
    assert {s for pair in drawn for s in pair} == set(range(100, 110))
    with pytest.raises(InvalidInputError, match="low < high"):
        neighbour_seeds(0, (5, 5))


def test_rows_of_a_split_hold_only_plants_of_that_split() -> None:
    for low, high in SEED_SPLITS.values():
        row = PlantSpec(preset="one_tomato", row=True).grow(high - 1)
        for seed in row.neighbour_seeds:  # type: ignore[attr-defined]
            assert low <= seed < low + ROW_NEIGHBOURS <= high


def test_every_plant_of_a_row_has_the_density_of_its_own_seed() -> None:
    densities = [leaf_density_of((0.5, 1.5), seed) for seed in range(400)]
    values = np.array(densities, dtype=np.float64)
    assert values.min() >= 0.5 and values.max() <= 1.5 and abs(values.mean() - 1.0) < 0.06
    assert leaf_density_of(0.7, 3) == 0.7 and leaf_density_of(None, 3) is None
    row = generate_row("one_tomato", 5, leaf_density=(0.2, 1.8), seeds=(0, 8))
    expected = [
        generate_plant("one_tomato", seed, leaf_density=leaf_density_of((0.2, 1.8), seed))
        for seed in (5, *row.neighbour_seeds)
    ]
    assert len(row.faces) == sum(len(plant.faces) for plant in expected)


def test_a_spacing_out_of_range_is_refused() -> None:
    with pytest.raises(InvalidInputError, match="0.2 to 2 m"):
        generate_row("one_tomato", 0, spacing=0.0)
