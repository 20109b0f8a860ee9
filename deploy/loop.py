"""The control loop: take a picture, decide, check, move, settle, until the target is seen or a reason to stop occurs.

    capture -> perceive -> observe -> policy -> kinematics -> safety -> arm -> settle -> capture

What a look means says the run's `Goal`: one fruit, or all of a row. A move that the kinematics or `safety` refuses
counts as a move, as in the simulated task. The policy sees that the camera has not moved and tries something else.
"""

import logging
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from maniskill_tomato.deploy.capture import Capture
from maniskill_tomato.deploy.deploy_errors import (
    DeployError,
    FaultError,
    HeartbeatLostError,
    PerceptionError,
    RefusedError,
)
from maniskill_tomato.deploy.goal import Goal, Look, OneFruit
from maniskill_tomato.deploy.interface import Float64, Frame, JointMove
from maniskill_tomato.deploy.move_choice import Choice, MoveChooser, MoveRequest
from maniskill_tomato.deploy.plant_points import PlantPoints
from maniskill_tomato.deploy.robot_perception import RobotBelief
from maniskill_tomato.deploy.run_records import Mode, Proposal, Recorder, RunResult, Step
from maniskill_tomato.deploy.safety import Refusal
from maniskill_tomato.deploy.stops import Stops
from maniskill_tomato.deploy.workcell import Workcell
from maniskill_tomato.errors import PolicyError, TomatoError
from maniskill_tomato.policies.opening import shipped_policy
from maniskill_tomato.policies.protocol import Policy
from maniskill_tomato.sensing.belief import Belief

TASK: Final = "TomatoViewpoint-v1"
"""The task whose observations and actions the loop has."""

BOUND_SLACK: Final = 1e-4
"""An action's entries may exceed 1 by this much: rounding."""

WAIT_SLICE: Final = 0.1
"""While the arm moves, stops are looked for this often, in [s]."""

STOP_TIME: Final = 2.0
"""An arm that was told to stop stands after so long, in [s]."""

_logger = logging.getLogger(__name__)


def default_policy() -> str:
    """The policy that ships with the package."""
    return str(shipped_policy(TASK))


def decide(policy: Policy, belief: Belief) -> NDArray[np.float64]:
    """The policy's next move, checked.

    Returns:
        Right, up, forward in [-1, 1]. Shape (3,).

    Raises:
        PolicyError: It is not three finite numbers within the bounds.
    """
    action = np.asarray(policy.act(belief).detach().double())
    if action.shape != (1, 3):
        raise PolicyError(
            f"the policy answered with shape {action.shape}, not (1, 3); is it for another task?"
        )
    if not np.isfinite(action).all():
        raise PolicyError(
            f"the policy answered {action[0].tolist()}, which is not finite; the arm does not move"
        )
    if np.abs(action).max() > 1.0 + BOUND_SLACK:
        raise PolicyError(f"the policy answered {action[0].tolist()}, outside [-1, 1]; the arm does not move")
    move: NDArray[np.float64] = action[0].clip(-1.0, 1.0)
    return move


class _End(Exception):
    """Leaves the loop."""

    def __init__(self, reason: str, detail: str, is_fault: bool = False) -> None:
        super().__init__(detail)
        self.reason, self.detail, self.is_fault = reason, detail, is_fault


