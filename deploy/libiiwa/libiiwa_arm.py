"""The driver `libiiwa`: an iiwa as an `Arm` whose moves can be cancelled.

The application on the controller says `done` to much that it does not do, and never says that a move has ended. So
every answer counts only as far as the joints bear it out, and speed and acceleration, which begin at their largest,
are set before every move. Nothing is claimed of a move whose answers have stopped.
"""

import logging
import math
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, Final

import numpy as np

from maniskill_tomato.deploy.clock import Clock
from maniskill_tomato.deploy.deploy_errors import (
    DeployError,
    DeviceTimeoutError,
    FaultError,
    NotConnectedError,
    ProtocolError,
    RefusedError,
)
from maniskill_tomato.deploy.drivers import DriverContext
from maniskill_tomato.deploy.iiwa_readings import (
    TOLD_TO_STOP,
    FlangeDifference,
    Reading,
    ReadingLog,
    check_move,
    pose_difference,
)
from maniskill_tomato.deploy.interface import Arm, ArmState, Float64, JointMove
from maniskill_tomato.deploy.libiiwa.client import LibiiwaClient
from maniskill_tomato.deploy.libiiwa.libiiwa_config import LibiiwaConfig
from maniskill_tomato.deploy.libiiwa.messages import ERRORS, Code, RobotState
from maniskill_tomato.deploy.libiiwa.robot_connection import RobotConnection
from maniskill_tomato.deploy.profile_bounds import relaxed
from maniskill_tomato.deploy.straight_moves import move_seconds, straight_pieces
from maniskill_tomato.deploy.toml_tables import parse_table
from maniskill_tomato.robot import iiwa14

_logger = logging.getLogger(__name__)

POLL_S: Final = 0.02
"""Between two looks at the robot in a move, in [s]."""

PIECE_S: Final = 0.2
"""Between two pieces of a move until the arm is seen to stand and the next one has been sent, in [s]."""

LIMIT_MARGIN: Final = 1e-3
"""Targets stay this far inside the joints' limits, in [rad]: a joint whose target is beyond them, if only by rounding,
stays where it is, and the robot says that all is done."""

AT_REST: Final = 0.005
"""A joint that turns more slowly stands, in [rad/s]."""

BEGINS_WITHIN: Final = 0.5
"""After its start a move may for so long look as if it had ended, in [s]."""

STANDS_WITHIN: Final = 2.0
"""After a stop the arm stands within this, in [s]."""

SETTINGS: Final = (
    (Code.INTERFACE, 31, "the standard interface"),
    (Code.MOTION_TYPE, 21, "point-to-point moves"),
    (Code.CONTROL, 41, "position control"),
    (Code.EXECUTION, 51, "asynchronous moves, without which nothing could be stopped"),
)
"""What the driver needs, whatever the application begins with."""


