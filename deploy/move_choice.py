"""Turns the policy's action into joint positions that `safety` accepts.

The task's own move (`robot.look_at_move`) takes the posture nearest to the present one and knows nothing of collisions.
Where `safety` refuses it, other postures of the same move or of a shorter one are tried: the arm has seven joints for
six numbers, and the picture may be rolled. Where these fail too, a way round is looked for (`detour`). Nothing is
clamped; each posture is checked in full.
"""

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from typing import Final

import numpy as np
import torch
from torch import Tensor

from maniskill_tomato.deploy.detour import DetourPlanner
from maniskill_tomato.deploy.interface import ArmState, Float64, JointMove
from maniskill_tomato.deploy.refusals import COLLISIONS, Refusal
from maniskill_tomato.deploy.safety import Safety
from maniskill_tomato.robot.arm_model import NUM_JOINTS, ArmModel
from maniskill_tomato.robot.iiwa14 import IIWA14
from maniskill_tomato.robot.inverse_kinematics import IkConfig, InverseKinematics, Reach
from maniskill_tomato.robot.look_at import CAMERA_ROLLS, look_at_pose
from maniskill_tomato.robot.look_at_move import (
    MIN_DISTANCE,
    MOVE_SHARES,
    LookAtMover,
    keeps_clear,
    moved_position,
)
from maniskill_tomato.robot.out_of_reach import out_of_reach

SWIVELS: Final = (0.0, 0.5, -0.5, 1.0, -1.0, 1.6, -1.6)
"""Turns of joint 3 from a reference posture that lead the elbow elsewhere, in [rad]."""

SAME: Final = 0.05
"""Postures that differ by less than this in every joint count as one, in [rad]."""

SHARE_COST: Final = 1.0
"""A move shortened to half costs as much as turning the joints by so much more, in [rad]."""
ROLL_COST: Final = 0.3
"""The same for a picture turned by 30 degrees."""

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
    out_of_reach: str = ""
    """Why there is no move, if there is none."""
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
        self._mount = np.array(T_flange_camera, dtype=np.float64)
        self._mover = LookAtMover(T_flange_camera=self._mount, model=safety.model)
        self._postures = Postures(T_flange_camera, safety.config.joint_margin, safety.model)
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
        why = "it is out of reach" if refusal is None else f"{refusal.reason}: {refusal.detail}"
        for posture in islice(others, OTHERS_TRIED):
            move = JointMove(joint_positions=posture, speed_fraction=config.speed_fraction)
            if self._safety.check(move, state, now, frame_stamp, points_w) is None:
                _logger.info("the move is made in another posture, because %s", why)
                return Choice(move=move, refusal=None)
        if own is not None and refusal is not None and refusal.reason in COLLISIONS:
            way = self._detours.plan(state, own.joint_positions, now, frame_stamp, points_w)
            if way is not None:
                _logger.info("the move is made in %d parts, because %s", len(way), why)
                return Choice(move=way[0], refusal=None, then=tuple(way[1:]))
        if own is not None:
            return Choice(move=own, refusal=refusal)
        reach = out_of_reach(
            self._mover,
            self._mount,
            np.array(request.joint_positions),
            aim.numpy(),
            np.array(request.target_position),
            self._safety.model,
        )
        return Choice(move=None, refusal=None, out_of_reach=str(reach))


class Postures:
    """Solves for postures in batches."""

    def __init__(self, T_flange_camera: Float64, joint_margin: float, model: ArmModel = IIWA14) -> None:
        """Prepares the inverse kinematics.

        Args:
            T_flange_camera: The camera's optical frame in `link_ee`. Shape (4, 4).
            joint_margin: How far joints must stay from their limits, in [rad].
            model: Of the arm.
        """
        self._model = model
        # Limits weigh more than in the task, so that postures stay off them.
        self._ik = InverseKinematics(config=IkConfig(limit_margin=0.3, limit_weight=2.0), model=model)
        self._T_camera_flange = torch.as_tensor(np.linalg.inv(T_flange_camera), dtype=torch.float64)
        self._low = torch.as_tensor(model.joint_lower + joint_margin)
        self._high = torch.as_tensor(model.joint_upper - joint_margin)
        self._rolls = torch.tensor(CAMERA_ROLLS, dtype=torch.float64)

    def of_move(
        self, joints: Float64, position: Float64, goal: Float64, target: Float64, max_joint_step: float
    ) -> Iterator[Float64]:
        """Postures that look at the target from the end of a move or from nearer by, cheapest first.

        Args:
            joints: Where the arm is, in [rad]. Shape (7,).
            position: Where the camera is, world frame, in [m]. Shape (3,).
            goal: Where it shall go, likewise. Shape (3,).
            target: What it looks at, likewise. Shape (3,).
            max_joint_step: No joint may turn farther, in [rad].

        Yields:
            Joint positions, in [rad]. Shape (7,).
        """
        found: list[tuple[float, Float64]] = []
        for share in MOVE_SHARES:
            place = position + share * (goal - position)
            away = place - target
            distance = float(np.linalg.norm(away))
            place = target + away * max(1.0, MIN_DISTANCE / max(distance, 1e-6))
            extra = SHARE_COST * (1.0 / share - 1.0)
            for cost, posture in self._at(place, target, joints):
                if np.abs(posture - joints).max() <= max_joint_step:
                    found.append((cost + extra, posture))
        yield from _distinct(found)

    def at(self, position: Float64, target: Float64, joints: Float64) -> Iterator[Float64]:
        """Postures that look at the target from a position, those nearest to `joints` first."""
        yield from _distinct(list(self._at(position, target, joints)))

    def _at(self, position: Float64, target: Float64, joints: Float64) -> Iterator[tuple[float, Float64]]:
        poses = look_at_pose(
            torch.as_tensor(position)[None], torch.as_tensor(np.array(target))[None], self._rolls
        )
        flange = poses @ self._T_camera_flange
        clear = keeps_clear(flange)
        references = self._references(joints)
        rolls, count = len(self._rolls), len(references)
        solution = self._ik.solve(
            flange.repeat_interleave(count, dim=0), references.repeat(rolls, 1), neighbour=False
        )
        q = solution.qpos
        good = (solution.reach == int(Reach.REACHABLE)) & clear.repeat_interleave(count)
        good &= (q >= self._low).all(-1) & (q <= self._high).all(-1)
        turned = (self._rolls.abs() * (180.0 / torch.pi / 30.0)).repeat_interleave(count)
        cost = (q - torch.as_tensor(np.array(joints))).abs().amax(-1) + ROLL_COST * turned
        for k in good.nonzero()[:, 0].tolist():
            yield float(cost[k]), q[k].float().double().numpy()

    def _references(self, joints: Float64) -> Tensor:
        model, references = self._model, []
        for base in (np.array(joints), np.array(model.ready_qpos)):
            for swivel in SWIVELS:
                posture = base.copy()
                posture[2] = np.clip(posture[2] + swivel, model.joint_lower[2], model.joint_upper[2])
                references.append(posture)
        return torch.as_tensor(np.stack(references).reshape(-1, NUM_JOINTS))


def _distinct(found: list[tuple[float, Float64]]) -> Iterator[Float64]:
    given: list[Float64] = []
    for _, posture in sorted(found, key=lambda item: item[0]):
        if all(np.abs(posture - other).max() > SAME for other in given):
            given.append(posture)
            yield posture
