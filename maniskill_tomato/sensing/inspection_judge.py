"""An inspection list beside the truth that a simulator knows."""

from collections.abc import Callable, Collection, Sequence
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


@dataclass(frozen=True, kw_only=True)
class ListScore:
    """What inspection lists are worth."""

    wanted: int
    """Ripe fruits that were to be seen fully."""
    seen: int
    """Those of them that are listed as fully seen and truly were."""
    listed: int
    """Fruits listed as ripe."""
    claimed: int
    """Those of them that are listed as fully seen."""
    truly_full: int
    """Those of these that are ripe and were fully seen."""
    right: tuple[JudgedFruit, ...]
    """Of the fruits listed as ripe those that are, each once."""

    @property
    def recall(self) -> float | None:
        """The share of the fruits to be seen that are listed as fully seen and truly were; None without any."""
        return self.seen / self.wanted if self.wanted else None

    @property
    def precision(self) -> float | None:
        """The share of the fruits listed as ripe that are ripe and listed once; None without any."""
        return len(self.right) / self.listed if self.listed else None

    @property
    def full_precision(self) -> float | None:
        """The share of the fruits listed as ripe and fully seen that are ripe and were; None without any."""
        return self.truly_full / self.claimed if self.claimed else None

    @property
    def position_error_median_m(self) -> float | None:
        """Of the fruits that are right, in [m]; None without any."""
        return _median([fruit.position_error_m for fruit in self.right])

    @property
    def radius_error_median_m(self) -> float | None:
        """Of their absolute errors, in [m]; None without any."""
        return _median([abs(fruit.radius_error_m) for fruit in self.right])


def truly_seen(fruits: Sequence[JudgedFruit], threshold: float) -> set[int]:
    """The ripe fruits that a list calls fully seen and that truly were, as indices in `Plant.fruits`.

    Args:
        fruits: The list.
        threshold: V_f above which a fruit is fully visible.
    """
    return {
        fruit.fruit
        for fruit in fruits
        if fruit.is_fully_seen and fruit.is_truly_ripe and fruit.true_fraction > threshold
    }


def score_lists(
    lists: Sequence[tuple[Sequence[JudgedFruit], Collection[int]]], threshold: float
) -> ListScore:
    """Counts what the lists of some rows are worth together.

    Args:
        lists: Of each row its list, and the ripe fruits that are to be seen fully, as indices in `Plant.fruits`. What
            was seen beside these does not count.
        threshold: V_f above which a fruit is fully visible.
    """
    ripe = [[fruit for fruit in fruits if fruit.is_ripe] for fruits, _ in lists]
    claimed = [fruit for own in ripe for fruit in own if fruit.is_fully_seen]
    right = [
        fruit for own in ripe for fruit in {f.fruit: f for f in reversed(own) if f.is_truly_ripe}.values()
    ]
    return ListScore(
        wanted=sum(len(set(wanted)) for _, wanted in lists),
        seen=sum(len(truly_seen(fruits, threshold) & set(wanted)) for fruits, wanted in lists),
        listed=sum(len(own) for own in ripe),
        claimed=len(claimed),
        truly_full=sum(f.is_truly_ripe and f.true_fraction > threshold for f in claimed),
        right=tuple(right),
    )


def _median(values: Sequence[float]) -> float | None:
    return float(np.median(values)) if values else None
