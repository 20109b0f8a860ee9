"""A stretch of a greenhouse row: a plant between its two neighbours, as one plant."""

from dataclasses import dataclass, replace
from functools import lru_cache
from math import cos, radians, sin
from typing import Literal

import numpy as np

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.plants.generator import Detail, generate_plant
from maniskill_tomato.plants.organs import Float32, Plant, placed
from maniskill_tomato.plants.random_streams import Stream, normal, stream

ROW_SPACING = 0.5
"""Distance between the stems of a row, in [m]; usual greenhouse practice is 0.4 to 0.5 m."""

PLACE_SPREAD = 0.015
"""Standard deviation of a neighbour's place about its own in the row, in [m], along each axis."""

TURN_SPREAD_DEG = 8.0
"""Standard deviation of a neighbour's turn about its stem, in [deg]; its trusses still hang to the aisle."""

KEPT_NEIGHBOURS = 64
"""Single plants kept for rows that have them as a neighbour."""

SIDES: tuple[Literal[-1, 1], ...] = (-1, 1)
"""The neighbours in the order in which they follow the middle plant, by the sign of their y."""


@dataclass(frozen=True, eq=False)
class Row(Plant):
    """Three plants of a row as one: the organs and fruits of the middle one come first.

    Frame: that of the middle plant. `preset`, `seed` and `detail` are the middle plant's.
    """

    middle_fruits: int
    """How many of `fruits` hang on the middle plant, the first ones."""
    middle_organs: int
    """How many of `organs` are the middle plant's, the first ones."""
    neighbour_seeds: tuple[int, int]
    """Seeds of the plants at -y and +y."""


def neighbour_seeds(seed: int, seeds: tuple[int, int]) -> tuple[int, int]:
    """Which plants stand beside the plant `seed`: drawn by it from a half-open range of seeds.

    Raises:
        InvalidInputError: The range is empty.
    """
    low, high = seeds
    if low >= high or low < 0:
        raise InvalidInputError(
            f"seeds must be a half-open range of numbers of 0 or more, low < high; got {seeds}"
        )
    left, right = (int(stream(seed, Stream.NEIGHBOUR, i).integers(low, high)) for i in range(2))
    return left, right


def generate_row(
    preset: str = "full",
    seed: int = 0,
    detail: Detail = "training",
    leaf_density: float | tuple[float, float] | None = None,
    *,
    seeds: tuple[int, int] = (0, 2**24),
    spacing: float = ROW_SPACING,
) -> Row:
    """Grows a plant and its neighbours in the row.

    Args:
        preset: As for `generate_plant`, for all three.
        seed: Which middle plant; it also draws the neighbours, their places and turns.
        detail: Level of the triangles.
        leaf_density: Of all three; a range, from which each draws its own; None keeps the preset's.
        seeds: Half-open range that the neighbours' seeds are drawn from, so that a held-out row holds no
            training plant.
        spacing: Distance between the stems, in [m].

    Returns:
        The row in the middle plant's frame: origin at the foot of its stem, z up, the row along y, the robot
        at -x; metres. Organs of the neighbours are named `left/...` (-y) and `right/...` (+y).

    Raises:
        InvalidInputError: An argument is out of range.
    """
    if not 0.2 <= spacing <= 2.0:
        raise InvalidInputError(f"spacing must be from 0.2 to 2 m, got {spacing}")
    middle = generate_plant(preset, seed, detail, leaf_density_of(leaf_density, seed))
    left, right = (
        _single(preset, neighbour, detail, leaf_density_of(leaf_density, neighbour))
        for neighbour in neighbour_seeds(seed, seeds)
    )
    return stand_in_row(middle, left, right, spacing)


def stand_in_row(middle: Plant, left: Plant, right: Plant, spacing: float = ROW_SPACING) -> Row:
    """A plant between two others; its seed draws their exact places and turns. See `generate_row`.

    Args:
        middle: The plant that the row is about.
        left: At -y.
        right: At +y.
        spacing: Distance between the stems, in [m].
    """
    organs, fruits = list(middle.organs), list(middle.fruits)
    for i, (side, neighbour) in enumerate(zip(SIDES, (left, right), strict=True)):
        rng = stream(middle.seed, Stream.NEIGHBOUR, 2 + i)
        place = np.array([normal(rng, 0.0, PLACE_SPREAD), side * spacing + normal(rng, 0.0, PLACE_SPREAD), 0])
        turn = radians(normal(rng, 0.0, TURN_SPREAD_DEG))
        moved = _moved(neighbour, place.astype(np.float32), turn)
        prefix = "left" if side < 0 else "right"
        fruits += [replace(f, organ_index=f.organ_index + len(organs)) for f in moved.fruits]
        organs += [replace(organ, name=f"{prefix}/{organ.name}") for organ in moved.organs]
    return Row(
        preset=middle.preset,
        seed=middle.seed,
        detail=middle.detail,
        organs=tuple(organs),
        fruits=tuple(fruits),
        middle_fruits=len(middle.fruits),
        middle_organs=len(middle.organs),
        neighbour_seeds=(left.seed, right.seed),
    )


def leaf_density_of(leaf_density: float | tuple[float, float] | None, seed: int) -> float | None:
    """The leaf density of the plant `seed`: out of a range, always the same for the same plant."""
    if not isinstance(leaf_density, tuple):
        return leaf_density
    low, high = leaf_density
    return round(low + (high - low) * float(stream(seed, Stream.DENSITY).random()), 3)


@lru_cache(maxsize=KEPT_NEIGHBOURS)
def _single(preset: str, seed: int, detail: Detail, leaf_density: float | None) -> Plant:
    return generate_plant(preset, seed, detail, leaf_density)


def _moved(plant: Plant, place: Float32, turn: float) -> Plant:
    """The plant turned about its stem by `turn` [rad] and then moved to `place` [m]."""
    c, s = cos(turn), sin(turn)
    return placed(plant, np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], dtype=np.float32), place)
