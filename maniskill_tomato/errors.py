"""The exceptions of this package, one family under `TomatoError`."""

import difflib
import math
from collections.abc import Iterable


def did_you_mean(value: object, allowed: Iterable[object]) -> str:
    """The end of a message about a mistyped word: `; did you mean 'train'?`, or nothing where none is near."""
    near = difflib.get_close_matches(str(value), [str(a) for a in allowed], n=1)
    return f"; did you mean {near[0]!r}?" if near else ""


class TomatoError(Exception):
    """Base of every error that this package raises on purpose."""


class InvalidInputError(TomatoError, ValueError):
    """An argument, option or file has a value that cannot be used."""

    @classmethod
    def choice(cls, name: str, value: object, allowed: Iterable[object]) -> "InvalidInputError":
        """The error for a `value` of the option `name` that is not among the `allowed` ones."""
        allowed = tuple(allowed)
        listed = ", ".join(repr(a) for a in allowed)
        return cls(f"{name} must be one of {listed}; got {value!r}{did_you_mean(value, allowed)}")


def check_ranges(config: object, **ranges: tuple[float, float]) -> None:
    """Accepts a configuration whose numbers lie in their ranges, ends included; NaN lies in none.

    Raises:
        InvalidInputError: One does not; the message names it and its range.
    """
    for name, (low, high) in ranges.items():
        value = getattr(config, name)
        if not low <= value <= high:
            allowed = f"{low:g} or more" if high == math.inf else f"from {low:g} to {high:g}"
            raise InvalidInputError(f"{name} must be {allowed}, got {value}")


def check_positive(config: object, *names: str) -> None:
    """Accepts a configuration whose numbers of these names are above 0.

    Raises:
        InvalidInputError: One is not.
    """
    for name in names:
        if not getattr(config, name) > 0.0:
            raise InvalidInputError(f"{name} must be above 0, got {getattr(config, name)}")


class PolicyError(TomatoError):
    """An exported policy is missing, damaged, made for something else, or answers nonsense."""


class RenderingUnavailableError(TomatoError, RuntimeError):
    """Pictures were asked for on a machine without a usable Vulkan device."""


class CheckpointError(TomatoError):
    """A checkpoint is missing, damaged or made for something else, or cannot be written."""

    def __init__(self, message: str, newer_format: bool = False) -> None:
        """Keeps whether the file is whole, but written by a newer version."""
        super().__init__(message)
        self.newer_format = newer_format


class NotWrittenError(CheckpointError):
    """A file cannot be written: the disk is full, or the folder is not ours."""


class UnsoundEnvironmentError(TomatoError):
    """A package is missing or damaged, or the machine lacks what is needed."""


class TrainingDivergedError(TomatoError):
    """A loss or a weight is no longer a finite number."""


class SeedsFailedError(TomatoError):
    """Some of several training runs failed; the others are complete."""


SIMULATOR_PACKAGES = ("mani_skill", "sapien")
"""What an installation for a robot's PC leaves out."""


class MissingPackageError(TomatoError):
    """Something needs a package that is not installed."""

    @classmethod
    def simulator(cls) -> "MissingPackageError":
        """The error for `SIMULATOR_PACKAGES`."""
        return cls(
            "this needs ManiSkill and SAPIEN, which are not installed here; `make venv KIND=full` in a checkout "
            "installs them, `pip install maniskill-tomato` elsewhere"
        )

    @classmethod
    def extra(cls, package: str, extra: str) -> "MissingPackageError":
        """The error for a package that an extra of this one installs."""
        return cls(f'{package} is not installed; install it with `pip install "maniskill-tomato[{extra}]"`')


class ClusterError(TomatoError):
    """A cluster of machines cannot be reached, or cannot do what it was given."""


class MissingWeightsError(TomatoError):
    """Weights that would have to be downloaded cannot be."""
