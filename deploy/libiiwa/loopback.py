"""A robot on this machine that behaves like the LibIiwa application on a controller, for tests and rehearsals.

It connects to the PC, as the real one does, and keeps its hazards: full speed and acceleration until others are set, a
joint beyond its limits left where it is and reported as done, NaN that means `keep`, an error that is never cleared,
no word of a move's end, and a pulled cable that it does not notice. It knows point-to-point moves in joint space, on
the standard interface; Cartesian moves, the servo interface and impedance are answered as unknown.

Nothing here is shared with the driver, so that one's mistakes are not the other's.

Example:
    python -m maniskill_tomato.deploy.libiiwa --port 12225 --fault contact@102
"""

import contextlib
import logging
import math
import socket
import struct
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final, Literal, get_args

import numpy as np

from maniskill_tomato.deploy.libiiwa.loopback_arm import CancellableArm
from maniskill_tomato.deploy.loopback_faults import Fault, FaultSchedule
from maniskill_tomato.deploy.sunrise.loopback_motion import (
    flange_pose,
    transform_from_xyzabc,
    xyzabc_from_transform,
)
from maniskill_tomato.robot import iiwa14

FaultKind = Literal[
    "silent",
    "slow",
    "split",
    "double",
    "partial",
    "garbage",
    "nan",
    "jump",
    "refused",
    "drop",
    "cut",
    "not_ready",
    "failed",
    "contact",
    "hurry",
]
"""What goes wrong: `silent` obeys but never answers again; `slow` answers after `seconds`; `split` sends the answer in
pieces; `double` sends it twice; `partial` sends half of it, and no other; `garbage` sends random bytes; `nan` joint
angles that are no numbers; `jump` joint angles `radians` away; `refused` does not do this and answers with an error.
`seconds` later: `drop` ends the application; `cut` is a pulled cable, which the robot does not notice; `not_ready` is
a released enabling switch; `failed` an error in the move; `contact` something that the arm runs into.
From the next move on `hurry` ignores the speed that was set."""

LATER: Final = ("drop", "cut", "not_ready", "failed", "contact")
"""These happen `seconds` after their command."""

CANCELLING: Final = (211, 212, 302, 303, 304, 305, 400)
"""Settings that end a move under way."""

_logger = logging.getLogger(__name__)


class _ApplicationOver(Exception):
    """The application ends: an exception that nothing catches, or a connection that is gone."""


