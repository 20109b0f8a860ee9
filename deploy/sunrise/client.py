"""Commands of the KUKA Sunrise Toolbox server (KST 1.7 LTS), one method each; motions are acknowledged twice.

The server has two threads and one slot for a command. Its main loop clears the slot a little after it has
answered, and a command that comes in between is lost without a word: hence the pause after each of its answers. While a
move is under way only joint positions may be asked for; the move's last status may come before their answer.
A reply that does not come ends the connection, because a late one could answer the next command. Joint angles in
[rad], lengths in [m] here and in [mm] on the wire.
"""

import logging
import math
import re
import time
from collections.abc import Callable, Sequence
from typing import Final, Literal

import numpy as np

from maniskill_tomato.deploy.deploy_errors import (
    DeployError,
    DeviceTimeoutError,
    FaultError,
    ProtocolError,
    RefusedError,
)
from maniskill_tomato.deploy.iiwa_readings import TOLD_TO_STOP
from maniskill_tomato.deploy.interface import Float64
from maniskill_tomato.deploy.sunrise.line_connection import LineConnection
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.robot.iiwa14 import NUM_JOINTS

logger = logging.getLogger(__name__)

PAUSE_S: Final = 0.05
"""Between an answer of the main loop and the next command, in [s]."""

NUMBER: Final = re.compile(r"-?[0-9]{1,17}\.[0-9]{1,20}(E-?[0-9]{1,3})?")
"""A number as Java prints it."""

MotionEnd = Literal["done", "interrupted", "nak"]
"""How a move ended: there, stopped by a torque outside its window, or by an exception on the controller."""

TorqueKind = Literal["external", "measured"]


