"""An inspection list beside the truth that a simulator knows."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.plants.organs import Plant
from maniskill_tomato.sensing.inspection import InspectedFruit

NO_FRUIT: Final = -1
"""Stands for a fruit where there is none."""

NEAREST_FRUIT: Final = 0.03
"""A listed fruit whose best view does not tell which it is counts as the nearest one of the plant, if that is nearer
than this, in [m]."""


@dataclass(frozen=True, kw_only=True)
class JudgedFruit:
    """One fruit of a list beside the truth."""

    fruit: int
    """Which fruit of the plant it is, as an index in `Plant.fruits`; `NO_FRUIT` if none."""
    is_ripe: bool
    """What the list says."""
    is_truly_ripe: bool
    is_fully_seen: bool
    """What the list says."""
    true_fraction: float
    """V_f of the fruit in the view that showed most of it; 0 if there was none."""
    position_error_m: float
    """Distance of the listed centre from the true one, in [m]; -1 for no fruit."""
    radius_error_m: float
    """Listed radius less the true one, in [m]; 0 for no fruit."""


def judge_fruits(
    fruits: Sequence[InspectedFruit],
    plant: Plant,
    centres: NDArray[np.float64],
    fraction: Callable[[int, int], float],
) -> list[JudgedFruit]:
    """Compares a list with the truth.

    Args:
        fruits: The list.
        plant: What stands there.
        centres: Of its fruits, world frame, in [m]. Shape (len(plant.fruits), 3).
        fraction: V_f of a fruit, by its index, in a view of the inspection, by its number.
    """
    judged = []
    for fruit in fruits:
        best = fruit.best
        number = NO_FRUIT if best is None or best.shown_fruit is None else best.shown_fruit
        away = np.linalg.norm(centres - fruit.position_w, axis=1)
        if number == NO_FRUIT and away.min() < NEAREST_FRUIT:
            number = int(away.argmin())
        is_any = number != NO_FRUIT
        judged.append(
            JudgedFruit(
                fruit=number,
                is_ripe=fruit.is_ripe,
                is_truly_ripe=is_any and plant.fruits[number].ripeness == "ripe",
                is_fully_seen=fruit.is_fully_seen,
                true_fraction=round(fraction(number, best.view), 5) if is_any and best is not None else 0.0,
                position_error_m=round(float(away[number]), 5) if is_any else -1.0,
                radius_error_m=round(fruit.radius_m - plant.fruits[number].radius, 5) if is_any else 0.0,
            )
        )
    return judged
