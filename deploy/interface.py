"""The interfaces of an arm and a camera, with LeRobot's method names and typed, frozen results.

The world frame is the robot's base frame (`link_0`), z up. Units are metres, radians and seconds. Time stamps come from
the driver's `Clock` and say when the device took the measurement, as far as the driver knows.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.deploy.deploy_errors import ProfileError, ProtocolError
from maniskill_tomato.deploy.straight_moves import move_seconds
from maniskill_tomato.raycast.view_rays import ViewRays
from maniskill_tomato.robot.arm_model import NUM_JOINTS, ArmModel
from maniskill_tomato.robot.d435 import CameraIntrinsics

Float64 = NDArray[np.float64]

LIMIT_SLACK: Final = math.radians(1.0)
"""Measured joints may be this far beyond their limits, in [rad]."""


def frozen_array(values: Any, shape: tuple[int, ...], name: str) -> Float64:
    """A copy that cannot be written to.

    Raises:
        ProtocolError: The values are no numbers of this shape.
    """
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ProtocolError(f"{name} must be numbers of shape {shape}, got {values!r}") from error
    if array.shape != shape:
        raise ProtocolError(f"{name} must have shape {shape}, got {array.shape}")
    array.setflags(write=False)
    return array


@dataclass(frozen=True, eq=False, kw_only=True)
class ArmState:
    """What an arm measured at one moment. Numbers may be NaN: `safety` decides on that, not the driver."""

    joint_positions: Float64
    """In [rad]. Shape (7,)."""
    joint_velocities: Float64
    """In [rad/s]. Shape (7,)."""
    stamp: float
    """When it was measured, at the latest, in [s]."""
    stamp_error: float = 0.0
    """How much earlier than that it may have been measured, in [s]."""

    def __post_init__(self) -> None:
        for name in ("joint_positions", "joint_velocities"):
            object.__setattr__(self, name, frozen_array(getattr(self, name), (NUM_JOINTS,), name))


@dataclass(frozen=True, eq=False, kw_only=True)
class JointMove:
    """A move of all joints to a position, in which they start and stop together (PTP)."""

    joint_positions: Float64
    """Where to, in [rad]. Shape (7,)."""
    speed_fraction: float
    """Share of the joints' largest speeds."""

    def __post_init__(self) -> None:
        joints = frozen_array(self.joint_positions, (NUM_JOINTS,), "joint_positions")
        object.__setattr__(self, "joint_positions", joints)


@dataclass(frozen=True, eq=False, kw_only=True)
class FrameTruth:
    """What is really in a picture; only simulated cameras know it."""

    labels: NDArray[np.int32]
    """0 nothing, 1 the robot, 2 + k the plant's organ k. Shape (H, W)."""
    target_label: int
    """The target's label."""
    target_position: Float64
    """Centre of the target, world frame, in [m]. Shape (3,)."""
    visible_fraction: float
    """V_f of the target by ray casting, as in the simulated tasks."""
    ripe_labels: tuple[int, ...]
    """Labels of the ripe fruits, the target's among them."""
    rays: ViewRays
    """What the task's pattern of rays about the target meets."""
    fruit_labels: tuple[int, ...] = ()
    """Labels of all fruits in the order of `Plant.fruits`; empty where that is not known."""
    stem_labels: tuple[int, ...] = ()
    """Labels of stems and trusses; empty where that is not known."""
    ripe_fractions: tuple[float, ...] = ()
    """V_f of the ripe fruits by ray casting, in the order of `ripe_labels`; empty where that is not known."""

    def shown_label(self, mask: NDArray[np.bool_]) -> int | None:
        """Label of the ripe fruit that half of a mask or more shows; None if there is none. Shape (H, W)."""
        shown, counts = np.unique(self.labels[mask], return_counts=True)
        if not len(shown) or 2 * counts.max() < counts.sum():
            return None
        label = int(shown[counts.argmax()])
        return label if label in self.ripe_labels else None

    def fraction(self, label: int) -> float | None:
        """V_f of a ripe fruit; None where that is not known."""
        if label not in self.ripe_labels or not self.ripe_fractions:
            return None
        return self.ripe_fractions[self.ripe_labels.index(label)]


@dataclass(frozen=True, eq=False, kw_only=True)
class Frame:
    """One colour picture with the depth seen from the colour camera."""

    color: NDArray[np.uint8]
    """RGB. Shape (H, W, 3)."""
    depth: NDArray[np.float32]
    """Depth along the colour camera's optical axis, in [m], 0 where there is none. Shape (H, W)."""
    intrinsics: CameraIntrinsics
    """Of both images: depth is aligned to colour."""
    stamp: float
    """When it was taken, in [s]."""
    number: int
    """Counts up from frame to frame; the same number is the same picture."""
    truth: FrameTruth | None = None
    """What is in it, from simulated cameras."""

    def __post_init__(self) -> None:
        size = (self.intrinsics.height, self.intrinsics.width)
        for name, array, shape, kind in (
            ("color", self.color, (*size, 3), np.uint8),
            ("depth", self.depth, size, np.float32),
        ):
            if not isinstance(array, np.ndarray) or array.shape != shape or array.dtype != kind:
                found = (
                    f"{array.dtype} of shape {array.shape}" if isinstance(array, np.ndarray) else type(array)
                )
                raise ProtocolError(
                    f"{name} must be {np.dtype(kind)} of shape {shape}, as its intrinsics say, got {found}"
                )


