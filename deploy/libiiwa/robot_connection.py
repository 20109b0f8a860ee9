"""The PC's end of the connection: it listens, the robot connects, and every answer has a deadline."""

import contextlib
import logging
import socket
import time

from maniskill_tomato.deploy.deploy_errors import (
    DeployError,
    DeviceTimeoutError,
    NotConnectedError,
    ProtocolError,
)

_logger = logging.getLogger(__name__)

RESTART = "start the application LibIiwa on the smartPAD again: it connects once"


class RobotConnection:
    """One connection that is given up at the first error: what comes later could answer something else."""

    def __init__(self, host: str, port: int, controller: str, timeout_s: float) -> None:
        """Waits for the robot.

        Args:
            host: Own address to listen at; empty for all.
            port: TCP port.
            controller: Address of the controller; whoever else connects is sent away.
            timeout_s: How long to wait, in [s].

        Raises:
            NotConnectedError: The port cannot be listened at, or the robot does not connect.
        """
        self.peer = controller
        self._closed_because: str | None = None
        deadline = time.monotonic() + timeout_s
        try:
            listener = socket.create_server((host, port), backlog=1)
        except (OSError, OverflowError) as error:
            raise NotConnectedError(
                f"cannot listen at {host or 'any address'}, port {port}: {error}; look at arm.host and arm.port of the "
                "profile, and whether another program waits for the robot"
            ) from error
        _logger.info("waiting for the robot at port %d: start LibIiwa on the smartPAD", port)
        with listener:
            while True:
                listener.settimeout(max(deadline - time.monotonic(), 1e-3))
                try:
                    self._socket, (peer, *_) = listener.accept()
                except OSError as error:
                    raise NotConnectedError(
                        f"the robot did not connect to port {port} within {timeout_s:g} s; start the application "
                        "LibIiwa on the smartPAD once this program waits, and look at the cable and at the address of "
                        "this PC in the application's process data"
                    ) from error
                if peer == controller:
                    break
                _logger.warning("sent away %s: arm.controller of the profile is %s", peer, controller)
                self._socket.close()
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    @property
    def is_open(self) -> bool:
        """Whether it can still be used."""
        return self._closed_because is None

    def close(self, because: str) -> None:
        """Lets the connection go, by which the robot cancels its move; `because` is what later calls say."""
        if self._closed_because is None:
            self._closed_because = because
            with contextlib.suppress(OSError):
                self._socket.shutdown(socket.SHUT_RDWR)
            self._socket.close()

    def exchange(self, request: bytes, reply_size: int, timeout_s: float) -> bytes:
        """Sends a request and waits for its answer.

        Args:
            request: As it goes out, whole.
            reply_size: Of the answer, in bytes.
            timeout_s: How long both may take, in [s].

        Returns:
            `reply_size` bytes.

        Raises:
            NotConnectedError: The connection is gone.
            DeviceTimeoutError: The answer did not come in time, or not all of it.
            ProtocolError: There is more than the answer.
        """
        if self._closed_because is not None:
            raise NotConnectedError(f"not connected to the robot any more: {self._closed_because}; {RESTART}")
        deadline = time.monotonic() + timeout_s
        if self._received(1, 0.0):
            raise self.fail(ProtocolError, "it sent something unasked")
        try:
            self._socket.settimeout(timeout_s)
            self._socket.sendall(request)
        except OSError as error:
            raise self.fail(NotConnectedError, f"it broke: {error}") from error
        reply = b""
        while len(reply) < reply_size:
            left = deadline - time.monotonic()
            chunk = self._received(reply_size + 1 - len(reply), left) if left > 0.0 else b""
            if not chunk:
                came = f"{len(reply)} of {reply_size} bytes" if reply else "no answer"
                raise self.fail(DeviceTimeoutError, f"{came} within {timeout_s:g} s")
            reply += chunk
        if len(reply) > reply_size:
            raise self.fail(ProtocolError, f"it sent more than the {reply_size} bytes of an answer")
        return reply

    def _received(self, most: int, timeout_s: float) -> bytes:
        """What comes in; nothing if that takes too long."""
        try:
            self._socket.settimeout(timeout_s)
            chunk = self._socket.recv(most)
        except (TimeoutError, BlockingIOError):
            return b""
        except OSError as error:
            raise self.fail(NotConnectedError, f"it broke: {error}") from error
        if not chunk:
            raise self.fail(NotConnectedError, "the application on the controller has ended")
        return chunk

    def fail(self, kind: type[DeployError], why: str) -> DeployError:
        """Closes the connection and makes the error that says why; the caller raises it."""
        self.close(why)
        return kind(f"connection to the robot at {self.peer} given up: {why}; {RESTART}")
