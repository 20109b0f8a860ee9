"""Requests and states of the LibIiwa application as bytes: 8 numbers out, 38 back, without a length or a checksum.

Joint angles in [rad]; lengths in [m] here and in [mm] on the wire.
"""

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

import numpy as np

from maniskill_tomato.deploy.deploy_errors import ProtocolError
from maniskill_tomato.deploy.interface import Float64
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.robot.iiwa14 import NUM_JOINTS

REQUEST_NUMBERS: Final = 8
STATE_NUMBERS: Final = 38


class Code(IntEnum):
    """What the driver asks for; none of these may be sent in a move but the first two."""

    STATE = 0
    STOP = 101
    MOVE_JOINTS = 102
    SPEED = 201
    ACCELERATION = 202
    JERK = 203
    FORCE_LIMITS = 211
    INTERFACE = 302
    MOTION_TYPE = 303
    CONTROL = 304
    EXECUTION = 305
    TOOL = 400


NO_ERROR: Final = -10

ERRORS: Final = {
    NO_ERROR: "no error",
    -11: "a value was not taken",
    -12: "an invalid joint",
    -13: "a synchronous move failed",
    -14: "an asynchronous move failed",
    -15: "impedance control was refused",
    -16: "an invalid configuration",
}
"""Last errors that the application knows. It never clears one, so that only a change tells something."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RobotState:
    """What comes back for every request; all numbers are finite."""

    done: bool
    """Whether the request was carried out. Not for `Code.STATE`, which is never."""
    joint_positions: Float64
    """In [rad]. Shape (7,)."""
    external_torque: Float64
    """What pushes on each joint, in [N m]. Shape (7,)."""
    pose: Float64
    """Tool or flange in the base frame: x, y, z, in [m], A, B, C, in [rad], R = Rz(A) Ry(B) Rx(C). Shape (6,)."""
    error: int
    """One of `ERRORS`, the last there was."""
    is_stopped_by_contact: bool
    """Whether a break condition ended the last move."""
    is_ready: bool
    """Whether a move would be taken."""
    is_active: bool
    """Whether there is a move; may come late, and is no word of where the arm is."""


class Messages:
    """Both directions at one precision."""

    def __init__(self, double_precision: bool) -> None:
        """Fixes the layout.

        Args:
            double_precision: 8 bytes a number instead of 4.
        """
        kind = "d" if double_precision else "f"
        self._request = struct.Struct(f">{REQUEST_NUMBERS}{kind}")
        self._state = struct.Struct(f">{STATE_NUMBERS}{kind}")
        self._number = struct.Struct(f">{kind}")

    @property
    def state_size(self) -> int:
        """Of a state, in bytes."""
        return self._state.size

    def rounded(self, values: Sequence[float]) -> Float64:
        """The numbers as they arrive."""
        return np.array([self._number.unpack(self._number.pack(v))[0] for v in values])

    def request(self, code: Code, values: Sequence[float] = ()) -> bytes:
        """The bytes of a request.

        Raises:
            InvalidInputError: There are too many numbers, or one is not finite: the application takes NaN for `keep`.
        """
        numbers = [float(v) for v in values]
        if len(numbers) >= REQUEST_NUMBERS or not all(math.isfinite(v) for v in numbers):
            raise InvalidInputError(
                f"{code.name} takes at most {REQUEST_NUMBERS - 1} finite numbers, got {numbers}"
            )
        padding = [0.0] * (REQUEST_NUMBERS - 1 - len(numbers))
        try:
            return self._request.pack(float(code), *numbers, *padding)
        except OverflowError as error:
            raise InvalidInputError(f"{code.name} takes numbers up to 3e38, got {numbers}") from error

    def state(self, content: bytes) -> RobotState:
        """The state in `state_size` bytes.

        Raises:
            ProtocolError: These are no numbers of the application.
        """
        numbers = np.array(self._state.unpack(content), dtype=np.float64)
        if not np.isfinite(numbers).all():
            raise ProtocolError(f"number {int((~np.isfinite(numbers)).argmax())} of its state is not finite")
        for index in (0, 35, 36, 37):
            if numbers[index] not in (0.0, 1.0):
                raise ProtocolError(f"number {index} of its state is {numbers[index]:g}, not 0 or 1")
        if numbers[34] not in ERRORS:
            raise ProtocolError(f"its last error is {numbers[34]:g}, which it does not have")
        pose = numbers[22:28].copy()
        pose[:3] /= 1000.0
        return RobotState(
            done=bool(numbers[0]),
            joint_positions=numbers[1 : 1 + NUM_JOINTS],
            external_torque=numbers[15 : 15 + NUM_JOINTS],
            pose=pose,
            error=int(numbers[34]),
            is_stopped_by_contact=bool(numbers[35]),
            is_ready=bool(numbers[36]),
            is_active=bool(numbers[37]),
        )