class Device(ABC):
    """What arms and cameras have in common; a context manager that connects and disconnects."""

    name: str
    """Of the driver, as profiles call it."""

    @property
    @abstractmethod
    def is_connected(self) -> bool:
        """Whether the device can be used."""

    @abstractmethod
    def connect(self) -> None:
        """Opens the device; nothing moves.

        Raises:
            NotConnectedError: There is none, with what to do.
            DeviceTimeoutError: It does not answer.
            ProtocolError: It answers nonsense.
        """

    @abstractmethod
    def disconnect(self) -> None:
        """Lets the device go. Does nothing if it is not connected, and never raises."""

    def describe(self) -> dict[str, Any]:
        """Facts for `deploy check` and recordings: plain strings and numbers."""
        return {"driver": self.name}

    def __enter__(self) -> Self:
        try:
            self.connect()
        except BaseException:
            # A signal may come when half of it is done.
            with suppress(Exception):
                self.disconnect()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.disconnect()


class Arm(Device):
    """A seven-joint arm that goes to joint positions. `GuardedArm` is the only thing that may command one."""

    model: ArmModel
    """Its limits, geometry and shapes, by which every command is judged; every driver declares it."""
    simulated: bool = False
    """Whether nothing real moves: then runs need no confirmation."""
    can_stop: bool = False
    """Whether `stop` halts a move under way. The iiwa's PTP goes on until the smartPAD or the emergency stop."""
    on_reading: Callable[[Float64, float, float], None] | None = None
    """Drivers that send a move in pieces call this, where it is set, with every measurement before they send another
    piece: joint positions in [rad], and the earliest and the latest time of the measurement, in [s]. It raises, and
    calls `stop`, where the arm does not do what was asked."""

    may_go: Callable[[], bool] | None = None
    """Drivers ask this, where it is set, right before each line that begins a motion; where it says no, the line is not
    sent, and `command` raises `RefusedError`."""

    @abstractmethod
    def read(self, max_age_s: float = 0.5) -> ArmState:
        """The newest state.

        Args:
            max_age_s: The oldest that it may be, in [s].

        Raises:
            NotConnectedError: The arm is not there (any more).
            StaleError: All there is is older.
            DeviceTimeoutError: It does not answer.
            ProtocolError: It answers nonsense.
        """

    @abstractmethod
    def command(self, move: JointMove) -> JointMove:
        """Starts a move and returns at once.

        Args:
            move: Where to and how fast.

        Returns:
            What was really sent: a driver may round, and says so here.

        Raises:
            RefusedError: The controller does not take it, or another move is under way.
            NotConnectedError: As for `read`; likewise `DeviceTimeoutError` and `ProtocolError`.
        """

    def relaxations(self) -> tuple[str, ...]:
        """What the driver's options relax against their defaults, in words, for people to read at every start."""
        return ()

    def move_seconds(self, turn: Float64, speed_fraction: float) -> float:
        """How long a move takes that nothing holds up, with what the driver needs between its pieces.

        Args:
            turn: How far each joint turns, in [rad]. Shape (7,).
            speed_fraction: Share of the joints' largest speeds.

        Returns:
            In [s].
        """
        return move_seconds(np.zeros(NUM_JOINTS), turn, speed_fraction, model=self.model)

    @abstractmethod
    def wait(self, timeout_s: float) -> bool:
        """Waits for the end of the move under way; the loop calls it again and again and looks for stops between.

        Args:
            timeout_s: The longest wait, in [s].

        Returns:
            Whether the arm stands: the move has ended, or there was none.

        Raises:
            FaultError: The move ended otherwise, such as by contact or an error of the controller.
            NotConnectedError: As for `read`; likewise `DeviceTimeoutError` and `ProtocolError`.
        """

    @abstractmethod
    def stop(self) -> bool:
        """Does what can be done to end the move under way. Never raises.

        Returns:
            Whether the arm stands or comes to a stop by it; False if the move goes on.
        """


def declared_model(arm: Arm) -> ArmModel:
    """The model that an arm's driver declares.

    Raises:
        ProfileError: It declares none.
    """
    model = getattr(arm, "model", None)
    if not isinstance(model, ArmModel):
        raise ProfileError(
            f"the driver {getattr(arm, 'name', type(arm).__name__)} declares no model of its arm, so that nothing "
            "could judge its moves; set `model` to an ArmModel, such as read_arm_model makes of a URDF "
            "(docs/deploy.md, 'Another arm')"
        )
    return model


class Camera(Device):
    """An RGB-D camera on the flange."""

    simulated: bool = False
    """Whether its pictures are computed."""

    @property
    @abstractmethod
    def intrinsics(self) -> CameraIntrinsics:
        """Of the frames, once connected.

        Raises:
            NotConnectedError: It is not connected.
        """

    @property
    def announced_size(self) -> tuple[int, int] | None:
        """Width and height that frames will have, in [px], before it is connected; None if it cannot tell."""
        return None

    @abstractmethod
    def read(self, max_age_s: float = 0.5, after: float | None = None) -> Frame:
        """A frame, waiting for a new one if need be.

        Args:
            max_age_s: The oldest that it may be, in [s].
            after: It must have been taken after this moment, in [s]; None for any.

        Raises:
            NotConnectedError: The camera is not there (any more).
            StaleError: It sends the same picture again, or only old ones.
            DeviceTimeoutError: It sends nothing in time.
            ProtocolError: It sends something else than announced.
        """

    @property
    def serial(self) -> str:
        """The device's number once connected, by which a calibration knows it; empty if it has none."""
        return ""

    def begin_view(self) -> None:
        """Called when the arm has settled at a new viewpoint: filters over time must start anew."""
