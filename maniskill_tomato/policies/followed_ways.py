"""How many moves the arm really needs to a place: its way there is followed by kinematics, move by move.

A place that the arm can look from may still be out of reach from where it stands: no joint turns farther than
`LARGEST_JOINT_STEP` in a move, so that the arm keeps the posture it is in. A robot knows its joints, and finds that out
without spending moves on it.
"""

from typing import Final

import torch
import warp as wp
from torch import Tensor

from maniskill_tomato.policies.moves import LEAST_MOVE, moves_needed
from maniskill_tomato.robot import look_at_kernels
from maniskill_tomato.robot.arm_model import NUM_JOINTS, ArmModel
from maniskill_tomato.robot.iiwa14 import IIWA14
from maniskill_tomato.robot.ik_chain import vec7d
from maniskill_tomato.robot.look_at_move import MAX_MOVE, LookAtMover
from maniskill_tomato.warp_runtime import BatchKernel

SAME_PLACE: Final = 0.25 * MAX_MOVE
"""Cameras this near to each other have the same view, in [m]: a way ends this near to its goal."""

MOST_MOVES: Final = 10
"""Of longer ways the rest is taken to be free."""


class WayFollower:
    """Follows ways on one device; not for use from several threads at once."""

    def __init__(self, device: str | torch.device = "cpu", model: ArmModel = IIWA14) -> None:
        """Prepares the kinematics of the moves.

        Args:
            device: Where tensors live.
            model: Of the arm.
        """
        self._mover = LookAtMover(device, model=model)
        joints, vector = ((NUM_JOINTS,), torch.float64, vec7d), ((3,), torch.float64, wp.vec3d)
        self._follow = BatchKernel(
            look_at_kernels.way_kernel,
            inputs=[joints, vector, vector, vector],
            constants=[self._mover.rules, LEAST_MOVE, SAME_PLACE, MOST_MOVES],
            outputs=[((), torch.int64, wp.int64), ((), torch.float64, wp.float64)],
        )

    def moves_along(self, qpos: Tensor, position: Tensor, target: Tensor, goal: Tensor) -> Tensor:
        """How many moves straight towards their goals arms make until they are there.

        Args:
            qpos: Joint positions, in [rad]. Shape (M, 7).
            position: Where the cameras stand, in the base frame, in [m]. Shape (M, 3).
            target: What they look at. Shape (M, 3).
            goal: Where they are to go. Shape (M, 3).

        Returns:
            Infinite where a move is refused on the way. Shape (M,).
        """
        moves, rest = self._follow(self._mover.chain_joints(qpos), position, target, goal)
        more = torch.where(rest > 0.0, moves_needed(rest), 0.0)
        return torch.where(moves < 0, torch.inf, (moves + more).float())