class SunriseClient:
    """One conversation with the server. Not for use from several threads at once."""

    def __init__(self, connection: LineConnection, reply_timeout_s: float = 2.0) -> None:
        """Takes a fresh connection.

        Args:
            connection: To the server.
            reply_timeout_s: How long a reply may take, in [s].
        """
        self._connection = connection
        self._timeout = reply_timeout_s
        self._quiet_until = 0.0
        self._moving = False
        self._motion_end: MotionEnd | None = None
        self._tool: tuple[float, ...] | None = None
        self._ask_started = 0.0

    @property
    def is_open(self) -> bool:
        """Whether the server can still be talked to."""
        return self._connection.is_open

    @property
    def is_moving(self) -> bool:
        """Whether a move was accepted whose end has not been seen."""
        return self._moving

    @property
    def asked_at(self) -> float:
        """When the last question was sent, by `time.monotonic`, in [s]."""
        return self._ask_started

    def close(self, because: str) -> None:
        """Ends the application on the controller, after a move under way, and the connection. Never raises."""
        if self._connection.is_open:
            try:
                self._connection.send("end", 0.5)
            except DeployError as error:
                logger.debug("the server took no `end`: %s", error)
        self._connection.close(because)

    def joint_positions(self) -> Float64:
        """Measured joint angles; also while a move is under way.

        Returns:
            In [rad]. Shape (7,).
        """
        return self._ask("getJointsPositions", NUM_JOINTS, of_main_loop=False)

    def tool_pose(self) -> Float64:
        """The pose of the mounted tool, or of the flange, in the base frame.

        Returns:
            x, y, z, in [m], and A, B, C, in [rad], with R = Rz(A) Ry(B) Rx(C). Shape (6,).
        """
        pose = self._ask("Eef_pos", 6)
        pose[:3] /= 1000.0
        return pose

    def torques(self, kind: TorqueKind) -> Float64:
        """Torques at the joints: what pushes on the arm, or what the sensors read, gravity included.

        Returns:
            In [N m]. Shape (7,).
        """
        return self._ask({"external": "Torques_ext_J", "measured": "Torques_m_J"}[kind], NUM_JOINTS)

    def mount_tool(self, xyzabc: Sequence[float]) -> None:
        """Sets the frame that `tool_pose` tells; sent again after every `nak`, which silently unmounts it.

        Args:
            xyzabc: The tool in the flange frame: x, y, z, in [m], A, B, C, in [rad]. Shape (6,).
        """
        tool = tuple(_finite(xyzabc, 6, "tool"))
        self._order("TFtrans", [*(1000.0 * v for v in tool[:3]), *tool[3:]])
        self._tool = tool

    def start_move(
        self,
        joint_positions: Sequence[float],
        relative_speed: float,
        windows: Sequence[tuple[float, float]] | None,
        may_go: Callable[[], bool] = lambda: True,
    ) -> Float64:
        """Starts a point-to-point move; joints start and stop together.

        Args:
            joint_positions: Where to, in [rad]. Shape (7,).
            relative_speed: Share of the largest joint speeds, above 0 and up to 1.
            windows: Smallest and largest torque of each joint, in [N m], outside which the arm stops. Shape
                (7, 2). None for a move that nothing but the safety circuit stops.
            may_go: Asked right before the line that begins the move.

        Returns:
            The joint angles as they were sent, in [rad]. Shape (7,).

        Raises:
            InvalidInputError: A number is not finite or a speed or a window impossible.
            RefusedError: The controller said `nak`, a move is under way, or this one may not go.
            NotConnectedError: The connection is gone; likewise `DeviceTimeoutError` and `ProtocolError`.
        """
        target = [float(_text(q)) for q in _finite(joint_positions, NUM_JOINTS, "joint_positions")]
        if not 0.0 < relative_speed <= 1.0:
            raise InvalidInputError(f"relative_speed must be above 0 and at most 1, got {relative_speed}")
        guard: list[float] = []
        for joint, window in enumerate(() if windows is None else windows):
            low, high = _finite(window, 2, "a torque window")
            if not low < high:
                raise InvalidInputError(
                    f"the torque window of joint {joint + 1} must have min < max, got {window}"
                )
            guard += [joint, low, high]
        if windows is not None and len(guard) != 3 * NUM_JOINTS:
            raise InvalidInputError(f"windows must have {NUM_JOINTS} entries, got {len(guard) // 3}")
        # The speed is one variable with the speed of straight lines, and stays: it goes before every move.
        self._order("jRelVel", [relative_speed])
        self._order("jp", target, of_main_loop=False)
        self._send("doPTPinJS" if windows is None else _command("doPTP!inJS", guard), may_go=may_go)
        self._expect_done("the move")
        self._moving, self._motion_end = True, None
        return np.array(target)

    def motion_end(self, timeout_s: float) -> MotionEnd | None:
        """How the move under way ended, or None if it has not within `timeout_s` [s].

        After `nak` the tool is mounted again.

        Raises:
            NotConnectedError: The connection is gone; likewise `DeviceTimeoutError` and `ProtocolError`.
        """
        if self._moving and self._motion_end is None:
            line = self._connection.receive(timeout_s)
            if line is not None and not self._take_motion_end(line):
                raise self._connection.fail(ProtocolError, f"it sent {line!r} in a move, unasked")
        ended = self._motion_end
        if ended is not None:
            self._moving, self._motion_end = False, None
            self._quiet_until = time.monotonic() + PAUSE_S
            if ended == "nak":
                self._mount_again()
        return ended

    def _take_motion_end(self, line: str) -> bool:
        if not self._moving or self._motion_end is not None:
            return False
        for status in ("done", "interrupted", "nak"):
            if line == status:
                self._motion_end = status
                return True
        return False

    def _order(self, word: str, values: Sequence[float], of_main_loop: bool = True) -> None:
        self._send(_command(word, values))
        self._expect_done(word)
        if of_main_loop:
            self._quiet_until = time.monotonic() + PAUSE_S

    def _expect_done(self, what: str) -> None:
        line = self._receive(what)
        self._quiet_until = time.monotonic() + PAUSE_S
        if line == "nak":
            self._mount_again()
            raise RefusedError(
                f"the controller refused {what} (`nak`); the smartPAD tells why, such as a limit or a stop"
            )
        if line != "done":
            raise self._connection.fail(ProtocolError, f"it answered {what} with {line!r} instead of `done`")

    def _mount_again(self) -> None:
        """The server drops the tool with every `nak`."""
        if self._tool is None:
            return
        tool, self._tool = self._tool, None
        try:
            self.mount_tool(tool)
        except RefusedError as error:
            self._connection.close("it refused the tool again")
            raise FaultError(
                f"the controller dropped the tool and does not take it again: {error}"
            ) from error

    def _ask(self, word: str, count: int, of_main_loop: bool = True) -> Float64:
        self._send(word, during_move=not of_main_loop)
        self._ask_started = time.monotonic()
        line = self._receive(word)
        if self._take_motion_end(line):
            line = self._receive(word)
        if of_main_loop:
            self._quiet_until = time.monotonic() + PAUSE_S
        if line == "nak":
            self._mount_again()
            raise FaultError(f"the controller failed at {word} (`nak`); look at the smartPAD")
        texts = line.split("_")
        if texts[-1:] == [""] and len(texts) == count + 1 and all(NUMBER.fullmatch(t) for t in texts[:-1]):
            values = np.array([float(t) for t in texts[:-1]])
            if np.isfinite(values).all():  # 1.0E999 is not.
                return values
        raise self._connection.fail(
            ProtocolError, f"it answered {word} with {line[:80]!r} instead of {count} finite numbers"
        )

    def _send(
        self, command: str, during_move: bool = False, may_go: Callable[[], bool] = lambda: True
    ) -> None:
        if self._moving and not during_move:
            raise RefusedError(f"a move is under way; {command.split('_')[0]} would be lost")
        time.sleep(max(0.0, self._quiet_until - time.monotonic()))
        left_over = self._connection.receive(0.0)
        if left_over is not None and not self._take_motion_end(left_over):
            raise self._connection.fail(ProtocolError, f"it sent {left_over!r}, unasked")
        if not may_go():
            raise RefusedError(TOLD_TO_STOP)
        self._connection.send(command, self._timeout)

    def _receive(self, what: str) -> str:
        line = self._connection.receive(self._timeout)
        if line is None:
            raise self._connection.fail(DeviceTimeoutError, f"no answer to {what} within {self._timeout:g} s")
        return line


def _finite(values: Sequence[float], count: int, name: str) -> list[float]:
    numbers = [float(v) for v in values]
    if len(numbers) != count or not all(math.isfinite(v) for v in numbers):
        raise InvalidInputError(f"{name} must be {count} finite numbers, got {numbers}")
    return numbers


def _text(value: float) -> str:
    return f"{value:.9f}"


def _command(word: str, values: Sequence[float]) -> str:
    return "_".join([word, *(str(v) if isinstance(v, int) else _text(v) for v in values), ""])