@dataclass(kw_only=True)
class LoopbackRobot:
    """The application and the arm behind it; a context manager. It connects once, and ends with its connection."""

    port: int
    """Where the PC listens."""
    host: str = "127.0.0.1"
    """The PC's address."""
    qpos: Sequence[float] = field(default_factory=lambda: [0.0, 0.35, 0.0, -1.2, 0.0, 1.5, 0.0])
    """Joint angles at the start, in [rad]. Shape (7,)."""
    double_precision: bool = False
    """Whether numbers have 8 bytes instead of 4."""
    speedup: float = 1.0
    """How much faster than a real arm this one moves."""
    joint_limits: Sequence[float] = field(default_factory=lambda: list(iiwa14.JOINT_UPPER))
    """Largest joint angles that the controller takes, both ways, in [rad]. Shape (7,)."""
    media_flange_m: float = 0.0
    """How much farther out the flange lies than the plain one, in [m]."""
    tools: Sequence[Sequence[float]] = ()
    """Frames of the tools that it knows: x, y, z [mm], A, B, C [rad]. Each of shape (6,)."""
    execution: int = 51
    """How moves are made at the start: 51 asynchronously, 52 synchronously."""
    flag_lag_s: float = 0.0
    """For so long after its start a move is not reported to be active, in [s]."""
    start_lag_s: float = 0.0
    """For so long after its start the arm still stands, in [s]."""
    tries_for_s: float = 0.0
    """For so long it tries to connect, in [s]; the real application tries once."""
    faults: Sequence[Fault] = ()
    """What goes wrong."""

    def __post_init__(self) -> None:
        self.arm = CancellableArm(self.qpos, self.speedup)
        self.received: list[tuple[float, ...]] = []
        """Every request that came in, for tests. Each of shape (8,)."""
        self.cancelled_by: list[int] = []
        """Codes of the settings that ended a move under way, for tests."""
        self.stopped_at: float | None = None
        """When the first stop of a move under way arrived, by `time.monotonic`, in [s]."""
        self.ended_because = ""
        """Why the application is over, for tests."""
        self._schedule = FaultSchedule(self.faults, get_args(FaultKind))
        self._over = threading.Event()
        self._connection: socket.socket | None = None
        self._settings = {201: 1.0, 202: 1.0, 203: 1.0, 204: 1000.0, 205: 1000.0, 206: 1000.0}
        self._force_limits: list[float | None] = [None] * 3
        self._torque_windows: list[tuple[float, float] | None] = [None] * 7
        self._tool: int | None = None
        self._error = -10
        self._stopped_by_condition = False
        self._ready = True
        self._move_began = -math.inf
        self._external_torque = [0.0] * 7
        self._force = [0.0] * 3
        self._joint_fault: Fault | None = None
        self._reply_fault: Fault | None = None
        self._mute = self._cut = self._refuse = self._hurries = False

    @property
    def over(self) -> bool:
        """Whether the application has ended."""
        return self._over.is_set()

    def __enter__(self) -> "LoopbackRobot":
        self._thread = threading.Thread(target=self._run, name="loopback robot", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._end("it was switched off")
        self._thread.join(timeout=5.0)

    def wait(self, timeout_s: float | None = None) -> bool:
        """Blocks until the application has ended; whether it has within `timeout_s` [s]."""
        return self._over.wait(timeout_s)

    # The one thread.

    def _run(self) -> None:
        give_up_at = time.monotonic() + self.tries_for_s
        while self._connection is None and not self._over.is_set():
            try:
                self._connection = socket.create_connection((self.host, self.port), timeout=5.0)
            except OSError as error:
                if time.monotonic() >= give_up_at:
                    self._end(f"nobody listens: {error}")
                self._over.wait(0.02)
        if self._connection is None:
            return
        self._connection.settimeout(None)
        self._connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        layout = struct.Struct(">8d" if self.double_precision else ">8f")
        try:
            while not self._over.is_set():
                # One call: a request that comes in two parts ends the application.
                content = self._connection.recv(layout.size)
                if self._cut:
                    self._over.wait()
                    return
                if len(content) != layout.size:
                    raise _ApplicationOver(f"{len(content)} bytes instead of {layout.size}")
                self._take(layout.unpack(content))
        except _ApplicationOver as error:
            self._end(str(error))
        except OSError as error:
            self._end(f"connection lost: {error}")

    def _end(self, why: str) -> None:
        if not self._over.is_set():
            self.ended_because = why
        self._over.set()
        self.arm.cancel()
        if self._connection is not None:
            with contextlib.suppress(OSError):
                self._connection.shutdown(socket.SHUT_RDWR)
            self._connection.close()

    def _take(self, numbers: tuple[float, ...]) -> None:
        self.received.append(numbers)
        if numbers[0] <= -0.5:
            raise _ApplicationOver(f"code {numbers[0]}")
        code = None if math.isnan(numbers[0]) else round(numbers[0])
        fault = self._schedule.due(str(code))
        if fault is not None and fault.kind not in LATER:
            self._begin(fault)
        done = code is not None and not self._refuse and self._execute(code, numbers[1:])
        if self._refuse:
            self._error, self._refuse = -11, False
        if fault is not None and fault.kind in LATER:
            # Counted from when the command was carried out, however busy this machine is.
            self._begin(fault)
        self._reply(done)

    def _execute(self, code: int, values: tuple[float, ...]) -> bool:
        if code in CANCELLING:
            if self.arm.moves:
                self.cancelled_by.append(code)
            self._stop()
        if code == 101:
            if self.arm.moves and self.stopped_at is None:
                self.stopped_at = time.monotonic()
            self._stop()
            return True
        if code == 102:
            return self._move(values)
        if code in (201, 202, 203):
            return self._set(code, values[0], not (values[0] < 0.0 or values[0] > 1.0))
        if code in (204, 205, 206):
            return self._set(code, values[0], values[0] > 0.0)
        if code == 211:
            return self._set_force_limits(values)
        if code == 212:
            return self._set_torque_window(values)
        if code == 400:
            return self._set_tool(round(values[0]))
        choices = {301: (11, 12), 302: (31,), 303: (21, 22, 23, 24), 304: (41, 42, 43, 44), 305: (51, 52)}
        if code not in choices:
            return False
        value = round(values[0])
        if value not in choices[code]:
            self._error = self._error if code == 301 else -11
            return False
        if value == 12:
            self._mute = self._cut = True  # It never reads again.
        if code == 305:
            self.execution = value
        return True

    def _set(self, code: int, value: float, accepted: bool) -> bool:
        if accepted:  # NaN is.
            self._settings[code] = value
        else:
            self._error = -11
        return accepted

    def _set_force_limits(self, values: Sequence[float]) -> bool:
        good = True
        for axis in range(3):
            threshold, tolerance = values[axis], values[axis + 3]
            self._force_limits[axis] = None
            if math.isnan(threshold) or math.isnan(tolerance):
                continue
            if threshold >= 0.0 and tolerance > 0.0:
                self._force_limits[axis] = threshold
            else:
                self._error, good = -11, False
        return good

    def _set_torque_window(self, values: Sequence[float]) -> bool:
        joint, low, high = round(values[0]), values[1], values[2]
        if not 0 <= joint < 7:
            raise _ApplicationOver("an index out of bounds")
        self._torque_windows[joint] = None
        if math.isnan(low) or math.isnan(high):
            return True
        if low >= high:
            self._error = -11
            return False
        self._torque_windows[joint] = (low, high)
        return True

    def _set_tool(self, index: int) -> bool:
        self._tool = None
        if index >= len(self.tools) and index >= 0:
            self._error = -11 if self.tools else -16
            return False
        self._tool = index if index >= 0 else None
        return True

    def _move(self, values: Sequence[float]) -> bool:
        if not self._ready:
            return False
        now = self.arm.qpos
        # NaN and what is beyond the limits leave the joint where it is.
        target = [
            wanted if abs(wanted) <= limit else here
            for wanted, limit, here in zip(values, self.joint_limits, now, strict=True)
        ]
        speed, acceleration = self._settings[201], self._settings[202]
        if not (speed > 0.0 and acceleration > 0.0):
            raise _ApplicationOver(f"a move at the speed {speed}")
        self._stopped_by_condition, self._move_began = False, time.monotonic()
        self.arm.start(target, 1.0 if self._hurries else speed, acceleration, self.start_lag_s)
        if self.execution == 52:
            while self.arm.moves:
                time.sleep(0.001)
        return True

    def _stop(self) -> None:
        self.arm.cancel()
        self._stopped_by_condition = False

    # The answer.

    def _reply(self, done: bool) -> None:
        content = self._state(done)
        fault, self._reply_fault = self._reply_fault, None
        kind = None if fault is None else fault.kind
        if kind == "partial":
            content, mute_from_now = content[: len(content) // 2], True
        else:
            mute_from_now = False
        if kind == "garbage":
            content = bytes(np.random.default_rng(0).integers(0, 256, len(content), np.uint8))
        if self._mute:
            return
        self._mute = mute_from_now
        connection = self._connection
        assert connection is not None
        if fault is not None and kind == "slow":
            self._over.wait(fault.seconds)
        if kind == "split":
            for at in range(0, len(content), 11):
                connection.sendall(content[at : at + 11])
                time.sleep(0.001)
            return
        connection.sendall(content * 2 if kind == "double" else content)

    def _state(self, done: bool) -> bytes:
        joints = self.arm.qpos.tolist()
        pose = flange_pose(joints, self.media_flange_m)
        if self._tool is not None:
            pose = pose @ transform_from_xyzabc(self.tools[self._tool])
        if self._joint_fault is not None:
            is_nan = self._joint_fault.kind == "nan"
            joints[3] = math.nan if is_nan else joints[3] + self._joint_fault.radians
        active = self.arm.moves and time.monotonic() - self._move_began >= self.flag_lag_s
        numbers = [
            float(done),
            *joints,
            *self.arm.qvel.tolist(),
            *self._external_torque,
            *xyzabc_from_transform(pose),
            *self._force,
            *[0.0] * 3,
            float(self._error),
            float(self._stopped_by_condition),
            float(self._ready),
            float(active),
        ]
        return struct.pack(">38d" if self.double_precision else ">38f", *numbers)

    # What goes wrong.

    def _begin(self, fault: Fault) -> None:
        _logger.info("fault %s", fault)
        if fault.kind in LATER:
            timer = threading.Timer(fault.seconds, self._happen, (fault.kind,))
            timer.daemon = True
            timer.start()
        elif fault.kind == "silent":
            self._mute = True
        elif fault.kind == "hurry":
            self._hurries = True
        elif fault.kind == "refused":
            self._refuse = True
        elif fault.kind in ("nan", "jump"):
            self._joint_fault = fault
        else:
            self._reply_fault = fault

    def _happen(self, kind: str) -> None:
        if kind == "drop":
            self._end("a fault")
        elif kind == "cut":
            self._mute = self._cut = True
        elif kind == "not_ready":
            self._ready = False
            self.arm.cancel()
        elif kind == "failed":
            self._error = -14
            self.arm.cancel()
        elif kind == "contact":
            self._external_torque[1], self._force[2] = 60.0, -60.0
            if self.arm.moves and self._is_beyond():
                self.arm.cancel()
                self._stopped_by_condition = True

    def _is_beyond(self) -> bool:
        """Whether a condition that is set ends the move."""
        pushed = any(
            limit is not None and abs(force) > limit
            for limit, force in zip(self._force_limits, self._force, strict=True)
        )
        turned = any(
            window is not None and not window[0] <= torque <= window[1]
            for window, torque in zip(self._torque_windows, self._external_torque, strict=True)
        )
        return pushed or turned
