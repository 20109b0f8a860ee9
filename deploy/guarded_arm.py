"""The only way to an arm: `Safety` checks every command, every reported state is checked before it is used, and what
comes back during a move is held against its plan (`move_watch`)."""

import logging
import math
from collections import deque
from collections.abc import Callable
from typing import Final

import numpy as np

from maniskill_tomato.deploy.clock import Clock
from maniskill_tomato.deploy.deploy_errors import (
    DeployError,
    DeviceTimeoutError,
    FaultError,
    HeartbeatLostError,
    ProfileError,
    RefusedError,
    StaleError,
    StoppedError,
)
from maniskill_tomato.deploy.fault_state import STATES_KEPT
from maniskill_tomato.deploy.interface import LIMIT_SLACK, Arm, ArmState, Float64, JointMove, declared_model
from maniskill_tomato.deploy.move_watch import MoveWatch
from maniskill_tomato.deploy.profile_bounds import check_envelope
from maniskill_tomato.deploy.refusals import Refusal
from maniskill_tomato.deploy.safety import Safety
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.robot.arm_model import ArmModel

_logger = logging.getLogger(__name__)

JUMP_SLACK: Final = 0.02
"""A joint may seem to turn this much beyond what its largest speed allows between two states, in [rad]."""

SENT_TOLERANCE: Final = 1e-3
"""What a driver sends may be rounded by this much, in [rad], and as a speed fraction."""


