"""The end of a run: the arm is left without a command, and what it does then is read, not supposed."""

import math
from contextlib import suppress
from typing import Final

import numpy as np

from maniskill_tomato.deploy.guarded_arm import GuardedArm

STOP_TIME: Final = 2.0
"""An arm that was told to stop stands after so long, in [s]."""

AT_REST: Final = 0.01
"""An arm whose joints all turn more slowly stands, in [rad/s]."""

_STOPPED: Final = "the arm was stopped and holds its position"


def come_to_rest(arm: GuardedArm) -> str:
    """Leaves the arm without a command, whatever fails; says what it does then."""
    with suppress(Exception):
        if arm.wait(0.0) and _speed(arm) < AT_REST:
            return _STOPPED if arm.broke_off else "the arm stands and holds its position"
    if arm.stop():
        with suppress(Exception):
            arm.wait(STOP_TIME)
        speed = _speed(arm)
        if speed < AT_REST:
            return _STOPPED
        if math.isinf(speed):
            return "the arm was told to stop; whether it stands nobody knows, for it does not answer"
        return f"the arm was told to stop and still moves at {speed:.3f} rad/s; use the emergency stop"
    return "a move may still be under way and goes on to its end; only the smartPAD or the emergency stop halts it"


def _speed(arm: GuardedArm) -> float:
    """Of the fastest joint as it is read, in [rad/s]; infinite where the arm does not answer."""
    try:
        return float(np.abs(arm.read().joint_velocities).max())
    except Exception:
        return math.inf
