"""The loop: look, decide, check, move, settle, until the target is seen or something speaks against going on.

    capture -> perceive -> observe -> policy -> kinematics -> safety -> arm -> settle -> capture

A move that the kinematics or `safety` refuse counts as one, as in the simulated task: the policy sees that the camera
has not moved and tries something else.
"""

import logging
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from itertools import islice
from typing import Final, Literal

import numpy as np
import torch

from maniskill_tomato.deploy.capture import Capture
from maniskill_tomato.deploy.clock import Clock
from maniskill_tomato.deploy.errors import DeployError, HeartbeatLostError, RecordingError, RefusedError
from maniskill_tomato.deploy.guarded_arm import GuardedArm
from maniskill_tomato.deploy.interface import Camera, Float64, Frame, JointMove
from maniskill_tomato.deploy.observing import Observing
from maniskill_tomato.deploy.perceive import Perception
from maniskill_tomato.deploy.plant_points import PlantPoints
from maniskill_tomato.deploy.policies import decide
from maniskill_tomato.deploy.postures import Postures
from maniskill_tomato.deploy.safety import Refusal
from maniskill_tomato.deploy.steps import Recorder, RunResult, Step
from maniskill_tomato.deploy.stops import Stops
from maniskill_tomato.errors import InvalidInputError, PolicyError, TomatoError
from maniskill_tomato.planners.base import Planner
from maniskill_tomato.robot.inverse_kinematics import Reach
from maniskill_tomato.robot.look_at_move import LookAtMover, moved_position

Mode = Literal["dry_run", "confirm", "unattended"]
"""Show the first move and end; ask before every move; go on alone."""

WAIT_SLICE: Final = 0.1
"""While the arm moves, stops are looked for this often, in [s]."""

STOP_TIME: Final = 2.0
"""An arm that was told to stop stands after so long, in [s]."""

OTHERS_TRIED: Final = 16
"""So many other postures are held against `safety` before a move counts as refused."""

_logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class LoopConfig:
    """When a run ends."""

    threshold: float = 0.8
    """The target is fully visible when V_f is above this."""
    max_moves: int = 20
    """Moves in which it must be."""
    lost_after: int = 12
    """Looks without any of the target in a row after which it counts as lost."""
    refused_after: int = 8
    """Refused moves in a row after which the run ends."""
    settle: float = 0.2
    """Between the end of a move and the next picture, in [s]."""

    def __post_init__(self) -> None:
        if not 0.0 < self.threshold < 1.0:
            raise InvalidInputError(f"threshold must be between 0 and 1, got {self.threshold}")
        for name in ("max_moves", "lost_after", "refused_after"):
            if getattr(self, name) < 1:
                raise InvalidInputError(f"{name} must be at least 1, got {getattr(self, name)}")
        if not 0.0 <= self.settle <= 10.0:
            raise InvalidInputError(f"settle must be from 0 to 10 s, got {self.settle}")


@dataclass(frozen=True, kw_only=True, eq=False)
class Proposal:
    """A move that a person is asked about."""

    number: int
    """How many moves there were before."""
    visible_fraction: float
    """V_f now."""
    joint_positions: Float64
    """Where the arm would go, in [rad]. Shape (7,)."""
    turn: Float64
    """How far each joint would turn, in [rad]. Shape (7,)."""
    camera_step: float
    """How far the camera would move, in [m]."""
    refusal: str | None
    """Why `safety` would refuse it, if it would."""


class _End(Exception):
    """Leaves the loop."""

    def __init__(self, reason: str, detail: str, is_fault: bool = False) -> None:
        super().__init__(detail)
        self.reason, self.detail, self.is_fault = reason, detail, is_fault


