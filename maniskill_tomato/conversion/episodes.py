"""Episodes of any source as frames of named arrays, ready to be written in another format."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.errors import InvalidInputError

Dtype = Literal["float32", "int64", "bool", "image"]
Frame = Mapping[str, NDArray[Any]]

FLAG: Final[tuple[int, ...]] = (1,)
"""Shape of a single number."""


@dataclass(frozen=True, kw_only=True)
class Feature:
    """What one named array of every frame is."""

    dtype: Dtype
    """`image` is uint8 with three channels, RGB, or uint16 with one, depth in [mm]."""
    shape: tuple[int, ...]
    """Of one frame; an image's is (H, W, C)."""
    names: tuple[str, ...] | None = None
    """Of its elements, or of an image's axes."""
    info: Mapping[str, Any] = field(default_factory=dict)
    """More about it, such as its unit."""

    @property
    def is_depth(self) -> bool:
        """Whether it is an image of depth."""
        return self.dtype == "image" and self.shape[2] == 1

    @property
    def array_dtype(self) -> np.dtype[Any]:
        """Of its arrays."""
        if self.dtype == "image":
            return np.dtype(np.uint16 if self.is_depth else np.uint8)
        return np.dtype(self.dtype)

    def check(self, name: str, value: NDArray[Any], where: str) -> None:
        """Accepts an array of a frame.

        Raises:
            InvalidInputError: It is another one, or holds what is not finite.
        """
        if value.shape != self.shape or value.dtype != self.array_dtype:
            raise InvalidInputError(
                f"{where}: {name} must be {self.array_dtype} of shape {self.shape}, got {value.dtype} of shape "
                f"{value.shape}; frames of one data set are alike"
            )
        if value.dtype.kind == "f" and not np.isfinite(value).all():
            raise InvalidInputError(f"{where}: {name} holds numbers that are not finite")


def vector(names: tuple[str, ...], **info: Any) -> Feature:
    """Named numbers."""
    return Feature(dtype="float32", shape=(len(names),), names=names, info=info)


def flag() -> Feature:
    """Yes or no."""
    return Feature(dtype="bool", shape=FLAG)


def color(height: int, width: int, **info: Any) -> Feature:
    """An RGB image, with its size in [px]."""
    return Feature(dtype="image", shape=(height, width, 3), names=("height", "width", "channels"), info=info)


def depth(height: int, width: int, **info: Any) -> Feature:
    """An image of depth in whole [mm], 0 where there is none, with its size in [px]."""
    return Feature(dtype="image", shape=(height, width, 1), names=("height", "width", "channels"), info=info)


@dataclass(frozen=True, kw_only=True, eq=False)
class Episode:
    """One episode, whose frames are read when they are asked for."""

    task: str
    """What was to be done, in words."""
    frames: Iterator[Frame]
    """In their order."""
    source: str
    """Where it is from, for messages."""


@dataclass(frozen=True, kw_only=True, eq=False)
class EpisodeSource:
    """A file of episodes that are alike."""

    features: Mapping[str, Feature]
    """Of every frame."""
    robot: str
    """What moved."""
    episodes: Iterator[Episode]
    """In their order."""


def check_task(task: str | None) -> None:
    """Accepts the words for a task, or none.

    Raises:
        InvalidInputError: They are empty or of several lines.
    """
    if task is not None and (not task.strip() or not task.isprintable()):
        raise InvalidInputError(f"--task must be one line of words, got {task!r}")


def check_fps(fps: int) -> None:
    """Accepts frames a second.

    Raises:
        InvalidInputError: There are none, or too many.
    """
    if not 1 <= fps <= 1000 or not math.isfinite(fps):
        raise InvalidInputError(f"--fps must be from 1 to 1000, got {fps}")
