"""Ways of several moves to another view, which `safety` lets through from end to end by what was seen so far.

A way leads straight, in joint space, to a posture that looks at the target from a wanted place. Where leaves, the table
or the arm itself are in between, it leads by the ready posture, as a transit of the simulated task does
(`robot.transit`): the arm draws back from where it is, from a view before, or round what is near, and comes in along
+x. The planner only proposes; each piece is checked again before it goes out, with a fresh picture.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Final

import numpy as np
import torch

from maniskill_tomato.deploy.detour import DetourPlanner
from maniskill_tomato.deploy.interface import ArmState, Float64, JointMove
from maniskill_tomato.deploy.motion_bounds import joint_path
from maniskill_tomato.deploy.move_choice import Postures
from maniskill_tomato.deploy.safety import Safety
from maniskill_tomato.robot.arm_model import ArmModel
from maniskill_tomato.robot.iiwa14 import IIWA14
from maniskill_tomato.robot.kinematics import forward_kinematics
from maniskill_tomato.robot.transit import TransitPlanner

WITHIN: Final = 0.95
"""Pieces of a way take this share of the steps that `safety` allows."""

RETREATS: Final = 2
"""Views that the arm goes back by before it draws back, where it cannot from where it is."""

POSTURES_TRIED: Final = 3
"""Postures of one place whose ways are tried, of those nearest to the arm's and to the ready one each."""

OTHERWISE: Final = 0.3
"""Postures of one place that are tried differ by more than this in some joint, in [rad]."""

