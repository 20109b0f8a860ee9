"""The control loop: take a picture, decide, check, move, settle, until the target is seen or a reason to stop occurs.

    capture -> perceive -> observe -> policy -> kinematics -> safety -> arm -> settle -> capture

What a look means says the run's `Goal`: one fruit, or all of a row. Where the kinematics or `safety` refuse the
policy's move, a planner takes over: of the views that it thinks most of, the first to which `way` finds a safe way.
Where there is none, the move counts as refused, as in the simulated task; the policy sees that the camera has not moved
and tries something else. Before each piece of a way a fresh picture is taken for the collision check, and the goal
may take it in.
"""

import logging
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import torch

from maniskill_tomato.deploy.capture import Capture
from maniskill_tomato.deploy.decision import decide
from maniskill_tomato.deploy.deploy_errors import (
    DeployError,
    FaultError,
    HeartbeatLostError,
    PerceptionError,
    RefusedError,
    StoppedError,
)
from maniskill_tomato.deploy.fault_state import (
    FaultState,
    detail_of,
    lines_of,
    plan_facts,
    reason_of,
    state_facts,
)
from maniskill_tomato.deploy.goal import Goal, Look, OneFruit
from maniskill_tomato.deploy.interface import Float64, Frame, JointMove
from maniskill_tomato.deploy.move_choice import Choice, MoveChooser, MoveRequest
from maniskill_tomato.deploy.plant_points import PlantPoints
from maniskill_tomato.deploy.refusals import Refusal
from maniskill_tomato.deploy.rest import come_to_rest
from maniskill_tomato.deploy.robot_perception import RobotBelief
from maniskill_tomato.deploy.run_records import Mode, Proposal, Recorder, RunResult, Step
from maniskill_tomato.deploy.stage_times import StageTimes
from maniskill_tomato.deploy.stops import Stops
from maniskill_tomato.deploy.way import Way, WayPlanner
from maniskill_tomato.deploy.workcell import Workcell
from maniskill_tomato.policies.lattice_planner import LatticePlanner
from maniskill_tomato.policies.next_best_view import NextBestView
from maniskill_tomato.policies.protocol import Policy
from maniskill_tomato.robot.look_at_move import MAX_MOVE
from maniskill_tomato.robot.transit import TRANSIT_MOVES

WAIT_SLICE: Final = 0.02
"""While an arm moves that can be stopped, stops are looked for this often, in [s]."""

LONG_SLICE: Final = 0.1
"""The same for one that cannot."""

STANDS: Final = 0.005
"""Joints that have turned by less than this have not moved, in [rad]."""

PLACES_WANTED: Final = 60
"""So many views are tried when a planner takes over."""

REPLANS: Final = 2
"""A way of which new pictures show that it is not safe is planned anew so often."""

_logger = logging.getLogger(__name__)


class _End(Exception):
    """Leaves the loop."""

    def __init__(self, reason: str, detail: str, is_fault: bool = False) -> None:
        super().__init__(detail)
        self.reason, self.detail, self.is_fault = reason, detail, is_fault


