"""What drivers of an iiwa check: moves, joint angles that can be true, a flange where our kinematics put it."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Final, NamedTuple

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from maniskill_tomato.deploy.deploy_errors import DeviceTimeoutError, FaultError, RefusedError
from maniskill_tomato.deploy.interface import LIMIT_SLACK, ArmState, Float64, JointMove
from maniskill_tomato.deploy.profile_bounds import Laxer
from maniskill_tomato.deploy.rigid import difference, transform
from maniskill_tomato.errors import InvalidInputError, check_ranges
from maniskill_tomato.robot import iiwa14
from maniskill_tomato.robot.kinematics import forward_kinematics

SPEED_SLACK: Final = 1.2
"""Joints may seem this much faster than they can be: time stamps are not exact."""

READING_SLACK: Final = 0.005
"""How far two readings may differ beyond that, in [rad]."""


SPEED_WITHIN_S: Final = 3.0
"""So long two readings may be waited for that are near enough in time to tell a velocity, in [s]."""

BETWEEN_S: Final = 0.02
"""Pause between two readings, in [s]."""

TOLD_TO_STOP: Final = "the arm was told to stop; connect anew before it moves again"
"""Why a driver sends no move after a stop."""

LARGEST_TORQUE_SHARE: Final = 0.5
"""A torque window wider than this share of what a joint can do would guard nothing."""


@dataclass(frozen=True, kw_only=True)
class IiwaConfig:
    """Options that the drivers of an iiwa share: what is mounted, and how exactly readings must agree."""

    flange_xyz: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Where Sunrise's flange lies in the plain flange face (126 mm from the wrist), in [m]. A media flange moves it;
    KUKA's own ROS 2 model has (0, 0, 0.026)."""
    flange_rpy: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Fixed-axis roll, pitch, yaw of Sunrise's flange in the plain flange face, in [rad]."""
    tool_xyzabc: tuple[float, float, float, float, float, float] | None = None
    """The tool in Sunrise's flange frame: x, y, z, in [m], A, B, C, in [rad] about z, y, x. Only the pose check uses
    it; the load must be set in Sunrise."""
    torque_margin: tuple[float, ...] = (30.0, 30.0, 15.0, 15.0, 10.0, 4.0, 4.0)
    """How far each joint's torque may leave what it is before the move until the arm stops, in [N m]; about a tenth of
    what the joints can do. Shape (7,)."""
    pose_tolerance_m: float = 0.002
    """How far Sunrise's flange and ours may lie apart when connecting, in [m]."""
    pose_tolerance_rad: float = 0.01
    """The same for the orientation, in [rad]."""
    arrival_tolerance: float = 0.002
    """How far a joint may be from its target after a move, in [rad]; Sunrise itself allows 0.1 degrees."""
    rest_tolerance: float = 0.01
    """How far a joint may be from where it stood without a move, in [rad]."""

    LAXER: ClassVar[dict[str, Laxer]] = {
        "torque_margin": "more",
        "pose_tolerance_m": "more",
        "pose_tolerance_rad": "more",
        "arrival_tolerance": "more",
        "rest_tolerance": "more",
        "largest_segment": "more",
        "acceleration_fraction": "more",
        "contact_force": "more",
        "contact_tolerance": "more",
        "reply_timeout_s": "more",
        "move_margin_s": "more",
    }
    """Which way an option relaxes a check, in this class and in those of the drivers."""

    def __post_init__(self) -> None:
        most = LARGEST_TORQUE_SHARE * iiwa14.TORQUE_LIMITS
        if len(self.torque_margin) != iiwa14.NUM_JOINTS or not all(
            0.0 < t <= m for t, m in zip(self.torque_margin, most, strict=True)
        ):
            raise InvalidInputError(
                f"torque_margin must be {iiwa14.NUM_JOINTS} torques above 0 and up to half of what the joints can do, "
                f"{most.tolist()} N m, got {self.torque_margin}"
            )
        check_ranges(
            self,
            pose_tolerance_m=(1e-5, 0.01),
            pose_tolerance_rad=(1e-5, 0.05),
            arrival_tolerance=(1e-5, 0.02),
            rest_tolerance=(1e-5, 0.05),
        )


