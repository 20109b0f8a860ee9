"""The envelope in which the arm may move, as numbers; `safety` checks commands against it."""

import math
from dataclasses import dataclass
from typing import Final

from maniskill_tomato.deploy.collision import Box
from maniskill_tomato.errors import InvalidInputError, check_positive, check_ranges

LARGEST_SPEED_FRACTION: Final = 0.3
"""No profile may allow more than this share of the joints' largest speeds."""


@dataclass(frozen=True, kw_only=True)
class SafetyConfig:
    """What `Safety` lets through. Defaults suit a first run before a plant."""

    speed_fraction: float = 0.1
    """Speed of the moves as a share of the joints' largest."""
    max_speed_fraction: float = LARGEST_SPEED_FRACTION
    """Faster commands are refused; at most 0.3."""
    joint_margin: float = 0.03
    """How far joints stay from their limits, in [rad]."""
    max_joint_step: float = 1.5
    """The most that one joint turns in one move, in [rad]."""
    max_flange_step: float = 0.35
    """The farthest that the flange gets from its start in one move, in [m]: the camera moves 0.12 m at most, and the
    flange turns about it."""
    workspace: Box = Box(low=(-0.9, -0.9, 0.15), high=(0.9, 0.9, 1.35))
    """Where the flange may be, on the way too."""
    forbidden: tuple[Box, ...] = (Box(low=(-0.3, -0.3, -1.0), high=(0.3, 0.3, 0.25)),)
    """Where neither flange nor camera may be, on the way too (Eq. 5-4: around the base)."""
    table_height: float = 0.0
    """Height of the surface that the arm stands on, in [m]."""
    table_clearance: float = 0.03
    """How far links 1 to 7 and the camera stay from it, in [m]."""
    self_clearance: float = 0.005
    """How far links that are no neighbours stay from each other, in [m]."""
    obstacles: tuple[Box, ...] = ()
    """Things that stand about, such as a gutter or a wall."""
    obstacle_clearance: float = 0.05
    """How far the arm stays from them, in [m]."""
    plant_clearance: float | None = 0.0
    """How far the spheres around forearm, wrist and camera stay from what the camera saw of the plant, in [m]; they
    are 6 to 25 mm larger than the links. None for no check: leaves may be touched."""
    plant_points_needed: int = 6
    """So many points must be nearer than that before a move is refused: a few are noise."""
    leave_within: float = 0.02
    """An arm that stands where it must not, or too near to something, is out of that after so much turn of its fastest
    joint, in [rad]."""
    max_state_age: float = 0.5
    """Oldest arm state that a command may rest on, in [s]."""
    max_frame_age: float = 10.0
    """Oldest picture that a command may rest on, in [s]."""
    arrival_tolerance: float = 0.01
    """Farthest that a joint may stand from where it was sent, in [rad]."""

    def __post_init__(self) -> None:
        check_positive(
            self,
            "speed_fraction",
            "max_speed_fraction",
            "max_joint_step",
            "max_flange_step",
            "leave_within",
            "max_state_age",
            "max_frame_age",
            "arrival_tolerance",
        )
        check_ranges(
            self,
            joint_margin=(0.0, 0.5),
            table_clearance=(0.0, 0.5),
            self_clearance=(0.0, 0.5),
            obstacle_clearance=(0.0, 0.5),
            max_speed_fraction=(0.0, LARGEST_SPEED_FRACTION),
            leave_within=(0.0, 0.1),
            plant_points_needed=(1, math.inf),
        )
        if self.speed_fraction > self.max_speed_fraction:
            raise InvalidInputError(
                f"speed_fraction must be at most max_speed_fraction = {self.max_speed_fraction}, "
                f"got {self.speed_fraction}"
            )
        if self.plant_clearance is not None:
            check_ranges(self, plant_clearance=(-0.05, 0.3))
