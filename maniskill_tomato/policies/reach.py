"""Which camera positions the arm can take while the camera looks at the target."""

import torch
from torch import Tensor

from maniskill_tomato.robot.iiwa14 import NUM_JOINTS
from maniskill_tomato.robot.inverse_kinematics import InverseKinematics, Reach
from maniskill_tomato.robot.look_at import CAMERA_ROLLS, camera_to_flange, look_at_pose
from maniskill_tomato.robot.look_at_move import keeps_clear

_BLOCK = 256
"""Poses solved at a time; the kernel keeps its buffers for a few batch sizes."""


class CameraReach:
    """Asks the inverse kinematics, with any of the rolls that the `pd_look_at` control mode tries.

    A single move may still be refused, because the joints would turn too far for it.
    """

    def __init__(self, device: str | torch.device = "cpu") -> None:
        self._kinematics = InverseKinematics(device)

    def reachable(self, positions: Tensor, target: Tensor) -> Tensor:
        """Which positions can be taken.

        Args:
            positions: Of the camera, in the world frame, in [m]. Shape (N, 3).
            target: What it looks at. Shape (3,).

        Returns:
            Shape (N,), bool.
        """
        found = torch.zeros(len(positions), dtype=torch.bool, device=positions.device)
        for roll in CAMERA_ROLLS:
            left = torch.nonzero(~found)[:, 0]
            if not len(left):
                break
            poses = camera_to_flange(look_at_pose(positions[left].double(), target.double(), roll))
            found[left] = self._solve(poses) & keeps_clear(poses)
        return found

    def _solve(self, T_base_flange: Tensor) -> Tensor:
        count = len(T_base_flange)
        padded = torch.cat([T_base_flange, T_base_flange[:1].expand(-count % _BLOCK, 4, 4)])
        zeros = padded.new_zeros(_BLOCK, NUM_JOINTS)
        blocks = [
            self._kinematics.solve(block, zeros, neighbour=False).reach == int(Reach.REACHABLE)
            for block in torch.split(padded, _BLOCK)
        ]
        return torch.cat(blocks)[:count]
