"""Turns the policy's action into joint positions that `safety` accepts."""

import logging
from dataclasses import dataclass
from itertools import islice
from typing import Final

import numpy as np
import torch

from maniskill_tomato.deploy.detour import DetourPlanner
from maniskill_tomato.deploy.interface import ArmState, Float64, JointMove
from maniskill_tomato.deploy.postures import Postures
from maniskill_tomato.deploy.safety import COLLISIONS, Refusal, Safety
from maniskill_tomato.robot.inverse_kinematics import Reach
from maniskill_tomato.robot.look_at_move import LookAtMover, moved_position

OTHERS_TRIED: Final = 16
"""So many other postures are held against `safety` before a move counts as refused."""

_logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True, eq=False)
class MoveRequest:
    """Where the policy wants the camera."""

    joint_positions: Float64
    """Where the arm was when the picture was taken, in [rad]. Shape (7,)."""
    camera_position: Float64
    """Where the camera was then, world frame, in [m]. Shape (3,)."""
    target_position: Float64
    """What it looks at, likewise. Shape (3,)."""
    action: tuple[float, float, float]
    """Right, up, forward, in [-1, 1]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Choice:
    """What became of a request."""

    move: JointMove | None
    """The safe move, or if there is none the task's own; None where the arm cannot reach that either."""
    refusal: Refusal | None
    """Why `safety` refuses the task's own; None if `move` may go out or there is none."""
    then: tuple[JointMove, ...] = ()
    """What follows `move` on a way round an obstacle; each is checked again before it goes out."""


class MoveChooser:
    """The task's own posture where it is safe, else another one of the same or a shorter move, else a way round."""

    def __init__(self, safety: Safety, T_flange_camera: Float64) -> None:
        """Prepares the kinematics.

        Args:
            safety: Judges every posture in full.
            T_flange_camera: The camera's optical frame in `link_ee`. Shape (4, 4).
        """
        self._safety = safety
        self._mover = LookAtMover(T_flange_camera=np.array(T_flange_camera, dtype=np.float64))
        self._postures = Postures(T_flange_camera, safety.config.joint_margin)
        self._detours = DetourPlanner(safety, T_flange_camera)

    def own_goal(self, request: MoveRequest) -> Float64 | None:
        """Joint positions of the task's own move, in [rad], shape (7,); None if out of reach."""
        solved = self._mover.move(
            torch.tensor(request.joint_positions[None], dtype=torch.float32),
            torch.as_tensor(request.camera_position[None]),
            torch.as_tensor(request.target_position[None]),
            torch.tensor([request.action]),
        )
        if int(solved.reach[0]) == int(Reach.UNREACHABLE):
            return None
        goal: Float64 = solved.qpos[0].float().double().numpy()
        return goal

    def choose(
        self,
        request: MoveRequest,
        own_goal: Float64 | None,
        state: ArmState,
        now: float,
        frame_stamp: float,
        points_w: Float64,
    ) -> Choice:
        """Holds the task's own posture, then others against `safety`, then looks for a way round to its own.

        Args:
            request: Where to.
            own_goal: What the task would do, from `own_goal`.
            state: Where the arm is.
            now: The time, in [s].
            frame_stamp: When the picture was taken, in [s].
            points_w: What was seen of the plant, base frame, in [m]. Shape (P, 3).
        """
        config = self._safety.config
        own: JointMove | None = None
        refusal: Refusal | None = None
        if own_goal is not None:
            own = JointMove(joint_positions=own_goal, speed_fraction=config.speed_fraction)
            refusal = self._safety.check(own, state, now, frame_stamp, points_w)
            if refusal is None:
                return Choice(move=own, refusal=None)
        aim = moved_position(
            torch.as_tensor(request.camera_position),
            torch.as_tensor(request.target_position),
            torch.tensor(request.action, dtype=torch.float64),
        )
        others = self._postures.of_move(
            state.joint_positions,
            request.camera_position,
            aim.numpy(),
            request.target_position,
            config.max_joint_step,
        )
        for posture in islice(others, OTHERS_TRIED):
            move = JointMove(joint_positions=posture, speed_fraction=config.speed_fraction)
            if self._safety.check(move, state, now, frame_stamp, points_w) is None:
                _logger.info("the move is made in another posture, because %s", refusal or "out of reach")
                return Choice(move=move, refusal=None)
        if own is not None and refusal is not None and refusal.reason in COLLISIONS:
            way = self._detours.plan(state, own.joint_positions, now, frame_stamp, points_w)
            if way is not None:
                _logger.info("the move is made in %d parts, because %s", len(way), refusal)
                return Choice(move=way[0], refusal=None, then=tuple(way[1:]))
        return Choice(move=own, refusal=refusal)