class LibiiwaArm(Arm):
    """An iiwa 14 whose controller runs LibIiwa. Not for use from several threads, except `stop`."""

    name = "libiiwa"
    model = iiwa14.IIWA14
    simulated = False
    can_stop = True

    def __init__(self, config: LibiiwaConfig, clock: Clock) -> None:
        """Touches nothing.

        Args:
            config: How to reach it.
            clock: Where the time stamps come from.
        """
        self._config = config
        self._clock = clock
        self._client: LibiiwaClient | None = None
        self._readings = ReadingLog(config.rest_tolerance)
        self._pieces: list[Float64] = []
        self._speed = 0.0
        self._piece: Float64 | None = None
        self._began = self._deadline = 0.0
        self._error_before = 0
        self._torque_before = np.zeros(iiwa14.NUM_JOINTS)
        self._stop_asked = threading.Event()
        self._stopped_at = math.inf
        self._pose_error: FlangeDifference | None = None

    @property
    def is_connected(self) -> bool:
        return self._client is not None and self._client.is_open

    def connect(self) -> None:
        """Waits for the robot, compares its flange with ours, and makes it ready for moves that can be cancelled.

        Raises:
            NotConnectedError: The robot does not connect.
            FaultError: Both disagree about where the flange is, or joints read what cannot be.
            RefusedError: It does not take the tool or a setting.
            DeviceTimeoutError: It does not answer.
            ProtocolError: It answers nonsense, or at another precision.
        """
        if self.is_connected:
            return
        config = self._config
        connection = RobotConnection(config.host, config.port, config.controller, config.connect_timeout_s)
        self._readings = ReadingLog(config.rest_tolerance)
        self._piece, self._pieces = None, []
        self._stop_asked.clear()
        self._stopped_at = math.inf
        try:
            client = LibiiwaClient(connection, config.double_precision, config.reply_timeout_s)
            self._client = client
            self._look()
            client.stop()
            for code, value, what in SETTINGS:
                client.set(code, [value], what)
            if config.tool_index is not None:
                client.set(Code.TOOL, [config.tool_index], f"the tool {config.tool_index} (arm.tool_index)")
            limits = [config.contact_force] * 3 + [config.contact_tolerance] * 3
            client.set(Code.FORCE_LIMITS, limits, "the largest force on the flange")
            state = self._look()
            self._pose_error = pose_difference(state.pose, state.joint_positions, config)
        except DeployError as error:
            connection.close(str(error))
            self._client = None
            raise

    def disconnect(self) -> None:
        client, self._client = self._client, None
        if client is None:
            return
        if self._piece is not None:
            try:
                client.stop()
            except DeployError as error:
                _logger.warning("a move is under way, and the robot takes no stop: %s", error)
        client.close("the driver disconnected")
        self._pieces, self._piece = [], None

    def describe(self) -> dict[str, Any]:
        facts: dict[str, Any] = {
            "driver": self.name,
            "address": f"{self._config.controller}, to port {self._config.port} here",
            "stopping": "a stop cancels the move under way; with the cable pulled, it goes on to the end of its piece",
        }
        return facts if self._pose_error is None else facts | self._pose_error.facts

    def read(self, max_age_s: float = 0.5) -> ArmState:
        # Every reading is asked for, and so is never old; two of them tell the velocity.
        del max_age_s
        with self._telling_of_a_move():
            return self._readings.state_by(self._look)

    def command(self, move: JointMove) -> JointMove:
        client = self._connected()
        if self._stop_asked.is_set():
            raise RefusedError(TOLD_TO_STOP)
        if self._piece is not None and client.is_open:
            raise RefusedError("another move is under way")
        check_move(move, LIMIT_MARGIN)
        with self._telling_of_a_move():
            state = self._look()
            if not state.is_ready or state.is_active:
                why = "it has a move already" if state.is_active else "a stop, or a released enabling switch"
                raise RefusedError(f"the robot is not ready to move: {why}; look at the smartPAD")
            target = client.rounded(move.joint_positions.tolist())
            self._pieces = straight_pieces(state.joint_positions, target, self._config.largest_segment)
            self._speed = float(client.rounded([move.speed_fraction])[0])
            self._torque_before = state.external_torque
            self._next_piece(client, state)
        return JointMove(joint_positions=target, speed_fraction=self._speed)

    def relaxations(self) -> tuple[str, ...]:
        return tuple(relaxed("arm", self._config, self._config.LAXER))

    def move_seconds(self, turn: Float64, speed_fraction: float) -> float:
        acceleration, rest = self._config.acceleration_fraction, np.zeros(iiwa14.NUM_JOINTS)
        ends = straight_pieces(rest, turn, self._config.largest_segment)
        return len(ends) * (move_seconds(rest, ends[0], speed_fraction, acceleration) + PIECE_S)

    def wait(self, timeout_s: float) -> bool:
        with self._telling_of_a_move():
            deadline = time.monotonic() + timeout_s
            while self._piece is not None:
                state = self._look()
                if self._stop_asked.is_set():
                    self._check_braking(state)
                else:
                    self._check_move(state)
                left = deadline - time.monotonic()
                if self._piece is not None and left <= 0.0:
                    return False
                if self._piece is not None:
                    time.sleep(min(POLL_S, left))
            return True

    def stop(self) -> bool:
        self._stop_asked.set()
        client = self._client
        if client is None:
            return self._piece is None
        try:
            client.stop()
        except DeployError as error:
            _logger.warning("the robot does not take a stop: %s", error)
            return False
        self._stopped_at = min(self._stopped_at, time.monotonic())
        return True

    def _next_piece(self, client: LibiiwaClient, state: RobotState) -> None:
        target, rest = self._pieces[0], self._pieces[1:]
        acceleration = self._config.acceleration_fraction
        self._pieces = []
        client.set(Code.SPEED, [self._speed], "the speed")
        client.set(Code.ACCELERATION, [acceleration], "the acceleration")
        client.set(Code.JERK, [acceleration], "the jerk")
        # Until the robot refuses it, a move that was sent counts as under way, answered or not.
        self._piece = target
        try:
            self._error_before = client.start_move(target, self._is_free_to_go).error
        except RefusedError:
            self._piece = None
            raise
        self._pieces = rest
        self._began = time.monotonic()
        seconds = move_seconds(state.joint_positions, target, self._speed, acceleration)
        self._deadline = self._began + 2.0 * seconds + self._config.move_margin_s

    def _is_free_to_go(self) -> bool:
        return not self._stop_asked.is_set() and (self.may_go is None or self.may_go())

    def _check_braking(self, state: RobotState) -> None:
        """Whether an arm that was told to stop stands."""
        self._pieces = []
        if not state.is_active and self._is_at_rest():
            self._piece = None
        elif time.monotonic() > self._stopped_at + STANDS_WITHIN:
            raise FaultError(
                f"the arm was told to stop {STANDS_WITHIN:g} s ago and does not stand: use the emergency stop"
            )

    def _check_move(self, state: RobotState) -> None:
        """Goes on with the next piece once this one has ended where it should."""
        assert self._piece is not None
        pushed = np.abs(state.external_torque - self._torque_before)
        if state.is_stopped_by_contact or np.any(pushed > self._config.torque_margin):
            joint = int((pushed / self._config.torque_margin).argmax())
            raise self._halted(
                f"the arm touched something: the torque at joint {joint + 1} changed by {pushed[joint]:.1f} N m, or "
                "the force on the flange passed arm.contact_force; look before it moves again"
            )
        if state.error != self._error_before:
            raise self._halted(f"the robot broke the move off: {ERRORS[state.error]}; look at the smartPAD")
        if not state.is_ready:
            raise self._halted(
                "the robot is not ready any more, such as by a stop or a released enabling switch; the move was "
                "cancelled, so that it does not go on when it is ready again"
            )
        off = np.abs(state.joint_positions - self._piece)
        if not state.is_active and self._is_at_rest():
            if off.max() <= self._config.arrival_tolerance:
                self._finish_piece(state)
                return
            if time.monotonic() > self._began + BEGINS_WITHIN:
                k = int(off.argmax())
                raise self._halted(
                    f"the move has ended, but joint {k + 1} is {math.degrees(off[k]):.2f} degrees off: the robot "
                    "leaves a joint where it is whose target is beyond the limits of its own configuration, and breaks "
                    "moves off without a word"
                )
        if time.monotonic() > self._deadline:
            self._halt()
            raise DeviceTimeoutError("the move has not ended in twice its computed time; it was cancelled")

    def _finish_piece(self, state: RobotState) -> None:
        self._piece = None
        if self._pieces:
            try:
                self._next_piece(self._connected(), state)
            except RefusedError:
                if self._is_free_to_go():
                    raise

    def _is_at_rest(self) -> bool:
        state = self._readings.state()
        return state is not None and float(np.abs(state.joint_velocities).max()) < AT_REST

    def _look(self) -> RobotState:
        """A state whose joint angles can be true."""
        client = self._connected()
        asked = time.monotonic()
        state = client.state()
        reading = Reading(asked, time.monotonic(), self._clock.now(), state.joint_positions)
        what = self._readings.add(reading, self._piece is not None)
        if what is not None:
            raise self._halted(f"the arm reports {what}: guided by hand, or broken data")
        if self.on_reading is not None:
            self.on_reading(reading.positions, reading.earliest, reading.stamp)
        return state

    def _halted(self, why: str) -> FaultError:
        """Cancels the move, and makes the error that says why; the caller raises it."""
        return FaultError(f"{why} ({self._halt()})")

    def _halt(self) -> str:
        self._pieces = []
        return "it was told to stop" if self.stop() else "it takes no stop: use the emergency stop"

    @contextmanager
    def _telling_of_a_move(self) -> Iterator[None]:
        """Errors of the connection say what becomes of a move under way."""
        try:
            yield
        except (NotConnectedError, DeviceTimeoutError, ProtocolError) as error:
            if self._piece is None or self.is_connected:
                raise
            raise type(error)(
                f"{error}. A move was under way: the robot cancels it when it hears that the connection is closed, and "
                "otherwise goes on to the end of the piece; use the emergency stop"
            ) from error

    def _connected(self) -> LibiiwaClient:
        if self._client is None:
            raise NotConnectedError("the arm is not connected; call connect()")
        return self._client


def make_arm(options: Mapping[str, Any], context: DriverContext) -> LibiiwaArm:
    """The driver of a profile's `arm` table.

    Raises:
        ProfileError: An option is unknown or wrong.
    """
    return LibiiwaArm(parse_table(LibiiwaConfig, options, "arm"), context.clock)
