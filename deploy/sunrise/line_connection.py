"""Text lines over TCP with deadlines and a largest length. Input is not trusted until it is a line of ASCII."""

import socket
import time
from typing import Final

from maniskill_tomato.deploy.deploy_errors import DeployError, NotConnectedError, ProtocolError

MAX_LINE_BYTES: Final = 512
"""The longest line taken; seven numbers as Java prints them have less than 200."""


class LineConnection:
    """One TCP connection that is given up at the first error: what comes later could answer something else."""

    def __init__(self, host: str, port: int, timeout_s: float) -> None:
        """Connects.

        Args:
            host: Address of the controller.
            port: TCP port.
            timeout_s: How long to try, in [s].

        Raises:
            NotConnectedError: Nothing takes the connection.
        """
        self._where = f"{host}:{port}"
        self._pending = b""
        self._closed_because: str | None = None
        try:
            self._socket = socket.create_connection((host, port), timeout=timeout_s)
        except (OSError, ValueError, OverflowError) as error:
            raise NotConnectedError(
                f"no connection to {self._where}: {error}; start the toolbox server on the smartPAD (it waits 60 s "
                "for one client), and look at the cable, both addresses and arm.host, arm.port of the profile"
            ) from error
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    @property
    def is_open(self) -> bool:
        """Whether it can still be used."""
        return self._closed_because is None

    def close(self, because: str = "it was closed") -> None:
        """Lets the connection go; `because` is what later calls say. Never raises."""
        if self._closed_because is None:
            self._closed_because = because
            self._socket.close()

    def send(self, line: str, timeout_s: float) -> None:
        """Sends one line.

        Args:
            line: ASCII without its end.
            timeout_s: The longest that it may take, in [s].

        Raises:
            NotConnectedError: The connection is gone.
        """
        self._require_open()
        try:
            self._socket.settimeout(timeout_s)
            self._socket.sendall(line.encode("ascii") + b"\n")
        except OSError as error:
            raise self.fail(
                NotConnectedError, f"it broke while sending {line.split('_')[0]!r}: {error}"
            ) from error

    def receive(self, timeout_s: float) -> str | None:
        """The next line that is not empty, without its end; None if none comes in time.

        Args:
            timeout_s: The longest wait, in [s]; 0 takes only what is there.

        Raises:
            NotConnectedError: The connection is gone.
            ProtocolError: A line is too long or holds other bytes than printable ASCII.
        """
        self._require_open()
        deadline, has_looked = time.monotonic() + timeout_s, False
        while True:
            while (end := self._pending.find(b"\n")) >= 0:
                line, self._pending = self._pending[:end], self._pending[end + 1 :]
                if text := self._checked(line):
                    return text
            if len(self._pending) > MAX_LINE_BYTES:
                raise self.fail(
                    ProtocolError, f"it sent more than {MAX_LINE_BYTES} bytes without an end of line"
                )
            remaining = deadline - time.monotonic()
            # Empty lines do not prolong the wait.
            if has_looked and remaining <= 0.0:
                return None
            if not self._fill(max(remaining, 0.0)):
                return None
            has_looked = True

    def _fill(self, timeout_s: float) -> bool:
        """Takes what has come in; whether there was any."""
        try:
            self._socket.settimeout(max(timeout_s, 0.0))
            chunk = self._socket.recv(4096)
        except (TimeoutError, BlockingIOError):
            return False
        except OSError as error:
            raise self.fail(NotConnectedError, f"it broke: {error}") from error
        if not chunk:
            raise self.fail(NotConnectedError, "the controller closed it")
        self._pending += chunk
        return True

    def _checked(self, line: bytes) -> str:
        line = line.rstrip(b"\r")
        if len(line) > MAX_LINE_BYTES:
            raise self.fail(
                ProtocolError, f"it sent a line of {len(line)} bytes; {MAX_LINE_BYTES} are allowed"
            )
        if not all(0x20 <= byte < 0x7F for byte in line):
            raise self.fail(ProtocolError, f"it sent {line[:40]!r}, which is no text of the toolbox server")
        return line.decode("ascii").strip()

    def fail(self, kind: type[DeployError], why: str) -> DeployError:
        """Closes the connection and makes the error that says why; the caller raises it."""
        self.close(why)
        return kind(
            f"connection to {self._where} given up: {why}; restart the toolbox server on the smartPAD"
        )

    def _require_open(self) -> None:
        if self._closed_because is not None:
            raise NotConnectedError(
                f"not connected to {self._where} any more: {self._closed_because}; restart the toolbox server on the "
                "smartPAD, which takes one client, and connect again"
            )
