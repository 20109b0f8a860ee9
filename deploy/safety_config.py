"""The safety limits that every command must keep."""

from dataclasses import dataclass
from typing import Final

from maniskill_tomato.errors import InvalidInputError

Corner = tuple[float, float, float]

LARGEST_SPEED_FRACTION: Final = 0.3
"""No profile may allow more than this share of the joints' largest speeds."""


@dataclass(frozen=True, kw_only=True)
class Box:
    """An axis-aligned box in the base frame."""

    low: Corner
    """Lower corner x, y, z, in [m]."""
    high: Corner
    """Upper corner, in [m]."""

    def __post_init__(self) -> None:
        if not all(low < high for low, high in zip(self.low, self.high, strict=True)):
            raise InvalidInputError(
                f"low must lie below high along every axis, got {self.low} and {self.high}"
            )


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
    path_step: float = 0.02
    """Joint positions along a move are looked at this close together, in [rad] of the joint that turns most."""
    max_state_age: float = 0.5
    """Oldest arm state that a command may rest on, in [s]."""
    max_frame_age: float = 10.0
    """Oldest picture that a command may rest on, in [s]."""
    arrival_tolerance: float = 0.01
    """Farthest that a joint may stand from where it was sent, in [rad]."""

    def __post_init__(self) -> None:
        positive = (
            "speed_fraction",
            "max_joint_step",
            "max_flange_step",
            "path_step",
            "max_state_age",
            "max_frame_age",
            "arrival_tolerance",
        )
        for name in positive:
            if not getattr(self, name) > 0.0:
                raise InvalidInputError(f"{name} must be above 0, got {getattr(self, name)}")
        for name in ("joint_margin", "table_clearance", "self_clearance", "obstacle_clearance"):
            if not 0.0 <= getattr(self, name) <= 0.5:
                raise InvalidInputError(f"{name} must be from 0 to 0.5, got {getattr(self, name)}")
        if not 0.0 < self.max_speed_fraction <= LARGEST_SPEED_FRACTION:
            raise InvalidInputError(
                f"max_speed_fraction must be above 0 and at most {LARGEST_SPEED_FRACTION}, "
                f"got {self.max_speed_fraction}"
            )
        if self.speed_fraction > self.max_speed_fraction:
            raise InvalidInputError(
                f"speed_fraction must be at most max_speed_fraction = {self.max_speed_fraction}, "
                f"got {self.speed_fraction}"
            )
        if self.path_step > 0.1:
            raise InvalidInputError(f"path_step must be at most 0.1 rad, got {self.path_step}")
        if self.plant_clearance is not None and not -0.05 <= self.plant_clearance <= 0.3:
            raise InvalidInputError(f"plant_clearance must be from -0.05 to 0.3, got {self.plant_clearance}")
        if self.plant_points_needed < 1:
            raise InvalidInputError(f"plant_points_needed must be at least 1, got {self.plant_points_needed}")
