"""A controller on this machine that answers like the Sunrise Toolbox server, for tests and rehearsals without an arm.

It keeps the server's two threads and their one command slot, hence also its races: commands to the main loop that
arrive during a plain point-to-point move, or right after a reply, are lost without a word. Faults can be added.
Nothing here is shared with the client, so that one's mistakes are not the other's.

Example:
    python -m maniskill_tomato.deploy.sunrise --port 30001 --fault nak@doPTP
"""

import contextlib
import logging
import math
import socket
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, get_args

from maniskill_tomato.deploy.loopback_faults import Fault, FaultSchedule
from maniskill_tomato.deploy.sunrise.loopback_motion import (
    SimulatedArm,
    flange_pose,
    transform_from_xyzabc,
    xyzabc_from_transform,
)
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.robot import iiwa14

FaultKind = Literal[
    "silent",
    "slow",
    "nak",
    "drop",
    "garbage",
    "partial",
    "endless",
    "nan",
    "jump",
    "contact",
    "swallow",
    "hurry",
    "stray",
    "stall",
    "crawl",
    "frozen",
]
"""What goes wrong: `silent` never answers again; `slow` answers after `seconds`; `nak` fails in the main loop; `drop`
closes the connection after `seconds`; `garbage` sends bytes that mean nothing; `partial` a line without an end;
`endless` a line that never ends; `nan` joint angles that are no numbers; `jump` joint angles `radians` away; `contact`
pushes on joint 2 while it moves; `swallow` loses this one command. From the next move on, `hurry` ignores the asked
speed, `stray` leaves the path by `radians` at joint 7 and comes back, `stall` stands still half way, `crawl` takes 20
times as long; `frozen` sends the joint angles of now for ever."""


logger = logging.getLogger(__name__)


