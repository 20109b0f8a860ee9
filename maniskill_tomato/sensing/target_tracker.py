"""Which of the fruits that a segmenter finds is the one that is looked for."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

Place = NDArray[np.float64]

GATES: Final = (0.05, 0.08)
"""A fruit farther than this from where the target is believed to be is another one, in [m]: once seen, and before."""

SAME_FRUIT: Final = 0.025
"""Two places nearer to each other than this are one fruit, in [m]; centres of tomatoes of the usual radius of 29 mm
are twice as far apart."""

MEASURED_MARGIN: Final = 0.15
"""How much more of a fruit must be measured than of a hidden target can be seen, to rule it out: three times the mean
error of V_f."""

LEAST_MEASURED: Final = 0.1
"""A fruit of which less V_f than this is measured does not say where the target is: centres of slivers are centimetres
off."""

TARGET_CATEGORIES: Final = ("tomato_ripe", "tomato")
"""Targets are ripe; a segmenter that does not tell ripeness says `tomato`."""


class TargetTracker:
    """Follows one target from view to view.

    Until it was first seen its place is known roughly, and its neighbours in the truss are as near and better to see.
    What tells it apart: it is ripe, and if the search began hidden from it, it is none of those that the first view
    showed well.
    """

    def __init__(self, hidden_below: float | None = None) -> None:
        """Begins with a new target.

        Args:
            hidden_below: The first view shows less of it than this V_f; None if that is not known.
        """
        self._hidden_below = hidden_below
        self._others: list[Place] = []

    def choose(
        self,
        places: Sequence[Place | None],
        fractions: Sequence[float],
        categories: Sequence[str],
        known: Place,
        located: bool,
    ) -> int | None:
        """The index of the target among the fruits of the next view, None if it is not there.

        Args:
            places: Centres of the fruits in [m], each of shape (3,); None where it is not known.
            fractions: Their V_f as measured, NaN where it is not known.
            categories: Their kinds.
            known: Where the target is believed to be. Shape (3,).
            located: Whether it was seen there.
        """
        if self._hidden_below is not None:
            limit = self._hidden_below + MEASURED_MARGIN
            self._others = [p for p, f in zip(places, fractions, strict=True) if p is not None and f > limit]
            self._hidden_below = None
        best, nearest = None, GATES[0 if located else 1]
        for index, (place, fraction, category) in enumerate(zip(places, fractions, categories, strict=True)):
            if place is None or category not in TARGET_CATEGORIES or self._is_other(place):
                continue
            if not located and fraction < LEAST_MEASURED:
                continue
            away = float(np.linalg.norm(place - known))
            if away <= nearest:
                best, nearest = index, away
        return best

    def _is_other(self, place: Place) -> bool:
        return any(float(np.linalg.norm(place - other)) < SAME_FRUIT for other in self._others)
