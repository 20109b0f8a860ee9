"""One conversation with the LibIiwa application: settings, moves, a stop from any thread.

A request is never sent before the answer to the last one is there, since answers carry no number. An answer that does
not come, or means nothing, ends the connection, by which the robot cancels its move.
"""

import threading
from collections.abc import Callable, Sequence

from maniskill_tomato.deploy.deploy_errors import DeployError, ProtocolError, RefusedError
from maniskill_tomato.deploy.iiwa_readings import TOLD_TO_STOP
from maniskill_tomato.deploy.interface import Float64
from maniskill_tomato.deploy.libiiwa.messages import ERRORS, NO_ERROR, Code, Messages, RobotState
from maniskill_tomato.deploy.libiiwa.robot_connection import RobotConnection


class LibiiwaClient:
    """Safe to use from several threads."""

    def __init__(self, connection: RobotConnection, double_precision: bool, reply_timeout_s: float) -> None:
        """Asks for the state, once: eight zeros, which mean the same at either precision.

        Args:
            connection: To the robot, fresh.
            double_precision: Whether numbers have 8 bytes instead of 4.
            reply_timeout_s: How long an answer may take, in [s].

        Raises:
            DeployError: There is no answer, or none of the application at this precision.
        """
        self._connection = connection
        self._messages = Messages(double_precision)
        self._timeout = reply_timeout_s
        self._lock = threading.Lock()
        self._error, self._has_new_error = NO_ERROR, False
        try:
            self._exchange(Code.STATE)
        except DeployError as error:
            raise type(error)(
                f"{error}. Is arm.double_precision = {str(double_precision).lower()} what the process data of the "
                "application say?"
            ) from error

    @property
    def is_open(self) -> bool:
        """Whether the robot can still be talked to."""
        return self._connection.is_open

    def close(self, because: str) -> None:
        """Ends the connection, and so the application on the controller with its move. Never raises."""
        self._connection.close(because)

    def rounded(self, values: Sequence[float]) -> Float64:
        """The numbers as the robot gets them."""
        return self._messages.rounded(values)

    def state(self) -> RobotState:
        """The present state; in a move too."""
        with self._lock:
            return self._exchange(Code.STATE)

    def set(self, code: Code, values: Sequence[float], what: str) -> None:
        """Sets something, with no move under way: some settings end one.

        Raises:
            RefusedError: The robot does not take it.
            DeployError: The connection is gone.
        """
        with self._lock:
            state = self._exchange(code, values)
            if not state.done:
                raise RefusedError(f"the robot did not take {what}: {self._why(state)}")

    def start_move(self, joint_positions: Float64, may_go: Callable[[], bool]) -> RobotState:
        """Starts a point-to-point move.

        Args:
            joint_positions: Where to, in [rad]. Shape (7,).
            may_go: Asked right before the move is sent; no stop comes between.

        Raises:
            RefusedError: The robot does not take it, or it may not go.
            DeployError: The connection is gone.
        """
        with self._lock:
            if not may_go():
                raise RefusedError(TOLD_TO_STOP)
            state = self._exchange(Code.MOVE_JOINTS, joint_positions.tolist())
            if not state.done:
                raise RefusedError(
                    f"the robot did not take the move: {self._why(state)}; look at the smartPAD"
                )
        return state

    def stop(self) -> None:
        """Cancels the move under way.

        Raises:
            DeployError: The robot does not answer; the connection is closed, which cancels too where it arrives.
        """
        with self._lock:
            if not self._exchange(Code.STOP).done:
                raise self._connection.fail(ProtocolError, "it did not take a stop")

    def _why(self, state: RobotState) -> str:
        if not state.is_ready:
            return "it is not ready to move, such as by a stop or a released enabling switch"
        # An error stays for good, so that an old one says nothing of this request.
        return ERRORS[state.error] if self._has_new_error else "it does not say why"

    def _exchange(self, code: Code, values: Sequence[float] = ()) -> RobotState:
        request = self._messages.request(code, values)
        reply = self._connection.exchange(request, self._messages.state_size, self._timeout)
        try:
            state = self._messages.state(reply)
        except ProtocolError as error:
            raise self._connection.fail(ProtocolError, str(error)) from error
        self._has_new_error, self._error = state.error != self._error, state.error
        return state
