"""The driver `sunrise`: an iiwa as an `Arm`. Readings are checked; moves are short, guarded by torque and verified.

A point-to-point move of the controller cannot be stopped over the network: only the smartPAD or the emergency stop
halts it. Moves are therefore sent in pieces, and `stop` keeps the next piece back.
"""

import logging
import math
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
from maniskill_tomato.deploy.profile_bounds import relaxed
from maniskill_tomato.deploy.straight_moves import move_seconds, straight_pieces
from maniskill_tomato.deploy.sunrise.client import SunriseClient
from maniskill_tomato.deploy.sunrise.line_connection import LineConnection
from maniskill_tomato.deploy.sunrise.sunrise_config import SunriseConfig
from maniskill_tomato.deploy.toml_tables import parse_table
from maniskill_tomato.robot import iiwa14

logger = logging.getLogger(__name__)

ONLY_SMARTPAD: Final = "only the smartPAD or the emergency stop halts it"

POLL_S: Final = 0.05
"""Between two looks at the joints in a move, in [s]."""

PIECE_S: Final = 0.35
"""Between two pieces of a move for the exchange of commands and the server's pauses, in [s]."""


class SunriseArm(Arm):
    """An iiwa 14 whose controller runs the Sunrise Toolbox server. Not for use from several threads, except `stop`."""

    name = "sunrise"
    model = iiwa14.IIWA14
    simulated = False
    can_stop = False

    def __init__(self, config: SunriseConfig, clock: Clock) -> None:
        """Touches nothing.

        Args:
            config: How to reach it.
            clock: Where the time stamps come from.
        """
        self._config = config
        self._clock = clock
        self._client: SunriseClient | None = None
        self._readings = ReadingLog(config.rest_tolerance)
        self._pieces: list[Float64] = []
        self._speed = 0.0
        self._piece: Float64 | None = None
        self._piece_deadline = 0.0
        self._stop_asked = False
        self._pose_error: FlangeDifference | None = None

    @property
    def is_connected(self) -> bool:
        return self._client is not None and self._client.is_open

    def connect(self) -> None:
        """Connects, mounts the tool, and compares the controller's flange with ours.

        Raises:
            NotConnectedError: The server does not take the connection.
            FaultError: Both disagree about where the flange is, or joints read what cannot be.
            DeviceTimeoutError: The server does not answer; it may have a client already.
            ProtocolError: It answers nonsense.
        """
        if self.is_connected:
            return
        config = self._config
        connection = LineConnection(config.host, config.port, config.connect_timeout_s)
        time.sleep(config.connect_pause_s)
        self._client = SunriseClient(connection, config.reply_timeout_s)
        self._readings = ReadingLog(config.rest_tolerance)
        self._piece, self._pieces, self._stop_asked = None, [], False
        try:
            if config.tool_xyzabc is not None:
                self._client.mount_tool(config.tool_xyzabc)
            told = self._client.tool_pose()
            self._pose_error = pose_difference(told, self._measure().positions, config)
        except DeployError:
            self.disconnect()
            raise

    def disconnect(self) -> None:
        if self._client is None:
            return
        if self._piece is not None:
            logger.warning("disconnecting in a move, which goes on to its end: %s", ONLY_SMARTPAD)
        self._client.close("the driver disconnected")
        self._client = None
        self._pieces, self._piece = [], None

    def describe(self) -> dict[str, Any]:
        facts: dict[str, Any] = {
            "driver": self.name,
            "address": f"{self._config.host}:{self._config.port}",
            "stopping": f"a stop takes effect at the end of a piece of a move; within one {ONLY_SMARTPAD}",
        }
        return facts if self._pose_error is None else facts | self._pose_error.facts

    def read(self, max_age_s: float = 0.5) -> ArmState:
        # Every reading is asked for, and so is never old; two of them tell the velocity.
        del max_age_s
        with self._telling_of_a_move():
            return self._readings.state_by(self._measure)

    def relaxations(self) -> tuple[str, ...]:
        return tuple(relaxed("arm", self._config, self._config.LAXER))

    def move_seconds(self, turn: Float64, speed_fraction: float) -> float:
        ends = straight_pieces(np.zeros(iiwa14.NUM_JOINTS), turn, self._config.largest_segment)
        return len(ends) * (move_seconds(np.zeros(iiwa14.NUM_JOINTS), ends[0], speed_fraction) + PIECE_S)

    def command(self, move: JointMove) -> JointMove:
        client = self._connected()
        if self._piece is not None and client.is_open:
            raise RefusedError("another move is under way")
        check_move(move)
        if self._stop_asked:
            raise RefusedError(TOLD_TO_STOP)
        start = self._measure().positions
        target = np.round(move.joint_positions, 9)
        self._pieces = straight_pieces(start, target, self._config.largest_segment)
        self._speed = move.speed_fraction
        with self._telling_of_a_move():
            self._next_piece(client)
        return JointMove(joint_positions=target, speed_fraction=float(f"{self._speed:.9f}"))

    def wait(self, timeout_s: float) -> bool:
        with self._telling_of_a_move():
            return self._wait(timeout_s)

    def _wait(self, timeout_s: float) -> bool:
        client = self._connected()
        deadline = time.monotonic() + timeout_s
        while self._piece is not None:
            remaining = deadline - time.monotonic()
            ended = client.motion_end(max(0.0, min(POLL_S, remaining)))
            if ended is not None:
                self._finish_piece(client, ended)
                continue
            # Also a controller that has fallen silent shows at the next look.
            self._measure()
            if time.monotonic() > self._piece_deadline:
                self._give_up("the move takes twice as long as it should")
                raise DeviceTimeoutError(
                    "the move has not ended in twice its computed time; nothing more is sent"
                )
            if time.monotonic() >= deadline:
                return self._piece is None
        return True

    def stop(self) -> bool:
        self._stop_asked = True
        return self._piece is None

    def _next_piece(self, client: SunriseClient) -> None:
        target, rest = self._pieces[0], self._pieces[1:]
        around = client.torques(self._config.torque_kind)
        margin = np.array(self._config.torque_margin)
        windows = np.stack([around - margin, around + margin], axis=1)
        start = self._measure().positions
        self._pieces = []
        # Until the controller refuses it, a move that was sent counts as under way, answered or not.
        self._piece = target
        try:
            client.start_move(target.tolist(), self._speed, windows.tolist(), self._is_free_to_go)
        except RefusedError:
            self._piece = None
            raise
        self._pieces = rest
        seconds = move_seconds(start, target, self._speed)
        self._piece_deadline = time.monotonic() + 2.0 * seconds + self._config.move_margin_s

    def _finish_piece(self, client: SunriseClient, ended: str) -> None:
        assert self._piece is not None
        rest, self._pieces = self._pieces, []
        try:
            off = float(np.max(np.abs(self._measure().positions - self._piece)))
        except FaultError:
            if client.is_open:
                self._piece = None
            raise
        self._piece = None
        if ended == "nak":
            raise FaultError(
                "the controller broke the move off (`nak`): a limit, a stop or an error; look at the smartPAD"
            )
        if ended == "interrupted":
            raise FaultError(
                "the arm was stopped by a torque outside its window: it touched something, or arm.torque_margin or "
                "arm.torque_kind of the profile do not fit; look before it moves again"
            )
        if off > self._config.arrival_tolerance:
            raise FaultError(
                f"the controller says that the move is done, but a joint is {math.degrees(off):.2f} degrees off"
            )
        if rest and self._is_free_to_go():
            self._pieces = rest
            try:
                self._next_piece(client)
            except RefusedError:
                if self._is_free_to_go():
                    raise

    def _is_free_to_go(self) -> bool:
        return not self._stop_asked and (self.may_go is None or self.may_go())

    def _measure(self) -> Reading:
        """Joint angles that can be true."""
        client = self._connected()
        positions = client.joint_positions()
        reading = Reading(client.asked_at, time.monotonic(), self._clock.now(), positions)
        what = self._readings.add(reading, self._piece is not None)
        if what is not None:
            raise self._impossible(what)
        if self.on_reading is not None:
            self.on_reading(positions, reading.earliest, reading.stamp)
        return reading

    @contextmanager
    def _telling_of_a_move(self) -> Iterator[None]:
        """Errors of the connection say that a move under way goes on without it."""
        try:
            yield
        except (NotConnectedError, DeviceTimeoutError, ProtocolError) as error:
            if self._piece is None:
                raise
            raise type(error)(f"{error}. The arm may be in a move, which goes on: {ONLY_SMARTPAD}") from error

    def _connected(self) -> SunriseClient:
        if self._client is None:
            raise NotConnectedError("the arm is not connected; call connect()")
        return self._client

    def _impossible(self, what: str) -> FaultError:
        self._give_up(f"its readings cannot be true: {what}")
        return FaultError(
            f"the arm reports {what}: guided by hand, or broken data; nothing more is sent to it, and if it moves, "
            f"{ONLY_SMARTPAD}"
        )

    def _give_up(self, why: str) -> None:
        self._pieces = []
        if self._client is not None:
            self._client.close(why)


def make_arm(options: Mapping[str, Any], context: DriverContext) -> SunriseArm:
    """The driver of a profile's `arm` table.

    Raises:
        ProfileError: An option is unknown or wrong.
    """
    return SunriseArm(parse_table(SunriseConfig, options, "arm"), context.clock)
