"""How large and how tall the fruits of a crop are: known roughly beforehand, and better from every fruit seen whole.

A cherry tomato, a beef tomato and a pepper differ by more than a factor of three in size, the fruits of one crop by a
seventh. So each fruit that is seen whole says how large the hidden ones beside it are.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from math import exp, hypot, log
from typing import Final

USUAL_RADIUS: Final = 0.029
"""Median radius of the tasks' tomatoes, in [m]."""

RADIUS_SPREAD: Final = 0.14
"""Standard deviation of the logarithm of their radius."""

FLATNESS: Final = 0.85
"""Height of a tomato over its width. Of 99 ripe ones on validation plants it is 0.81 to 0.89, and the axis within 17
degrees of the vertical (19 of 20)."""

CROP_SPREAD: Final = 0.35
"""Standard deviation of the logarithm of the median radius over crops, from cherry tomatoes (14 mm) to peppers
(50 mm)."""

FLATNESS_SPREAD: Final = 0.2
"""Standard deviation of the mean flatness over crops, from beef tomatoes (0.75) to plum tomatoes (1.4)."""

OWN_FLATNESS_SPREAD: Final = 0.07
"""The same over the fruits of one crop, errors of measurement included."""


@dataclass(frozen=True, kw_only=True)
class WholeFruit:
    """Size and shape of a fruit whose whole outline was seen."""

    radius_m: float
    """Half its width, in [m]."""
    flatness: float
    """Height over width."""


@dataclass(frozen=True, kw_only=True)
class CropShape:
    """What is known of the fruits of the plants that are looked at."""

    radius_m: float = USUAL_RADIUS
    """Median radius, in [m]."""
    radius_error: float = CROP_SPREAD
    """Standard error of its logarithm."""
    flatness: float = FLATNESS
    """Mean height over width."""

    @classmethod
    def of(cls, fruits: Iterable[WholeFruit]) -> "CropShape":
        """The posterior after fruits that were seen whole, each given once.

        Args:
            fruits: Normal about the crop's mean, in flatness and in the logarithm of the radius; the crop's mean about
                that of all crops.
        """
        weight, radius = 1.0 / CROP_SPREAD**2, log(USUAL_RADIUS) / CROP_SPREAD**2
        flat_weight, flatness = 1.0 / FLATNESS_SPREAD**2, FLATNESS / FLATNESS_SPREAD**2
        for fruit in fruits:
            weight += 1.0 / RADIUS_SPREAD**2
            radius += log(fruit.radius_m) / RADIUS_SPREAD**2
            flat_weight += 1.0 / OWN_FLATNESS_SPREAD**2
            flatness += fruit.flatness / OWN_FLATNESS_SPREAD**2
        return cls(radius_m=exp(radius / weight), radius_error=weight**-0.5, flatness=flatness / flat_weight)

    @property
    def radius_spread(self) -> float:
        """Standard deviation of the logarithm of a fruit's radius."""
        return hypot(self.radius_error, RADIUS_SPREAD)

    @property
    def radius_spread_m(self) -> float:
        """The same of the radius, in [m]."""
        return self.radius_m * self.radius_spread

    @property
    def largest_radius_m(self) -> float:
        """Of the median fruit, one standard error above what is believed, in [m]."""
        return self.radius_m * exp(self.radius_error)