class Loop:
    """One run over connected devices."""

    def __init__(
        self,
        *,
        arm: GuardedArm,
        camera: Camera,
        capture: Capture,
        perception: Perception,
        policy: Planner,
        T_flange_camera: Float64,
        clock: Clock,
        config: LoopConfig,
        stops: Stops,
        recorder: Recorder | None = None,
        mode: Mode = "dry_run",
        confirm: Callable[[Proposal], bool] = lambda proposal: False,
        target_position: Float64 | None = None,
    ) -> None:
        """Puts the stages together.

        Args:
            arm: The only way to the arm.
            camera: Told when the arm stands at a new viewpoint.
            capture: Takes the camera's pictures.
            perception: Turns them into views.
            policy: Decides.
            T_flange_camera: The camera's optical frame in `link_ee`. Shape (4, 4).
            clock: The devices' clock.
            config: When to end.
            stops: Asked again and again.
            recorder: Keeps every step, if given.
            mode: What happens before a move.
            confirm: Asked in the mode `confirm`.
            target_position: Where the target is, world frame, in [m]; None to take the largest ripe fruit of the first
                picture. Shape (3,).
        """
        self._arm, self._camera, self._capture = arm, camera, capture
        self._perception, self._policy = perception, policy
        self._clock, self._config, self._stops = clock, config, stops
        self._recorder, self._mode, self._confirm = recorder, mode, confirm
        self._target = target_position
        self._observing = Observing(T_flange_camera, config.max_moves)
        self._mover = LookAtMover(T_flange_camera=np.array(T_flange_camera, dtype=np.float64))
        self._postures = Postures(T_flange_camera, arm.safety.config.joint_margin)
        self._points = PlantPoints()
        self._fractions: list[float] = []
        self._moves = self._refused = self._refused_in_a_row = self._lost_in_a_row = 0
        self._settled_at = clock.now()
        self._times: dict[str, list[float]] = defaultdict(list)
        self._step_times: dict[str, float] = {}

    @property
    def points(self) -> PlantPoints:
        """What the camera has seen of the plant."""
        return self._points

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
            device_seconds = float("nan")
        result = RunResult(
            success=reason == "success",
            reason=reason,
            detail=detail,
            is_fault=is_fault,
            moves=self._moves,
            refused_moves=self._refused,
            visible_fraction=self._fractions[-1] if self._fractions else 0.0,
            best_visible_fraction=max(self._fractions, default=0.0),
            visible_fractions=tuple(round(v, 4) for v in self._fractions),
            seconds=time.perf_counter() - began,
            device_seconds=0.0 if np.isnan(device_seconds) else device_seconds,
            stage_ms={name: round(float(np.mean(values)), 2) for name, values in self._times.items()},
            end_state=end_state,
        )
        self._log(f"end: {reason}: {detail} ({end_state})")
        return result

    # ------------------------------------------------------------------ steps

    def _one_look(self) -> None:
        self._check_stops()
        self._step_times = {}
        config = self._config
        with self._timed("capture"):
            self._camera.begin_view()
            frame = self._capture.take(self._settled_at)
            joints = self._arm.read().joint_positions
        step = self._look(frame, joints)
        view = step.view
        if view.visible_fraction > config.threshold:
            self._end(step, "success", f"V_f = {view.visible_fraction:.2f} after {self._moves} moves")
        if self._moves >= config.max_moves:
            self._end(step, "budget", f"V_f = {view.visible_fraction:.2f} after all {config.max_moves} moves")
        self._lost_in_a_row = 0 if view.target_seen else self._lost_in_a_row + 1
        if self._lost_in_a_row >= config.lost_after:
            self._end(
                step, "target_lost", f"{self._lost_in_a_row} looks in a row showed nothing of the target"
            )
        with self._timed("policy"):
            action = decide(self._policy, self._situation)
        step = replace(step, action=(float(action[0]), float(action[1]), float(action[2])))
        self._moves += 1
        self._act(step, frame)

    def _look(self, frame: Frame, joints: Float64) -> Step:
        T_world_camera = self._observing.camera_pose(joints)
        first = self._observing.target_position is None
        with self._timed("perceive"):
            if first:
                target = self._target
                if target is None:
                    target = self._perception.find_target(frame, T_world_camera)
                if target is None:
                    raise _End(
                        "no_target", "the first picture shows no ripe fruit; start where one is in view"
                    )
                self._target = np.array(target, dtype=np.float64)
                self._observing.begin(self._target)
            assert self._target is not None
            view = self._perception.look(frame, T_world_camera, self._target)
        with self._timed("observe"):
            moves_left = self._config.max_moves - self._moves
            self._situation = self._observing.observe(joints, view, moves_left)
        with self._timed("plant points"):
            self._points.add(frame, T_world_camera, joints)
        if first:
            self._policy.begin(self._situation, torch.zeros(1, dtype=torch.int64))
        self._fractions.append(view.visible_fraction)
        return Step(
            number=len(self._fractions) - 1,
            frame=frame,
            view=view,
            joint_positions=joints,
            T_world_camera=T_world_camera,
            target_position=self._target,
            moves_left=moves_left,
        )

    def _act(self, step: Step, frame: Frame) -> None:
        """Solves the move, has it checked and carried out, or counts it as refused."""
        assert step.action is not None and self._target is not None
        with self._timed("kinematics"):
            joints = torch.tensor(step.joint_positions[None], dtype=torch.float32)
            position = torch.as_tensor(self._observing.camera_position(step.joint_positions)[None])
            target = torch.as_tensor(self._target[None])
            solved = self._mover.move(joints, position, target, torch.tensor([step.action]))
        reachable = int(solved.reach[0]) != int(Reach.UNREACHABLE)
        goal = solved.qpos[0].float().double().numpy()
        with self._timed("safety"):
            move, refusal = self._safe_move(step, goal if reachable else None, frame)
        if move is None:
            self._refuse(step, "out of reach")
            return
        if self._mode != "unattended":
            self._ask(step, move, refusal)
        if refusal is not None:
            self._refuse(step, str(refusal))
            return
        try:
            sent = self._arm.command(move, frame.stamp, self._points.points_w)
        except RefusedError as error:
            self._refuse(step, str(error))
            return
        self._refused_in_a_row = 0
        with self._timed("move"):
            try:
                self._follow()
            except (_End, DeployError) as error:
                detail = str(error)
                self._record(
                    replace(step, commanded=sent.joint_positions, outcome="broken off", detail=detail)
                )
                raise
        self._record(replace(step, commanded=sent.joint_positions, outcome="moved"))

    def _follow(self) -> None:
        """Waits until the arm stands and has settled, looking for stops all the while."""
        while not self._arm.wait(WAIT_SLICE):
            self._check_stops()
        self._clock.sleep(self._config.settle)
        self._settled_at = self._clock.now()

    def _safe_move(
        self, step: Step, goal: Float64 | None, frame: Frame
    ) -> tuple[JointMove | None, Refusal | None]:
        """The task's own posture, or another one of the same or a shorter move that `safety` accepts.

        If there is none: the task's own (None where it has none either), and why it is refused.
        """
        assert step.action is not None and self._target is not None
        safety, state = self._arm.safety, self._arm.read()
        speed = safety.config.speed_fraction
        points, now = self._points.points_w, self._clock.now()
        own: JointMove | None = None
        refusal: Refusal | None = None
        if goal is not None:
            own = JointMove(joint_positions=goal, speed_fraction=speed)
            refusal = safety.check(own, state, now, frame.stamp, points)
            if refusal is None:
                return own, None
        position = step.T_world_camera[:3, 3]
        aim = moved_position(
            torch.as_tensor(position),
            torch.as_tensor(self._target),
            torch.tensor(step.action, dtype=torch.float64),
        )
        others = self._postures.of_move(
            state.joint_positions, position, aim.numpy(), self._target, safety.config.max_joint_step
        )
        for posture in islice(others, OTHERS_TRIED):
            move = JointMove(joint_positions=posture, speed_fraction=speed)
            if safety.check(move, state, now, frame.stamp, points) is None:
                _logger.info("move %d in another posture, because %s", self._moves, refusal or "out of reach")
                return move, None
        return own, refusal

    def _ask(self, step: Step, move: JointMove, refusal: Refusal | None) -> None:
        """Shows the move; goes on only if a person wants it."""
        state = self._arm.read()
        after = self._observing.camera_pose(move.joint_positions)
        proposal = Proposal(
            number=self._moves - 1,
            visible_fraction=step.view.visible_fraction,
            joint_positions=move.joint_positions,
            turn=move.joint_positions - state.joint_positions,
            camera_step=float(np.linalg.norm(after[:3, 3] - step.T_world_camera[:3, 3])),
            refusal=None if refusal is None else str(refusal),
        )
        if self._mode == "dry_run":
            told = "safety would let it through" if refusal is None else f"safety would refuse it: {refusal}"
            turns = ", ".join(f"{v:.1f}" for v in np.rad2deg(move.joint_positions))
            self._end(step, "dry_run", f"nothing was sent; the first move would go to ({turns}) deg; {told}")
        if refusal is None and not self._confirm(proposal):
            self._end(step, "declined", "the move was not confirmed")

    def _refuse(self, step: Step, why: str) -> None:
        self._refused += 1
        self._refused_in_a_row += 1
        _logger.info("move %d refused: %s", self._moves, why)
        self._record(replace(step, outcome="refused", detail=why))
        if self._refused_in_a_row >= self._config.refused_after:
            raise _End(
                "refused", f"{self._refused_in_a_row} moves in a row were refused, the last one: {why}"
            )

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
        if self._recorder is not None:
            self._recorder.step(replace(step, timing_ms=dict(self._step_times)))

    def _log(self, text: str) -> None:
        _logger.info("%s", text)
        if self._recorder is not None:
            try:
                self._recorder.event(self._clock.now(), text)
            except (RecordingError, DeployError) as error:
                _logger.warning("%s", error)

    @contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        began = time.perf_counter()
        try:
            yield
        finally:
            taken = 1e3 * (time.perf_counter() - began)
            self._times[stage].append(taken)
            self._step_times[stage] = round(taken, 3)