@dataclass(eq=False)
class _Journey:
    """The arm's way to another view."""

    places: Float64
    """Where it may lead, the most wanted first, in [m]. Shape (K, 3)."""
    pieces: deque[Float64]
    """Joint positions that are left to go to, in [rad]. Each of shape (7,)."""
    replans: int = REPLANS
    """How often it may still be planned anew."""
    why: str = ""
    """Why the last piece was refused."""


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
        self._arm.begin_run(stops.asked)
        self._recorders, self._confirm = recorders, confirm
        self._robot_belief = RobotBelief(
            profile.T_flange_camera, self._goal.max_moves, model=workcell.arm.model
        )
        self._chooser = MoveChooser(self._arm.safety, profile.T_flange_camera)
        self._ways = WayPlanner(self._arm.safety, profile.T_flange_camera)
        self._planner = policy if isinstance(policy, LatticePlanner) else NextBestView()
        self._points = PlantPoints(profile.T_flange_camera, model=workcell.arm.model)
        self._fractions: list[float] = []
        self._moves = self._refused = self._refused_in_a_row = 0
        self._settled_at = self._clock.now()
        self._way_back: list[Float64] = []
        self._trail: list[Float64] = []
        self._journey: _Journey | None = None
        self._no_way_from: Float64 | None = None
        self._last: Step | None = None
        self._true_fraction: float | None = None
        self._times = StageTimes()
        self._not_finite: FaultState | None = None

    def run(self) -> RunResult:
        """Runs to an end; faults end it too, and are told in the result."""
        began, device_began = time.perf_counter(), self._clock.now()
        fault: FaultState | None = None
        try:
            while True:
                self._one_look()
        except _End as end:
            reason, detail, is_fault = end.reason, end.detail, end.is_fault
        except StoppedError as error:
            reason, detail, is_fault = error.reason, str(error), False
        except Exception as error:
            reason, detail, is_fault = reason_of(error), detail_of(error), True
            fault = self._fault_state(reason, detail, error)
        fault = fault or self._not_finite
        try:
            end_state = come_to_rest(self._arm)
        except Exception as error:
            end_state = f"what the arm does nobody knows ({detail_of(error)}); use the emergency stop"
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
            fault=fault,
        )
        self._log(f"end: {reason}: {detail} ({end_state})")
        return result

    # ------------------------------------------------------------------ steps

    def _one_look(self) -> None:
        self._check_stops()
        self._times.begin_step()
        with self._times.timed("capture"):
            self._camera.begin_view()
            frame = self._capture.take(self._settled_at, may_be_blind=bool(self._way_back))
            joints = self._arm.read().joint_positions
        if self._journey is not None:
            self._go_on(self._journey, frame, joints)
            return
        look, step = self._look(frame, joints)
        if look.end is not None:
            self._end(step, look.end.reason, look.end.detail)
        if self._capture.is_blind(frame):
            self._moves += 1
            self._go_back(step)
            return
        self._way_back = [joints]
        if not self._trail or np.abs(joints - self._trail[-1]).max() > STANDS:
            self._trail.append(joints)
        if look.places is not None:
            self._set_out(step, look.places)
            return
        with self._times.timed("policy"):
            action = decide(self._policy, self._belief)
        step = replace(step, action=(float(action[0]), float(action[1]), float(action[2])))
        self._moves += 1
        chosen = self._chosen(step)
        is_refused = chosen.move is None or chosen.refusal is not None
        if is_refused and look.moves_left >= TRANSIT_MOVES and self._hand_over(step):
            return
        self._send(step, chosen)

    # ------------------------------------------------------------ ways to views

    def _hand_over(self, step: Step) -> bool:
        """Has the planner choose a view that the arm gets to; whether there is one."""
        joints, planner = step.joint_positions, self._planner
        if self._no_way_from is not None and np.abs(joints - self._no_way_from).max() < STANDS:
            return False
        with self._times.timed("way"):
            if planner is not self._policy:
                planner.act(self._belief)
            ranked = planner.ranked(self._belief)[:PLACES_WANTED]
            places = planner.views(self._belief)[0, ranked].double().numpy()
            way = self._way_to(step, places)
            planner.tried.refused[0, [ranked[k] for k in way.blocked]] = True
        if way.place is None:
            self._no_way_from = joints
            return False
        away = float(np.linalg.norm(places[way.place] - step.T_world_camera[:3, 3]))
        if len(way.pieces) > 1 or away > MAX_MOVE:
            self._moves += TRANSIT_MOVES - 1
        _logger.info("the move is refused; a way of %d pieces to another view", len(way.pieces))
        self._journey = _Journey(places=places[way.place :], pieces=deque(way.pieces))
        self._send_piece(step, self._journey)
        return True

    def _set_out(self, step: Step, places: Float64) -> None:
        """Begins the way to the first place that the arm gets to."""
        with self._times.timed("way"):
            way = self._way_to(step, places)
        if way.place is None:
            self._moves += 1
            self._refuse(step, "there is no way to a view of it that safety lets through")
            return
        self._moves += TRANSIT_MOVES
        _logger.info("a way of %d pieces to another view", len(way.pieces))
        self._journey = _Journey(places=places[way.place :], pieces=deque(way.pieces))
        self._send_piece(step, self._journey)

    def _way_to(self, step: Step, places: Float64) -> Way:
        state, points = self._arm.read(), self._points.points_w
        target, now, before = step.target_position, self._clock.now(), self._trail[:-1]
        return self._ways.to_view(places, target, state, now, step.frame.stamp, points, before)

    def _go_on(self, journey: _Journey, frame: Frame, joints: Float64) -> None:
        """The next piece, by what the picture shows of the plant."""
        step = self._between(frame, joints)
        if self._capture.is_blind(frame):
            journey.pieces.clear()
            journey.replans, journey.why = 0, "the camera saw no depth on the way"
            self._go_back(step)
            return
        self._way_back = [joints]
        with self._times.timed("plant points"):
            self._points.add(frame, step.T_world_camera, joints)
        with self._times.timed("perceive"):
            self._goal.pass_by(frame, step.T_world_camera, joints)
        if not journey.pieces and journey.replans:
            journey.replans -= 1
            with self._times.timed("way"):
                journey.pieces.extend(self._way_to(step, journey.places).pieces)
        if not journey.pieces:
            self._journey = None
            self._refuse(step, journey.why)
            return
        self._send_piece(step, journey)

    def _send_piece(self, step: Step, journey: _Journey) -> None:
        piece = self._straight(step, journey.pieces[0])
        if piece.refusal is not None and self._mode != "dry_run":
            # Only a new picture tells that a way is not safe: it is planned anew from here. One that took long to
            # plan is kept for a fresh picture.
            if piece.refusal.reason == "stale_frame" and journey.replans:
                journey.replans -= 1
            else:
                journey.pieces.clear()
            journey.why = str(piece.refusal)
            self._count_refusal(step, journey.why)
            return
        journey.pieces.popleft()
        if not journey.pieces:
            self._journey = None
        refused = self._refused
        self._send(replace(step, detail="on the way to another view"), piece)
        if self._refused > refused:
            self._journey = None

    def _between(self, frame: Frame, joints: Float64) -> Step:
        """A look on the way, of which the goal learns nothing."""
        assert self._last is not None
        view = replace(
            self._last.view,
            visible_fraction=0.0,
            sure_fraction=0.0,
            fraction_margin=None,
            mask=np.zeros(frame.depth.shape, np.bool_),
            fruits_seen=0,
            recall=None,
        )
        self._fractions.append(0.0)
        return replace(
            self._last,
            number=len(self._fractions) - 1,
            frame=frame,
            view=view,
            joint_positions=joints,
            T_world_camera=self._robot_belief.camera_pose(joints),
        )

    # ------------------------------------------------------------ single moves

    def _look(self, frame: Frame, joints: Float64) -> tuple[Look, Step]:
        T_world_camera = self._robot_belief.camera_pose(joints)
        with self._times.timed("perceive"):
            look = self._goal.look(frame, T_world_camera, joints, self._moves)
        view = look.view
        if look.places is None:
            with self._times.timed("observe"):
                self._belief = self._robot_belief.observe(joints, view, look.moves_left)
        with self._times.timed("plant points"):
            self._points.add(frame, T_world_camera, joints)
        if look.is_new_target:
            self._no_way_from = None
            for one in {id(p): p for p in (self._policy, self._planner)}.values():
                one.begin(self._belief, torch.zeros(1, dtype=torch.int64))
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
        self._last = step
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
            self._refuse(step, chosen.out_of_reach)
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
        way_back, self._way_back = self._way_back, []
        assert way_back
        step = replace(step, detail="no depth here: back to the last view that had some")
        back = [
            JointMove(joint_positions=joints, speed_fraction=self._arm.safety.config.speed_fraction)
            for joints in reversed(way_back)
        ]
        if self._mode != "unattended":
            self._ask(step, back[0], None)
        try:
            sent = self._arm.command(back[0], step.frame.stamp, self._points.points_w)
        except RefusedError as error:
            raise PerceptionError(
                f"the picture has no depth, and the way back is refused: {error}"
            ) from error
        self._follow(step, sent, tuple(back[1:]))

    def _follow(self, step: Step, sent: JointMove, then: tuple[JointMove, ...] = ()) -> None:
        """Waits for the end of the move, then sends the rest of a way round.

        Where the rest is refused, the next look is from where the arm stands.
        """
        self._refused_in_a_row = 0
        self._arrive(step, sent)
        for move in then:
            if self._way_back:
                self._way_back.append(sent.joint_positions)
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
                while not self._arm.wait(WAIT_SLICE if self._arm.can_stop else LONG_SLICE):
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
        self._check_stops()
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

    def _count_refusal(self, step: Step, why: str) -> None:
        if why.startswith("not_finite") and self._not_finite is None:
            self._not_finite = self._fault_state("not_finite", why)
        self._refused += 1
        self._refused_in_a_row += 1
        _logger.info("move %d refused: %s", self._moves, why)
        self._record(replace(step, outcome="refused", detail=why))

    def _refuse(self, step: Step, why: str) -> None:
        self._count_refusal(step, why)
        end = self._goal.refused(self._refused_in_a_row, why)
        if end is not None:
            raise _End(end.reason, end.detail)

    # ------------------------------------------------------------------- ends

    def _check_stops(self) -> None:
        reason = self._stops.beat()
        if reason is not None and self._arm.is_under_way:
            # Before anything is recorded: disks may be slow.
            self._arm.stop()
        if reason == "heartbeat":
            raise HeartbeatLostError("the loop stood still for too long")
        if reason is not None:
            raise _End("stopped", reason)

    def _end(self, step: Step, reason: str, detail: str) -> None:
        self._record(replace(step, outcome=reason, detail=detail))
        raise _End(reason, detail)

    def _fault_state(self, reason: str, detail: str, error: Exception | None = None) -> FaultState:
        """What is known now, before anything is done about it."""
        arm, journey, stamp = self._arm, self._journey, None
        with suppress(DeployError):
            stamp = self._clock.now()
        return FaultState(
            reason=reason,
            detail=detail,
            stamp=stamp,
            arm_states=tuple(state_facts(state) for state in arm.recent),
            plan=None if arm.watch is None else plan_facts(arm.watch, arm.is_under_way),
            refused="" if arm.refused is None else str(arm.refused),
            stop=arm.why_stopped or self._stops.reason,
            memory={
                "looks": len(self._fractions),
                "moves": self._moves,
                "refused": self._refused,
                "views to go back by": len(self._trail),
                "pieces of a way left": 0 if journey is None else len(journey.pieces),
                "plant points": len(self._points),
            },
            traceback="" if error is None else lines_of(error),
        )

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
