"""Checks that the plant configurations share."""

from dataclasses import fields
from math import isfinite

from maniskill_tomato.errors import InvalidInputError


def check_positive(config: object, *names: str) -> None:
    """Refuses a config whose named numbers are not positive and finite."""
    for name in names:
        value = getattr(config, name)
        if not (isfinite(value) and value > 0):
            raise InvalidInputError(f"{type(config).__name__}.{name} must be positive, got {value}")


def check_ranges(config: object) -> None:
    """Refuses every (low, high) pair of a config that is not ascending."""
    for item in fields(config):  # type: ignore[arg-type]
        value = getattr(config, item.name)
        if item.name.endswith("_range") and not (len(value) == 2 and value[0] <= value[1]):
            raise InvalidInputError(
                f"{type(config).__name__}.{item.name} must be (low, high) with low <= high, got {value}"
            )
