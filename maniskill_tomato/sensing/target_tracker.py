"""Which of the fruits that are found in a view is the target, and where the target is believed to be."""

from collections.abc import Sequence
from typing import Final

import numpy as np

from maniskill_tomato.sensing.measurement import DetectedFruit, Measurement, Position

LOCATED_GATE: Final = 0.035
"""A fruit farther than this from where the target was seen is another one, in [m]. Of 1,061 fruits that two views of
validation plants show, none was mistaken for another; 7 % were missed, mostly slivers. At 50 mm 0.8 % are mistaken, and
where the target is not found a neighbour passes for it in 9 % of the views instead of none."""

COARSE_GATE: Final = 0.08
"""The same while the target's position is known from afar only, in [m]."""

SAME_FRUIT: Final = 0.025
"""Two positions nearer to each other than this are one fruit, in [m]; centres of tomatoes of the usual radius of 29 mm
are twice as far apart."""

MEASURED_MARGIN: Final = 0.15
"""How much more of a fruit must be measured than of a hidden target can be seen, to rule it out: three times the mean
error of V_f."""

LEAST_MEASURED: Final = 0.1
"""A fruit of which less V_f than this is measured does not say where the target is: centres of slivers are centimetres
off."""

SURE_SCORE: Final = 0.5
"""A fruit with a lower score is not chosen as a new target, only found again as such."""


class TargetTracker:
    """Follows one target from view to view.

    Until it was first seen its position is known roughly, and its neighbours in the truss are as near and better to
    see. What tells it apart: it is ripe, and if the search began hidden from it, it is none of those that the first
    view showed well.
    """

    def __init__(
        self,
        position_w: Position,
        *,
        is_located: bool = False,
        hidden_below: float | None = None,
        identity_known: bool = False,
    ) -> None:
        """Begins with a new target.

        Args:
            position_w: Where it is believed to be, world frame, in [m]. Shape (3,).
            is_located: Whether that is its measured position, not one known from afar.
            hidden_below: The first view shows less of it than this V_f; None if that is not known.
            identity_known: Whether measurements hold no fruit but the target.
        """
        self.position_w: Position = np.array(position_w, dtype=np.float64)
        """Where the target is believed to be, world frame, in [m]. Shape (3,)."""
        self.is_located = is_located
        """Whether it was seen there."""
        self._hidden_below = hidden_below
        self._identity_known = identity_known
        self._others: list[Position] = []

    def update(self, measurement: Measurement) -> int | None:
        """Takes in the next view; the first one that shows the target says where it is.

        Returns:
            Index of the target in `Measurement.fruits`, None if it is not there.
        """
        if self._hidden_below is not None:
            limit, self._hidden_below = self._hidden_below + MEASURED_MARGIN, None
            self._others = [
                fruit.centre_w
                for fruit in measurement.fruits
                if fruit.centre_w is not None and fruit.visible_fraction > limit
            ]
        index = self.find(measurement)
        if index is not None and not self.is_located:
            centre = measurement.fruits[index].centre_w
            if centre is not None:
                self.position_w, self.is_located = centre, True
        return index

    def find(self, measurement: Measurement) -> int | None:
        """Index of the target in `Measurement.fruits` by what is known now, None if it is not there."""
        if self._identity_known:
            return 0 if measurement.fruits else None
        best, nearest = None, LOCATED_GATE if self.is_located else COARSE_GATE
        for index, fruit in enumerate(measurement.fruits):
            if not self._can_be_target(fruit):
                continue
            away = self._distance(fruit, measurement.camera_position)
            if away <= nearest:
                best, nearest = index, away
        return best

    def _can_be_target(self, fruit: DetectedFruit) -> bool:
        if not fruit.is_ripe:
            return False
        if fruit.centre_w is None:
            return self.is_located
        if not self.is_located and fruit.visible_fraction < LEAST_MEASURED:
            return False
        return all(float(np.linalg.norm(fruit.centre_w - other)) >= SAME_FRUIT for other in self._others)

    def _distance(self, fruit: DetectedFruit, camera_position: Position) -> float:
        """How far a fruit is from the believed position, in [m]; without depth, how far the ray to it passes by."""
        if fruit.centre_w is not None:
            return float(np.linalg.norm(fruit.centre_w - self.position_w))
        towards = self.position_w - camera_position
        along = float(fruit.direction_w @ towards)
        return float(np.linalg.norm(towards - along * fruit.direction_w)) if along > 0.0 else np.inf


def choose_new_target(fruits: Sequence[DetectedFruit]) -> int | None:
    """Index of the largest fruit in the picture that is ripe, sure and has a position; None if there is none."""
    candidates = [
        index
        for index, fruit in enumerate(fruits)
        if fruit.is_ripe and fruit.score >= SURE_SCORE and fruit.centre_w is not None
    ]
    return max(candidates, key=lambda index: fruits[index].pixels, default=None)
