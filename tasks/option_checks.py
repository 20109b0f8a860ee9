"""The checks of options that all tasks take: every refusal names the allowed values."""

import math
from collections.abc import Iterable, Sequence

from maniskill_tomato.errors import InvalidInputError


def check_choice(name: str, value: str | None, allowed: Iterable[str]) -> None:
    """Accepts None and the `allowed` values of the option `name`."""
    if value is not None and value not in tuple(allowed):
        raise InvalidInputError.choice(name, value, allowed)


def check_rays_per_side(rays_per_side: int) -> None:
    """Accepts 4 to 256."""
    if isinstance(rays_per_side, bool) or not isinstance(rays_per_side, int) or not 4 <= rays_per_side <= 256:
        raise InvalidInputError(f"rays_per_side must be an integer from 4 to 256; got {rays_per_side!r}")


def check_other_targets(count: object) -> None:
    """Accepts how many other fruits are judged."""
    if isinstance(count, bool) or not isinstance(count, int) or count < 0:
        raise InvalidInputError(f"other_targets must be an integer of 0 or more, got {count!r}")


def check_half_ranges(name: str, values: Sequence[float], size: int) -> tuple[float, ...]:
    """`values` as `size` finite numbers of 0 or more."""
    try:
        numbers = tuple(float(v) for v in values)
    except (TypeError, ValueError):
        numbers = ()
    if len(numbers) != size or not all(math.isfinite(v) and v >= 0.0 for v in numbers):
        raise InvalidInputError(f"{name} must be {size} finite numbers of 0 or more; got {values!r}")
    return numbers


def check_range(name: str, values: Sequence[float]) -> tuple[float, float]:
    """`values` as two finite numbers, the first below the second."""
    try:
        numbers = tuple(float(v) for v in values)
    except (TypeError, ValueError):
        numbers = ()
    if len(numbers) != 2 or not all(math.isfinite(v) for v in numbers) or numbers[0] >= numbers[1]:
        raise InvalidInputError(f"{name} must be a range (low, high) of finite numbers; got {values!r}")
    return numbers[0], numbers[1]