class GuardedArm:
    """An arm that refuses what is not safe. Nothing else in `deploy` calls `Arm.command`.

    A stop stays: after `stop`, or once the run's stops say so, no move is sent until `begin_run`.
    """

    def __init__(
        self, arm: Arm, safety: Safety, clock: Clock, why_forbidden: Callable[[], str | None] | None = None
    ) -> None:
        """Wraps an arm.

        Args:
            arm: Connected by the caller.
            safety: The envelope.
            clock: The one that the arm's time stamps come from.
            why_forbidden: Why no move may be sent at all, None while moves may be sent; asked before every move.

        Raises:
            ProfileError: The arm declares no model, or the envelope is of another one, or the arm is real and its
                envelope goes beyond what a profile may choose.
        """
        self._model = declared_model(arm)
        if safety.model is not self._model:
            raise ProfileError(
                f"the driver {arm.name} moves a {self._model.name!r}, but the safety checks are those of a "
                f"{safety.model.name!r}; make Safety with model=arm.model"
            )
        if not arm.simulated:
            try:
                check_envelope(safety.config)
            except InvalidInputError as error:
                raise ProfileError(f"the guard of a real arm: {error}") from error
        self._why_forbidden: Callable[[], str | None] = why_forbidden or _nobody
        self._stopped: str | None = None
        self._why_stop: Callable[[], str | None] = _nobody
        self._arm = arm
        self.safety = safety
        self._clock = clock
        self._last: ArmState | None = None
        self.recent: deque[ArmState] = deque(maxlen=STATES_KEPT)
        """The last readings, as the arm gave them, wrong ones too; the newest last."""
        self.refused: Refusal | None = None
        """Why the last command that was refused was refused."""
        self._under_way: JointMove | None = None
        self.watch: MoveWatch | None = None
        """Of the move under way, or of the last one."""
        self._watches = self._was_told = False
        self._broke_off = self._ended_it = False

    def begin_run(self, why_stop: Callable[[], str | None]) -> None:
        """Forgets the stop of an earlier run.

        Args:
            why_stop: Why the new one has to stop, None while it need not; asked before every move is sent and after.
        """
        self._stopped, self._why_stop, self._ended_it = None, why_stop, False

    @property
    def model(self) -> ArmModel:
        """What the arm's driver declares of it."""
        return self._model

    @property
    def simulated(self) -> bool:
        """Whether nothing real moves."""
        return self._arm.simulated

    @property
    def is_under_way(self) -> bool:
        """Whether a move was sent whose end nobody has seen."""
        return self._under_way is not None

    @property
    def why_stopped(self) -> str | None:
        """Why no move is sent until the next run; None if moves are sent."""
        return self._stopped

    @property
    def broke_off(self) -> bool:
        """Whether `stop` ended the last move."""
        return self._broke_off

    @property
    def can_stop(self) -> bool:
        """Whether `stop` halts a move under way."""
        return self._arm.can_stop

    def read(self) -> ArmState:
        """The newest state.

        Raises:
            FaultError: It cannot be true: not finite, outside the joints' limits, a jump, or from the future.
            DeployError: The arm does not give one.
        """
        state = self._arm.read(self.safety.config.max_state_age)
        self.recent.append(state)
        for name, values in (("positions", state.joint_positions), ("velocities", state.joint_velocities)):
            if not np.isfinite(values).all():
                raise FaultError(f"the arm reports joint {name} that are not finite: {values.tolist()}")
        now = self._clock.now()
        if not (state.stamp <= now and 0.0 <= state.stamp_error < math.inf):
            raise FaultError(
                f"the arm's state is of {state.stamp:.3f} s, with an error of {state.stamp_error:g} s, and it is "
                f"{now:.3f} s: no state can be of later, nor its error negative"
            )
        joints = state.joint_positions
        beyond = np.maximum(self._model.joint_lower - joints, joints - self._model.joint_upper)
        if (beyond > LIMIT_SLACK).any():
            k = int(beyond.argmax())
            low, high = np.rad2deg(self._model.joint_lower[k]), np.rad2deg(self._model.joint_upper[k])
            raise FaultError(
                f"the arm reports {self._model.joint_names[k]} at {np.rad2deg(joints[k]):.1f} deg, "
                f"{np.rad2deg(beyond[k]):.2f} deg outside its limits of {low:.1f} to {high:.1f} deg; check which unit "
                "it sends"
            )
        if self._last is not None:
            self._check_jump(self._last, state)
        self._last = state
        return state

    def _check_jump(self, before: ArmState, after: ArmState) -> None:
        elapsed = after.stamp - before.stamp
        if elapsed < 0.0:
            raise FaultError(f"the arm's time stamps went back by {-elapsed:.3f} s")
        allowed = self._model.velocity_limits * elapsed + JUMP_SLACK
        turned = np.abs(after.joint_positions - before.joint_positions)
        if (turned > allowed).any():
            k = int((turned - allowed).argmax())
            raise FaultError(
                f"{self._model.joint_names[k]} jumped by {turned[k]:.3f} rad in {elapsed:.3f} s: "
                f"{turned[k] - allowed[k]:.3f} rad more than the {allowed[k]:.3f} rad that it can turn"
            )

    def command(
        self, move: JointMove, frame_stamp: float | None = None, points_w: Float64 | None = None
    ) -> JointMove:
        """Sends a move that all checks let through, and returns at once.

        Args:
            move: Where to and how fast.
            frame_stamp: When the picture was taken that the decision rests on, in [s].
            points_w: What was seen of the plant, base frame, in [m]. Shape (P, 3).

        Returns:
            What was really sent.

        Raises:
            RefusedError: It is not safe, with the reason; nothing was sent.
            StoppedError: The run was stopped; nothing was sent.
            HeartbeatLostError: The same, because the loop stood still.
            FaultError: The driver says it sent something else than was checked.
        """
        forbidden = self._why_forbidden()
        if forbidden is not None:
            raise RefusedError(forbidden)
        state = self.read()
        refusal = self.safety.check(move, state, self._clock.now(), frame_stamp, points_w)
        if refusal is not None:
            self.refused = refusal
            # Its words are worked out when somebody asks for them.
            raise RefusedError(refusal)
        if self._under_way is not None:
            raise RefusedError("busy: the last move has not ended; wait for its end, or stop it")
        self._check_stopped()
        start = state.joint_positions
        seconds = self._arm.move_seconds(move.joint_positions - start, move.speed_fraction)
        self.watch = MoveWatch(start, move, seconds, self._clock.now(), self._model)
        self._watches = True
        self._arm.on_reading, self._arm.may_go = self._see, self._may_go
        try:
            sent = self._arm.command(move)
        except BaseException as error:
            self._watches = False
            if isinstance(error, RefusedError):
                self._check_stopped()
            raise
        self.watch.sent(self._clock.now())
        self._under_way, self._broke_off = sent, False
        if self._asked_to_stop() is not None:
            # Asked while it was sent.
            self.stop()
        off = float(np.abs(sent.joint_positions - move.joint_positions).max())
        if not off <= SENT_TOLERANCE:
            self.stop()
            raise FaultError(
                f"the driver sent joint positions that are {off:.4f} rad off the checked ones, allowed are "
                f"{SENT_TOLERANCE:g} rad"
            )
        if not sent.speed_fraction <= move.speed_fraction + SENT_TOLERANCE:
            self.stop()
            raise FaultError(
                f"the driver sent the speed fraction {sent.speed_fraction:g}, {move.speed_fraction:g} was checked"
            )
        return sent

    def wait(self, timeout_s: float) -> bool:
        """Waits for the end of the move under way; True if the arm stands where it was sent.

        Raises:
            StoppedError: The run was stopped, and the arm told to stop; likewise `HeartbeatLostError`.
            FaultError: It left its path or its speed, or stands elsewhere; it was told to stop.
            DeviceTimeoutError: It should have got farther by now; likewise.
            StaleError: Its readings are old; likewise.
        """
        self._was_told = False
        stands = self._arm.wait(timeout_s)
        if self._ended_it:
            self._ended_it = False
            self._check_stopped()
        if not stands:
            if self._watches and not self._was_told:
                self._look()
            return False
        if self._under_way is not None:
            sent, state = self._under_way, self._look()
            self._under_way, self._watches = None, False
            off = np.abs(state.joint_positions - sent.joint_positions)
            if off.max() > self.safety.config.arrival_tolerance:
                # After a stop the driver keeps the rest of the way back.
                self._check_stopped()
                k = int(off.argmax())
                raise FaultError(
                    f"the arm stands {off[k]:.3f} rad from where {self._model.joint_names[k]} was sent, allowed are "
                    f"{self.safety.config.arrival_tolerance:g} rad; something holds it back"
                )
        return True

    def _look(self) -> ArmState:
        """Reads the arm in a move, and holds it against the plan."""
        asked = self._clock.now()
        try:
            state = self.read()
        except DeployError:
            self.stop()
            raise
        age = asked - state.stamp
        if age > self.safety.config.max_state_age:
            raise StaleError(
                f"the arm's state is {age:.3f} s old in the middle of a move, allowed are "
                f"{self.safety.config.max_state_age} s; {self._halt()}"
            )
        self._see(state.joint_positions, state.stamp - state.stamp_error, state.stamp)
        return state

    def _see(self, joint_positions: Float64, earliest: float, stamp: float) -> None:
        self._was_told = True
        if not self._watches or self.watch is None:
            return
        if self._asked_to_stop() is not None:
            self.stop()
            self._ended_it = True
            return
        departure = self.watch.see(joint_positions, earliest, stamp)
        if departure is not None:
            kind = DeviceTimeoutError if departure.is_late else FaultError
            raise kind(f"the arm does not move as planned: {departure.detail}; {self._halt()}")

    def _halt(self) -> str:
        """Ends the move under way as far as possible; what becomes of it."""
        if self.stop():
            return "it was told to stop"
        return (
            "nothing more of the move is sent; what is under way goes on to its end, and only the smartPAD or the "
            "emergency stop halts it"
        )

    def _may_go(self) -> bool:
        return self._asked_to_stop() is None

    def _asked_to_stop(self) -> str | None:
        if self._stopped is None:
            self._stopped = self._why_stop()
        return self._stopped

    def _check_stopped(self) -> None:
        why = self._asked_to_stop()
        if why == HeartbeatLostError.reason:
            raise HeartbeatLostError("the loop stood still for too long; no move is sent any more")
        if why is not None:
            raise StoppedError(why)

    def stop(self) -> bool:
        """Does what can be done to end the move under way, and lets no other one out before `begin_run`.

        Returns:
            Whether the arm stands by it. Never raises.
        """
        if self._stopped is None:
            self._stopped = "stopped"
        # An arm that brakes is on no plan.
        is_first, self._watches = self._watches, False
        try:
            stopped = self._arm.stop()
        except Exception as error:
            _logger.error("the driver fails at a stop: %s: %s", type(error).__name__, error)
            stopped = False
        if stopped:
            self._broke_off = self._broke_off or self._under_way is not None
            self._under_way = None
        elif self._under_way is not None and is_first:
            _logger.warning(
                "the move under way goes on to its end: only the smartPAD or the emergency stop halts it"
            )
        return stopped


def _nobody() -> None:
    """Nobody speaks against a move."""
    return None