@dataclass(kw_only=True)
class LoopbackController:
    """The server application and the arm behind it; a context manager that serves one client."""

    qpos: Sequence[float] = field(default_factory=lambda: [0.0, 0.35, 0.0, -1.2, 0.0, 1.5, 0.0])
    """Joint angles at the start, in [rad]. Shape (7,)."""
    host: str = "127.0.0.1"
    """Address to listen at; the default can be reached from this machine only."""
    port: int = 0
    """Port to listen at; 0 takes a free one, `address` tells which."""
    speedup: float = 1.0
    """How much faster than a real arm this one moves."""
    media_flange_m: float = 0.0
    """How much farther out the flange lies than the plain one, in [m]; KUKA's own model has 0.026."""
    accept_seconds: float = 60.0
    """How long it waits for its client."""
    slot_seconds: float = 0.002
    """Time between a reply of the main loop and the clearing of its slot, in which a command is lost."""
    coalesce: bool = False
    """Send `done` of a move twice in one packet where the move is short."""
    faults: Sequence[Fault] = ()
    """What goes wrong."""

    def __post_init__(self) -> None:
        self.arm = SimulatedArm(self.qpos, self.speedup)
        self.received: list[str] = []
        """Every line that came in, for tests."""
        self.lost: list[str] = []
        """Commands of the main loop that were erased unanswered, for tests."""
        self._slot = ""
        self._target = [0.0] * 7
        self._relative_speed = 0.0
        self._tool = [0.0] * 6
        self._schedule = FaultSchedule(self.faults, get_args(FaultKind))
        self._connection: socket.socket | None = None
        self._send_lock = threading.Lock()
        self._over = threading.Event()
        self._muted = False
        self._joint_fault: Fault | None = None
        self._contact = False
        self._frozen: list[float] | None = None
        self._listener: socket.socket | None = None
        self._threads: list[threading.Thread] = []

    @property
    def address(self) -> tuple[str, int]:
        """Where a client connects."""
        if self._listener is None:
            raise InvalidInputError("the controller is not running; use it in a `with` block")
        host, port = self._listener.getsockname()[:2]
        return str(host), int(port)

    @property
    def tool(self) -> list[float]:
        """The mounted tool, x, y, z [mm] and A, B, C [rad]; zeros for the flange. Shape (6,)."""
        return list(self._tool)

    @property
    def over(self) -> bool:
        """Whether the application has ended."""
        return self._over.is_set()

    def __enter__(self) -> "LoopbackController":
        self._listener = socket.create_server((self.host, self.port), backlog=5)
        self._listener.settimeout(self.accept_seconds)
        for work in (self._serve, self._main_loop):
            thread = threading.Thread(target=work, name=f"loopback{work.__name__}", daemon=True)
            thread.start()
            self._threads.append(thread)
        return self

    def __exit__(self, *exception: object) -> None:
        self._over.set()
        self._hang_up()
        if self._listener is not None:
            self._listener.close()
        for thread in self._threads:
            thread.join(timeout=5.0)

    def wait(self) -> None:
        """Blocks until the application has ended."""
        while not self._over.wait(0.2):
            pass

    # The reader thread.

    def _serve(self) -> None:
        assert self._listener is not None
        try:
            connection, peer = self._listener.accept()
        except OSError:
            self._over.set()
            return
        logger.info("client %s", peer)
        connection.settimeout(0.05)
        self._connection = connection
        pending = b""
        while not self._over.is_set():
            try:
                chunk = connection.recv(4096)
            except TimeoutError:
                continue
            except OSError:
                break
            if not chunk:
                # The real reader never notices that its client has gone; the arm keeps what it was told.
                self._over.wait(0.05)
                continue
            pending += chunk
            while b"\n" in pending:
                line, pending = pending.split(b"\n", 1)
                if not self._take(line.decode("ascii", errors="replace").rstrip("\r")):
                    return

    def _take(self, line: str) -> bool:
        """One line of the client; whether to go on reading."""
        self.received.append(line)
        fault = self._schedule.due(line)
        if fault is not None and not self._begin(fault):
            return True
        self._slot = line
        if line.startswith("jp_"):
            self._set_target(line)
            self._slot = ""
            self._send("done\n")
        elif line.startswith("getJointsPositions"):
            self._slot = ""
            self._send(self._joint_line())
        elif line.startswith("getPin"):
            self._slot = ""
            self._send("1\n\n")
        elif line.startswith("stopDirectServoJoints") or line.startswith("blue"):
            self._slot = ""
            self._send("done\n")
        elif line.startswith("end"):
            self._over.set()
            self._hang_up()
            return False
        return True

    def _set_target(self, line: str) -> None:
        for index, text in enumerate([t for t in line.split("_")[1:] if t][:7]):
            self._target[index] = float(text)

    def _joint_line(self) -> str:
        values = list(self._frozen or self.arm.qpos)
        if self._joint_fault is not None:
            values[3] = math.nan if self._joint_fault.kind == "nan" else values[3] + self._joint_fault.radians
        return self._data(values)

    @staticmethod
    def _data(values: Sequence[float]) -> str:
        return "".join(f"{_java_double(v)}_" for v in values) + "\n"

    # The main loop.

    def _main_loop(self) -> None:
        while not self._over.is_set():
            command = self._slot
            if not command:
                time.sleep(0.0005)
                continue
            try:
                known = self._execute(command)
            except (ValueError, ArithmeticError, IndexError) as error:
                logger.info("nak to %r: %s", command, error)
                self._slot = ""
                self._tool = [0.0] * 6
                self._send("nak\n")
                continue
            if not known:
                time.sleep(0.0005)  # An unknown word stays in the slot, unanswered.

    def _execute(self, command: str) -> bool:
        if command.startswith("TFtrans"):
            values = [float(t) for t in command.split("_")[1:] if t]
            if len(values) != 6:
                self._send("nak\n")
                self._over.set()
                return True
            self._tool = values
            self._reply(command, "done\n")
        elif command.startswith("jRelVel"):
            self._relative_speed = float(command.split("_")[1])
            self._reply(command, "done\n")
        elif command == "Eef_pos":
            pose = flange_pose(self.arm.qpos, self.media_flange_m) @ transform_from_xyzabc(self._tool)
            self._reply(command, self._data(xyzabc_from_transform(pose)))
        elif command.startswith("Torques_ext_J") or command.startswith("Torques_m_J"):
            self._reply(command, self._data(self.arm.external_torque))
        elif command.startswith("doPTPinJS"):
            if not self.coalesce:
                self._send("done\n")
            self._move([])
            self._reply(command, "done\ndone\n" if self.coalesce else "done\n")
        elif command.startswith("doPTP!inJS"):
            windows = self._windows(command)
            # Unlike the plain move, the guarded one frees the slot before it moves.
            self._reply(command, "done\n")
            if not windows:
                self._send("done\n")
                return True
            self._move(windows)
            near = all(
                abs(a - b) <= math.radians(0.1) for a, b in zip(self.arm.qpos, self._target, strict=True)
            )
            self._send("done\n" if near else "interrupted\n")
        else:
            return False
        return True

    def _windows(self, command: str) -> list[tuple[int, float, float]]:
        tokens = [t for t in command.split("_")[1:] if t]
        return [
            (int(float(tokens[i])), float(tokens[i + 1]), float(tokens[i + 2]))
            for i in range(0, len(tokens) - 2, 3)
        ]

    def _move(self, windows: Sequence[tuple[int, float, float]]) -> None:
        if not 0.0 < self._relative_speed <= 1.0:
            raise ValueError(f"relative velocity {self._relative_speed}")
        if not all(math.isfinite(q) for q in self._target):
            raise ValueError("target is not a number")
        for q, upper in zip(self._target, iiwa14.JOINT_UPPER, strict=True):
            if abs(q) > upper:
                raise ValueError(f"target {q} beyond {upper}")
        began = time.monotonic()

        def keep_going() -> bool:
            if self._contact and time.monotonic() - began > 0.05 / self.speedup:
                self.arm.external_torque[1] = 60.0
            inside = all(low <= self.arm.external_torque[i] <= high for i, low, high in windows)
            return inside and not self._over.is_set()

        self.arm.move(list(self._target), self._relative_speed, keep_going)

    def _reply(self, command: str, text: str) -> None:
        """Answers, then clears the slot a little later, as the real main loop does."""
        self._send(text)
        time.sleep(self.slot_seconds)
        if self._slot not in ("", command):
            self.lost.append(self._slot)
        self._slot = ""

    # What goes wrong.

    def _begin(self, fault: Fault) -> bool:
        """Starts a fault; whether the command itself is still to be carried out."""
        logger.info("fault %s", fault)
        if fault.kind == "silent":
            self._muted = True
        elif fault.kind == "slow":
            time.sleep(fault.seconds)
        elif fault.kind == "nak":
            self._tool = [0.0] * 6
            self._send("nak\n")
            return False
        elif fault.kind == "drop":
            threading.Timer(fault.seconds, self._hang_up).start()
        elif fault.kind == "garbage":
            self._send_bytes(b"\xff\xfe\x00GET / HTTP\x80\n")
        elif fault.kind == "partial":
            self._send_bytes(b"0.1_0.2_0.")
            self._muted = True
        elif fault.kind == "endless":
            self._send_bytes(b"1.0_" * 20000)
            self._muted = True
        elif fault.kind in ("nan", "jump"):
            self._joint_fault = fault
        elif fault.kind == "contact":
            self._contact = True
        elif fault.kind == "swallow":
            return False
        elif fault.kind in ("hurry", "stray", "stall", "crawl"):
            self.arm.disobeys, self.arm.strays_by = fault.kind, fault.radians
        elif fault.kind == "frozen":
            self._frozen = self.arm.qpos
        return True

    def _send(self, text: str) -> None:
        if not self._muted:
            self._send_bytes(text.encode("ascii"))

    def _send_bytes(self, content: bytes) -> None:
        with self._send_lock:
            if self._connection is not None:
                with contextlib.suppress(OSError):
                    self._connection.sendall(content)

    def _hang_up(self) -> None:
        if self._connection is not None:
            with contextlib.suppress(OSError):
                self._connection.shutdown(socket.SHUT_RDWR)
            self._connection.close()


def _java_double(value: float) -> str:
    """A number as Java prints it: always a point, an exponent below 1e-3 and from 1e7 on."""
    if math.isnan(value):
        return "NaN"
    if math.isinf(value):
        return "Infinity" if value > 0 else "-Infinity"
    if value == 0.0 or 1e-3 <= abs(value) < 1e7:
        return repr(value)
    mantissa, exponent = f"{value:.16e}".split("e")
    mantissa = mantissa.rstrip("0")
    return f"{mantissa}{'0' if mantissa.endswith('.') else ''}E{int(exponent)}"
