"""Moves in pieces on a straight line in joint space, and how long these may take."""

import math

import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.robot.arm_model import ArmModel
from maniskill_tomato.robot.iiwa14 import IIWA14

Float64 = NDArray[np.float64]


def straight_pieces(start: Float64, target: Float64, largest: float) -> list[Float64]:
    """The ends of the pieces of a move.

    Args:
        start: Joint angles, in [rad]. Shape (7,).
        target: Likewise.
        largest: No joint turns farther in a piece, in [rad].

    Returns:
        Joint angles, in [rad], the last ones the target. Each of shape (7,).
    """
    count = max(1, math.ceil(float(np.max(np.abs(target - start))) / largest - 1e-9))
    return [start + (target - start) * (i / count) for i in range(1, count)] + [target]


def move_seconds(
    start: Float64, target: Float64, speed: float, acceleration: float = 1.0, model: ArmModel = IIWA14
) -> float:
    """The longest that a point-to-point move takes at these shares of the largest joint speeds and accelerations, in
    [s]."""
    cruise = float(np.max(np.abs(target - start) / (model.velocity_limits * speed)))
    ramp = speed / acceleration * float(np.max(model.velocity_limits / model.acceleration_limits))
    return cruise + ramp