WAYS_TRIED: Final = 16
"""Postures whose ways are tried before there is none."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Way:
    """What was found."""

    pieces: tuple[Float64, ...]
    """Joint positions to go to one after the other, in [rad]; empty if there is no way. Each of shape (7,)."""
    place: int | None
    """Which of the places it leads to."""
    blocked: tuple[int, ...]
    """Places that were tried before and at which the arm cannot stand without touching something."""


class WayPlanner:
    """Plans for one arm; not for use from several threads at once."""

    def __init__(self, safety: Safety, T_flange_camera: Float64) -> None:
        """Prepares the kinematics.

        Args:
            safety: Judges every piece in full.
            T_flange_camera: The camera's optical frame in `link_ee`. Shape (4, 4).
        """
        self._safety = safety
        self._postures = Postures(T_flange_camera, safety.config.joint_margin, safety.model)
        self._detours = DetourPlanner(safety, T_flange_camera)
        self._transits = TransitPlanner(model=safety.model)
        self._ready: Float64 = np.array(safety.model.ready_qpos)

    def to_view(
        self,
        places: Float64,
        target: Float64,
        state: ArmState,
        now: float,
        frame_stamp: float,
        points_w: Float64,
        before: Sequence[Float64] = (),
    ) -> Way:
        """The way to the first place that the arm gets to.

        Args:
            places: Of the camera, the most wanted first, base frame, in [m]. Shape (K, 3).
            target: What it shall look at, likewise. Shape (3,).
            state: Where the arm is.
            now: The time, in [s].
            frame_stamp: When the picture was taken that the decision rests on, in [s].
            points_w: What was seen of the plant, base frame, in [m]. Shape (P, 3).
            before: Joint positions of earlier views, the last one last, in [rad]. Each of shape (7,).
        """
        search = _Search(self._safety, self._detours, self._transits, state, now, frame_stamp, points_w)
        blocked: list[int] = []
        tried = 0
        for k, place in enumerate(places):
            stands = False
            for posture, is_near in self._candidates(place, target, state.joint_positions):
                if self._safety.stands_in_collision(posture, points_w):
                    continue
                stands = True
                pieces = (search.straight(posture) if is_near else None) or search.by_ready(posture, before)
                if pieces is not None:
                    return Way(pieces=tuple(pieces), place=k, blocked=tuple(blocked))
                tried += 1
                if tried >= WAYS_TRIED:
                    return Way(pieces=(), place=None, blocked=tuple(blocked))
            if not stands:
                blocked.append(k)
        return Way(pieces=(), place=None, blocked=tuple(blocked))

    def _candidates(self, place: Float64, target: Float64, joints: Float64) -> Iterator[tuple[Float64, bool]]:
        """Postures at a place, and whether they were chosen for being near to where the arm is."""
        given: list[Float64] = []
        for reference, is_near in ((joints, True), (self._ready, False)):
            found = self._postures.at(place, target, reference)
            others = (q for q in found if all(np.abs(q - other).max() > OTHERWISE for other in given))
            for posture in islice(others, POSTURES_TRIED):
                given.append(posture)
                yield posture, is_near


class _Search:
    """Ways from one state of the arm."""

    def __init__(
        self,
        safety: Safety,
        detours: DetourPlanner,
        transits: TransitPlanner,
        state: ArmState,
        now: float,
        frame_stamp: float,
        points_w: Float64,
    ) -> None:
        self._safety, self._detours, self._transits = safety, detours, transits
        self._state, self._now, self._stamp, self._points = state, now, frame_stamp, points_w
        self._ready: Float64 = np.array(safety.model.ready_qpos)
        self._to_ready: list[Float64] | None = None
        self._knows_ready = False

    def straight(self, goal: Float64) -> list[Float64] | None:
        """The pieces of the straight way in joint space, if they are all safe."""
        return self._pieces([self._state.joint_positions, goal])

    def by_ready(self, goal: Float64, before: Sequence[Float64]) -> list[Float64] | None:
        """The pieces of the way by the ready posture, if they are all safe."""
        if not self._knows_ready:
            self._to_ready, self._knows_ready = self._find_ready(before), True
        if self._to_ready is None:
            return None
        coming_in = self._pieces([self._ready, *reversed(self._backed_away(goal))])
        return None if coming_in is None else [*self._to_ready, *coming_in]

    def _find_ready(self, before: Sequence[Float64]) -> list[Float64] | None:
        joints = self._state.joint_positions
        back = [joints]
        for earlier in (None, *reversed(before[-RETREATS:])):
            if earlier is not None:
                back.append(earlier)
            pieces = self._pieces([*back[:-1], *self._backed_away(back[-1]), self._ready])
            if pieces is not None:
                return pieces
        way = self._detours.plan(self._state, self._ready, self._now, self._stamp, self._points)
        return None if way is None else [move.joint_positions for move in way]

    def _backed_away(self, joints: Float64) -> list[Float64]:
        return [q.numpy() for q in self._transits.backed_away(torch.tensor(joints, dtype=torch.float64))]

    def _pieces(self, waypoints: Iterable[Float64]) -> list[Float64] | None:
        config = self._safety.config
        way = np.stack(list(waypoints))
        joint_step, flange_step = WITHIN * config.max_joint_step, WITHIN * config.max_flange_step
        pieces = cut_way(way, joint_step, flange_step, self._safety.model)
        at = way[0]
        for end in pieces:
            move = JointMove(joint_positions=end, speed_fraction=config.speed_fraction)
            here = ArmState(joint_positions=at, joint_velocities=np.zeros(7), stamp=self._state.stamp)
            if self._safety.check(move, here, self._now, self._stamp, self._points) is not None:
                return None
            at = end
        return pieces


def cut_way(
    waypoints: Float64, joint_step: float, flange_step: float, model: ArmModel = IIWA14
) -> list[Float64]:
    """Cuts straight lines in joint space into pieces.

    Args:
        waypoints: Joint positions, the present ones first, in [rad]. Shape (n, 7).
        joint_step: The most that one joint turns in a piece, in [rad].
        flange_step: The farthest that the flange gets from where a piece begins, in [m].
        model: Of the arm.

    Returns:
        Where each piece ends, in [rad]. Each of shape (7,).
    """
    ends: list[Float64] = []
    for start, goal in zip(waypoints[:-1], waypoints[1:], strict=True):
        count = max(int(np.ceil(np.abs(goal - start).max() / joint_step)), 1)
        while True:
            stops = [start + (goal - start) * k / count for k in range(count + 1)]
            if all(_reach(a, b, model) <= flange_step for a, b in zip(stops[:-1], stops[1:], strict=True)):
                break
            count += 1
        ends += stops[1:]
    return ends


def _reach(start: Float64, end: Float64, model: ArmModel) -> float:
    """The farthest that the flange gets from its start on a straight line in joint space, in [m]."""
    flange = forward_kinematics(torch.as_tensor(joint_path(start, end, 0.05)), model).numpy()[:, :3, 3]
    return float(np.linalg.norm(flange - flange[0], axis=-1).max())
