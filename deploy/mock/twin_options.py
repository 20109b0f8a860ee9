"""The twin's options in a profile. Its arm and its camera share one world."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from maniskill_tomato.deploy.clock import Clock
from maniskill_tomato.deploy.drivers import DriverContext
from maniskill_tomato.deploy.mock.episode import EpisodeListName, load_episode
from maniskill_tomato.deploy.mock.faults import Faults
from maniskill_tomato.deploy.mock.twin_world import TwinWorld
from maniskill_tomato.deploy.toml_tables import parse_table
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.robot.d435 import color_intrinsics

Renderer = Literal["rays", "sapien", "auto"]


@dataclass(frozen=True, kw_only=True)
class TwinOptions:
    """The `[twin]` table of a profile; the run's seed is the number of the episode."""

    episodes: EpisodeListName = "held_out"
    """Which list the plants come from."""
    width: int = 640
    """Of the colour picture, in [px]."""
    height: int = 480
    """Of the colour picture, in [px]."""
    depth_noise: float = 1.0
    """Standard deviation of depths in multiples of the D435's; 0 for exact depths."""
    renderer: Renderer = "rays"
    """Where colours come from: flat ones by ray casting, SAPIEN's, or SAPIEN's where Vulkan is there (`auto`)."""
    real_time: bool = False
    """Whether the arm takes the time that it really would."""
    faults: Faults = Faults()
    """What goes wrong."""

    def __post_init__(self) -> None:
        if self.depth_noise < 0.0:
            raise InvalidInputError(f"depth_noise must be 0 or more, got {self.depth_noise}")
        if not (16 <= self.width <= 1920 and 16 <= self.height <= 1080):
            raise InvalidInputError(
                f"width and height must be from 16 to 1920 and 1080 px, got {self.width} x {self.height}"
            )


def twin_options(options: Mapping[str, Any]) -> TwinOptions:
    """Checks the table.

    Raises:
        ProfileError: A key or a value is wrong.
    """
    return parse_table(TwinOptions, options, "twin")


def twin_world(options: TwinOptions, context: DriverContext) -> TwinWorld:
    """The world of a run, made when arm or camera asks first."""

    def make() -> TwinWorld:
        clock: Clock = context.clock
        return TwinWorld(
            load_episode(options.episodes, context.seed),
            color_intrinsics(options.width, options.height),
            clock,
        )

    return context.shared("twin", make)
