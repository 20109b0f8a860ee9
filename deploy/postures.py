"""Other ways to hold the camera at a pose: the arm has seven joints for six numbers, and the picture may be rolled.

The task's kinematics (`robot.look_at_move`) take the posture nearest to the present one and know nothing of collisions.
Where `safety` refuses that one, these are tried next. All belong to the same move or a shorter one. Nothing is
clamped; each is checked in full.
"""

from collections.abc import Iterator
from typing import Final

import numpy as np
import torch
from torch import Tensor

from maniskill_tomato.deploy.interface import Float64
from maniskill_tomato.robot.iiwa14 import JOINT_LOWER, JOINT_UPPER, NUM_JOINTS, READY_QPOS
from maniskill_tomato.robot.inverse_kinematics import IkConfig, InverseKinematics, Reach
from maniskill_tomato.robot.look_at import CAMERA_ROLLS, look_at_pose
from maniskill_tomato.robot.look_at_move import MIN_DISTANCE, MOVE_SHARES, keeps_clear

SWIVELS: Final = (0.0, 0.5, -0.5, 1.0, -1.0, 1.6, -1.6)
"""Turns of joint 3 from a reference posture that lead the elbow elsewhere, in [rad]."""

SAME: Final = 0.05
"""Postures that differ by less than this in every joint count as one, in [rad]."""

SHARE_COST: Final = 1.0
"""A move shortened to half costs as much as turning the joints by so much more, in [rad]."""
ROLL_COST: Final = 0.3
"""The same for a picture turned by 30 degrees."""


class Postures:
    """Solves for postures in batches."""

    def __init__(self, T_flange_camera: Float64, joint_margin: float) -> None:
        """Prepares the inverse kinematics.

        Args:
            T_flange_camera: The camera's optical frame in `link_ee`. Shape (4, 4).
            joint_margin: How far joints must stay from their limits, in [rad].
        """
        # Limits weigh more than in the task, so that postures stay off them.
        self._ik = InverseKinematics(config=IkConfig(limit_margin=0.3, limit_weight=2.0))
        self._T_camera_flange = torch.as_tensor(np.linalg.inv(T_flange_camera), dtype=torch.float64)
        self._low = torch.as_tensor(JOINT_LOWER + joint_margin)
        self._high = torch.as_tensor(JOINT_UPPER - joint_margin)
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

    @staticmethod
    def _references(joints: Float64) -> Tensor:
        references = []
        for base in (np.array(joints), np.array(READY_QPOS)):
            for swivel in SWIVELS:
                posture = base.copy()
                posture[2] = np.clip(posture[2] + swivel, JOINT_LOWER[2], JOINT_UPPER[2])
                references.append(posture)
        return torch.as_tensor(np.stack(references).reshape(-1, NUM_JOINTS))


def _distinct(found: list[tuple[float, Float64]]) -> Iterator[Float64]:
    given: list[Float64] = []
    for _, posture in sorted(found, key=lambda item: item[0]):
        if all(np.abs(posture - other).max() > SAME for other in given):
            given.append(posture)
            yield posture
