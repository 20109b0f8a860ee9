"""Plausibility checks of the joint angles that the controller reports."""

import math
from typing import Final, NamedTuple

import numpy as np

from maniskill_tomato.deploy.interface import Float64
from maniskill_tomato.robot import iiwa14

LIMIT_SLACK: Final = math.radians(1.0)
"""How far beyond a joint limit a reading may be, in [rad]."""

SPEED_SLACK: Final = 1.2
"""Joints may seem this much faster than they can be: time stamps are not exact."""

READING_SLACK: Final = 0.005
"""How far two readings may differ beyond that, in [rad]."""


class Reading(NamedTuple):
    """Joint angles, and when they were measured."""

    asked: float
    """When they were asked for, by `time.monotonic`, in [s]."""
    answered: float
    """When the answer was there, by `time.monotonic`, in [s]."""
    stamp: float
    """When the answer was there, by the driver's clock, in [s]."""
    positions: Float64
    """In [rad]. Shape (7,)."""


def why_impossible(reading: Reading, last: Reading | None, moving: bool, rest_tolerance: float) -> str | None:
    """What speaks against a reading, or None.

    Args:
        reading: Its numbers are finite.
        last: The one before, if any.
        moving: Whether a move was under way between them.
        rest_tolerance: How far a joint may turn without a move, in [rad].
    """
    if np.any(np.abs(reading.positions) > iiwa14.JOINT_UPPER + LIMIT_SLACK):
        return f"joints at {np.degrees(reading.positions).round(2)} degrees, beyond their limits"
    if last is None:
        return None
    change = np.abs(reading.positions - last.positions)
    allowed = np.full(iiwa14.NUM_JOINTS, rest_tolerance)
    if moving:
        # The longest time that can lie between both measurements.
        elapsed = reading.answered - last.asked
        allowed = SPEED_SLACK * iiwa14.VELOCITY_LIMITS * elapsed + READING_SLACK
    if not np.any(change > allowed):
        return None
    joint = int(np.argmax(change - allowed))
    how = "faster than it can" if moving else "without a move"
    return f"that joint {joint + 1} turned by {math.degrees(change[joint]):.2f} degrees {how}"
