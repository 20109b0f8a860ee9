"""Rates that are measured in turns, so that whatever else the machine does meets all of them alike.

A rate counts the processor time of this process, of all its threads together. Waiting for a busy core costs nothing
then; that a busy core computes more slowly does, which is why a yardstick is measured in the same turns.
"""

import statistics
import time
from collections.abc import Callable, Mapping

import numpy as np

Measurement = Callable[[], float]
"""Measures a rate once."""
Rate = dict[str, float]
"""`median`, `low` and `high` of the turns, per second of processor time."""

YARDSTICK = "yardstick"
"""Name of the rate that all others are divided by before two runs are compared."""


def per_second(function: Callable[[], object], calls: int) -> float:
    """Rate of a call; the first one, which may compile, is not counted."""
    function()
    start = time.process_time()
    for _ in range(calls):
        function()
    return calls / (time.process_time() - start)


def yardstick() -> float:
    """Rounds a second of a fixed piece of work: a loop of Python around small array operations."""
    vectors = np.random.default_rng(0).normal(size=(64, 3))

    def work() -> float:
        total = 0.0
        for row in vectors:
            total += float(np.cross(row, vectors[0]).sum()) + float(np.linalg.norm(vectors @ row))
        return total

    return per_second(work, 60)


def in_turns(measurements: Mapping[str, Measurement], repeats: int) -> dict[str, Rate]:
    """Measures every rate once a turn; the yardstick is one of them.

    Args:
        measurements: By name.
        repeats: Number of turns.
    """
    values: dict[str, list[float]] = {}
    for _ in range(repeats):
        for name, measure in {YARDSTICK: yardstick, **measurements}.items():
            values.setdefault(name, []).append(measure())
    return {name: summary(each) for name, each in values.items()}


def summary(values: list[float]) -> Rate:
    """Median, lowest and highest of a rate's turns, to four digits."""
    return {
        "median": four_digits(statistics.median(values)),
        "low": four_digits(min(values)),
        "high": four_digits(max(values)),
    }


def four_digits(value: float) -> float:
    """A number rounded to four digits."""
    return float(f"{value:.4g}")