def check_move(move: JointMove, margin: float = 0.0) -> None:
    """What a driver asks of a move before anything is sent.

    Args:
        move: Any numbers.
        margin: How far inside the joints' limits it must end, in [rad].

    Raises:
        RefusedError: It is not finite, ends outside the limits, or its speed is none.
    """
    target = move.joint_positions
    if not np.all(np.isfinite(target)) or np.any(np.abs(target) > iiwa14.JOINT_UPPER - margin):
        within = f"{margin:g} rad within" if margin else "within"
        raise RefusedError(f"joint positions must be finite and {within} the limits, got {target}")
    if not 0.0 < move.speed_fraction <= 1.0:
        raise RefusedError(f"speed_fraction must be above 0 and at most 1, got {move.speed_fraction}")


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

    @property
    def earliest(self) -> float:
        """When it was measured at the earliest, by the driver's clock, in [s]."""
        return self.stamp - (self.answered - self.asked)


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


class ReadingLog:
    """The last two readings of one arm, which tell its velocity."""

    def __init__(self, rest_tolerance: float) -> None:
        """Begins empty.

        Args:
            rest_tolerance: How far a joint may turn without a move, in [rad].
        """
        self._rest_tolerance = rest_tolerance
        self._last: Reading | None = None
        self._previous: Reading | None = None

    def add(self, reading: Reading, moving: bool) -> str | None:
        """Takes a reading; what speaks against it, by which it is not taken.

        Args:
            reading: Its numbers are finite.
            moving: Whether a move was under way since the last one.
        """
        what = why_impossible(reading, self._last, moving, self._rest_tolerance)
        if what is None:
            self._previous, self._last = self._last, reading
        return what

    def state_by(self, look: Callable[[], object]) -> ArmState:
        """A fresh state.

        Args:
            look: Adds a reading.

        Raises:
            DeviceTimeoutError: Answers take so long that they tell no velocity.
        """
        deadline = time.monotonic() + SPEED_WITHIN_S
        look()
        while (state := self.state()) is None:
            if time.monotonic() > deadline:
                raise DeviceTimeoutError(
                    f"the controller answers too slowly to tell how fast the arm turns: in {SPEED_WITHIN_S:g} s no "
                    "two readings were less than 1 s apart"
                )
            time.sleep(BETWEEN_S)
            look()
        return state

    def state(self) -> ArmState | None:
        """Positions and velocities; None where the readings are too near or too far apart to tell these."""
        last, before = self._last, self._previous
        if last is None or before is None or last.asked - before.asked <= 0.005:
            return None
        if last.answered - before.asked >= 1.0:
            return None
        velocities = (last.positions - before.positions) / (last.asked - before.asked)
        return ArmState(
            joint_positions=last.positions,
            joint_velocities=velocities,
            stamp=last.stamp,
            stamp_error=last.answered - last.asked,
        )


class FlangeDifference(NamedTuple):
    """How far the controller's flange is from ours."""

    distance: float
    """In [m]."""
    angle: float
    """In [rad]."""

    @property
    def facts(self) -> dict[str, float]:
        """For `Arm.describe`."""
        return {
            "flange_difference_mm": round(1000.0 * self.distance, 3),
            "flange_difference_deg": round(math.degrees(self.angle), 4),
        }


def pose_difference(told: Float64, joint_positions: Float64, config: IiwaConfig) -> FlangeDifference:
    """How far the controller's tool, or flange, is from ours.

    Args:
        told: What the controller says: x, y, z, in [m], A, B, C, in [rad], base frame. Shape (6,).
        joint_positions: At the same time, in [rad]. Shape (7,).
        config: Flange, tool and tolerances.

    Raises:
        FaultError: Farther than the tolerances.
    """
    flange = forward_kinematics(torch.from_numpy(np.array(joint_positions))).numpy()
    expected = flange @ _transform(config.flange_xyz, config.flange_rpy)
    if config.tool_xyzabc is not None:
        x, y, z, a, b, c = config.tool_xyzabc
        expected = expected @ _transform((x, y, z), (c, b, a))
    actual = _transform((told[0], told[1], told[2]), (told[5], told[4], told[3]))
    distance, angle = difference(expected, actual)
    if distance <= config.pose_tolerance_m and angle <= config.pose_tolerance_rad:
        return FlangeDifference(distance, angle)
    apart = [round(1000.0 * float(v), 1) for v in (np.linalg.inv(expected) @ actual)[:3, 3]]
    raise FaultError(
        f"the controller's flange is {1000 * distance:.1f} mm and {math.degrees(angle):.2f} degrees from where our "
        f"kinematics put it (off by {apart} mm in its frame); set arm.flange_xyz and arm.flange_rpy to the mounted "
        "flange, and arm.tool_xyzabc to the tool"
    )


def _transform(xyz: tuple[float, float, float], rpy: tuple[float, float, float]) -> Float64:
    return transform(Rotation.from_euler("xyz", rpy), xyz)