class Loop:
    """One run over connected devices."""

    def __init__(
        self,
        workcell: Workcell,
        policy: Policy,
        stops: Stops,
        mode: Mode = "dry_run",
        recorders: Sequence[Recorder] = (),
        confirm: Callable[[Proposal], bool] = lambda proposal: False,
        goal: Goal | None = None,
    ) -> None:
        """Puts the stages together.

        Args:
            workcell: Its devices must be connected.
            policy: Decides.
            stops: Asked again and again.
            mode: What happens before a move.
            recorders: Keep every step.
            confirm: Asked in the mode `confirm`.
            goal: What the run is after; None for the profile's target.

        Raises:
            ProfileError: The profile names a target that there is not.
        """
        profile = workcell.profile
        self._arm, self._camera, self._clock = workcell.guarded_arm, workcell.camera, workcell.clock
        self._capture = Capture(workcell.camera, profile.capture, workcell.clock)
        self._policy, self._stops = policy, stops
        self._goal = goal or OneFruit(workcell.perception, profile.loop, workcell.target_position())
        self._settle, self._mode = profile.loop.settle, mode
        self._recorders, self._confirm = recorders, confirm
        self._robot_belief = RobotBelief(profile.T_flange_camera, self._goal.max_moves)
        self._chooser = MoveChooser(self._arm.safety, profile.T_flange_camera)
        self._points = PlantPoints(profile.T_flange_camera)
        self._fractions: list[float] = []
        self._moves = self._refused = self._refused_in_a_row = 0
        self._settled_at = self._clock.now()
        self._way_back: Float64 | None = None
        self._true_fraction: float | None = None
        self._times = _StageTimes()

    def run(self) -> RunResult:
        """Runs to an end; faults end it too, and are told in the result."""
        began, device_began = time.perf_counter(), self._clock.now()
        try:
            while True:
                self._one_look()
        except _End as end:
            reason, detail, is_fault = end.reason, end.detail, end.is_fault
        except PolicyError as error:
            reason, detail, is_fault = "policy", str(error), True
        except DeployError as error:
            reason, detail, is_fault = error.reason, str(error), True
        except TomatoError as error:
            reason, detail, is_fault = "fault", str(error), True
        end_state = self._come_to_rest()
        try:
            device_seconds = self._clock.now() - device_began
        except DeployError:
            device_seconds = 0.0
        result = RunResult(
            success=reason == "success",
            reason=reason,
            detail=detail,
            is_fault=is_fault,
            moves=self._moves,
            refused_moves=self._refused,
            visible_fraction=self._fractions[-1] if self._fractions else 0.0,
            best_visible_fraction=max(self._fractions, default=0.0),
            true_visible_fraction=self._true_fraction,
            visible_fractions=tuple(round(v, 4) for v in self._fractions),
            seconds=time.perf_counter() - began,
            device_seconds=device_seconds,
            stage_ms=self._times.mean_ms,
            end_state=end_state,
        )
        self._log(f"end: {reason}: {detail} ({end_state})")
        return result

    # ------------------------------------------------------------------ steps

    def _one_look(self) -> None:
        self._check_stops()
        self._times.begin_step()
        with self._times.timed("capture"):
            self._camera.begin_view()
            frame = self._capture.take(self._settled_at, may_be_blind=self._way_back is not None)
            joints = self._arm.read().joint_positions
        look, step = self._look(frame, joints)
        if look.end is not None:
            self._end(step, look.end.reason, look.end.detail)
        if self._capture.is_blind(frame):
            self._moves += 1
            self._go_back(step)
            return
        self._way_back = joints
        if look.go_to is not None:
            self._moves += look.cost
            self._send(replace(step, detail=look.detail), self._straight(step, look.go_to))
            return
        with self._times.timed("policy"):
            action = decide(self._policy, self._belief)
        step = replace(step, action=(float(action[0]), float(action[1]), float(action[2])))
        self._moves += 1
        self._send(step, self._chosen(step))

    def _look(self, frame: Frame, joints: Float64) -> tuple[Look, Step]:
        T_world_camera = self._robot_belief.camera_pose(joints)
        with self._times.timed("perceive"):
            look = self._goal.look(frame, T_world_camera, joints, self._moves)
        if look is None:
            raise _End("no_target", "the first picture shows no ripe fruit; start where one is in view")
        view = look.view
        if look.go_to is None:
            with self._times.timed("observe"):
                self._belief = self._robot_belief.observe(joints, view, look.moves_left)
        with self._times.timed("plant points"):
            self._points.add(frame, T_world_camera, joints)
        if look.is_new_target:
            self._policy.begin(self._belief, torch.zeros(1, dtype=torch.int64))
        self._fractions.append(view.visible_fraction)
        self._true_fraction = look.true_fraction
        step = Step(
            number=len(self._fractions) - 1,
            frame=frame,
            view=view,
            joint_positions=joints,
            T_world_camera=T_world_camera,
            target_position=view.target_position,
            moves_left=look.moves_left,
        )
        return look, step

    def _straight(self, step: Step, joints: Float64) -> Choice:
        """A move to given joint positions, checked."""
        move = JointMove(joint_positions=joints, speed_fraction=self._arm.safety.config.speed_fraction)
        with self._times.timed("safety"):
            state, points = self._arm.read(), self._points.points_w
            refusal = self._arm.safety.check(move, state, self._clock.now(), step.frame.stamp, points)
        return Choice(move=move, refusal=refusal)

    def _chosen(self, step: Step) -> Choice:
        """The policy's move, solved and checked."""
        assert step.action is not None
        request = MoveRequest(
            joint_positions=step.joint_positions,
            camera_position=self._robot_belief.camera_position(step.joint_positions),
            target_position=step.target_position,
            action=step.action,
        )
        points = self._points.points_w
        with self._times.timed("kinematics"):
            own_goal = self._chooser.own_goal(request)
        with self._times.timed("safety"):
            state = self._arm.read()
            return self._chooser.choose(request, own_goal, state, self._clock.now(), step.frame.stamp, points)

    def _send(self, step: Step, chosen: Choice) -> None:
        """Has a move carried out, or counts it as refused."""
        if chosen.move is None:
            self._refuse(step, "out of reach")
            return
        if self._mode != "unattended":
            self._ask(step, chosen.move, chosen.refusal)
        if chosen.refusal is not None:
            self._refuse(step, str(chosen.refusal))
            return
        try:
            sent = self._arm.command(chosen.move, step.frame.stamp, self._points.points_w)
        except RefusedError as error:
            self._refuse(step, str(error))
            return
        self._follow(step, sent, chosen.then)

    def _go_back(self, step: Step) -> None:
        """Without depth nobody knows what is near, a leaf over the lens for one: back to where there was some."""
        way_back, self._way_back = self._way_back, None
        assert way_back is not None
        step = replace(step, detail="no depth here: back to the last view that had some")
        move = JointMove(joint_positions=way_back, speed_fraction=self._arm.safety.config.speed_fraction)
        if self._mode != "unattended":
            self._ask(step, move, None)
        try:
            sent = self._arm.command(move, step.frame.stamp, self._points.points_w)
        except RefusedError as error:
            raise PerceptionError(
                f"the picture has no depth, and the way back is refused: {error}"
            ) from error
        self._follow(step, sent)

    def _follow(self, step: Step, sent: JointMove, then: tuple[JointMove, ...] = ()) -> None:
        """Waits for the end of the move, then sends the rest of a way round.

        Where the rest is refused, the next look is from where the arm stands.
        """
        self._refused_in_a_row = 0
        self._arrive(step, sent)
        for move in then:
            if self._mode == "confirm":
                self._ask(replace(step, commanded=sent.joint_positions), move, None)
            try:
                sent = self._arm.command(move, step.frame.stamp, self._points.points_w)
            except RefusedError as error:
                step = replace(step, detail=f"the rest of the way was refused: {error}")
                break
            self._arrive(step, sent)
        self._settled_at = self._clock.now()
        self._record(replace(step, commanded=sent.joint_positions, outcome="moved"))

    def _arrive(self, step: Step, sent: JointMove) -> None:
        """Waits until the arm stands and has settled, looking for stops all the while."""
        with self._times.timed("move"):
            try:
                while not self._arm.wait(WAIT_SLICE):
                    self._check_stops()
                self._clock.sleep(self._settle)
            except (_End, DeployError) as error:
                if isinstance(error, RefusedError):
                    error = FaultError(f"the arm broke its move off: {error}")
                broken = replace(
                    step, commanded=sent.joint_positions, outcome="broken off", detail=str(error)
                )
                self._record(broken)
                raise error

    def _ask(self, step: Step, move: JointMove, refusal: Refusal | None) -> None:
        """Shows the move; goes on only if a person wants it."""
        if self._mode == "dry_run":
            told = "safety would let it through" if refusal is None else f"safety would refuse it: {refusal}"
            turns = ", ".join(f"{v:.1f}" for v in np.rad2deg(move.joint_positions))
            self._end(step, "dry_run", f"nothing was sent; the first move would go to ({turns}) deg; {told}")
        if refusal is not None:
            return
        after = self._robot_belief.camera_pose(move.joint_positions)
        proposal = Proposal(
            number=self._moves - 1,
            visible_fraction=step.view.visible_fraction,
            turn=move.joint_positions - self._arm.read().joint_positions,
            camera_step=float(np.linalg.norm(after[:3, 3] - step.T_world_camera[:3, 3])),
        )
        with self._stops.waiting_for_a_person():
            confirmed = self._confirm(proposal)
        self._check_stops()
        if not confirmed:
            self._end(step, "declined", "the move was not confirmed")

    def _refuse(self, step: Step, why: str) -> None:
        self._refused += 1
        self._refused_in_a_row += 1
        _logger.info("move %d refused: %s", self._moves, why)
        self._record(replace(step, outcome="refused", detail=why))
        end = self._goal.refused(self._refused_in_a_row, why)
        if end is not None:
            raise _End(end.reason, end.detail)

    # ------------------------------------------------------------------- ends

    def _check_stops(self) -> None:
        reason = self._stops.beat()
        if reason == "heartbeat":
            raise HeartbeatLostError("the loop stood still for too long")
        if reason is not None:
            raise _End("stopped", reason)

    def _end(self, step: Step, reason: str, detail: str) -> None:
        self._record(replace(step, outcome=reason, detail=detail))
        raise _End(reason, detail)

    def _come_to_rest(self) -> str:
        """Leaves the arm without a command; says what it does then."""
        try:
            if self._arm.wait(0.0):
                return "the arm stands and holds its position"
        except DeployError:
            pass
        if self._arm.stop():
            with suppress(DeployError):
                self._arm.wait(STOP_TIME)
            return "the arm was stopped and holds its position"
        return "a move may still be under way and goes on to its end; only the smartPAD or the emergency stop halts it"

    def _record(self, step: Step) -> None:
        for recorder in self._recorders:
            recorder.step(replace(step, timing_ms=self._times.step_ms))

    def _log(self, text: str) -> None:
        _logger.info("%s", text)
        for recorder in self._recorders:
            try:
                recorder.event(self._clock.now(), text)
            except DeployError as error:
                _logger.warning("%s", error)


class _StageTimes:
    """Wall times by stage, of the step under way and of all."""

    def __init__(self) -> None:
        self._all: dict[str, list[float]] = defaultdict(list)
        self._step: dict[str, float] = {}

    def begin_step(self) -> None:
        """A new step begins; `step_ms` is empty again."""
        self._step = {}

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Measures what is inside, also where it raises."""
        began = time.perf_counter()
        try:
            yield
        finally:
            taken = 1e3 * (time.perf_counter() - began)
            self._all[stage].append(taken)
            self._step[stage] = round(taken, 3)

    @property
    def step_ms(self) -> dict[str, float]:
        """Of the step under way, in [ms]."""
        return dict(self._step)

    @property
    def mean_ms(self) -> dict[str, float]:
        """Means over all steps, in [ms]."""
        return {stage: round(float(np.mean(values)), 2) for stage, values in self._all.items()}
