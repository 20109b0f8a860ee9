"""One move of the thesis's kind: an increment of the flange's position and roll, pitch, yaw.

The inverse kinematics says whether the arm can take the new viewpoint; what happens when it cannot is the caller's
choice: a neighbour pose, home, or staying where it is.
"""

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from maniskill_tomato.robot.inverse_kinematics import InverseKinematics, Reach
from maniskill_tomato.robot.kinematics import forward_kinematics, viewpoint_transform
from maniskill_tomato.robot.rotations import matrix_to_rpy

OutsideWorkspace = Literal["home", "stay"]
"""An unreachable viewpoint sends the arm to its home configuration (all joints 0), or leaves it where it is."""


@dataclass(frozen=True, eq=False)
class ViewpointMove:
    """What comes of a move."""

    qpos: Tensor
    """Joint positions to go to, in [rad]. Shape (B, 7), float32."""
    reach: Tensor
    """Values of `Reach`. Shape (B,), int64."""
    viewpoint: Tensor
    """Where the flange is then: x, y, z [m], roll, pitch, yaw [rad], base frame. Shape (B, 6), float32."""


def viewpoint_of(qpos: Tensor, reference_rpy: Tensor) -> Tensor:
    """The flange's viewpoint at joint positions.

    The matrix of roll, pitch, yaw is singular at pitch = pi/2, the usual viewing direction, so that the angles are
    chosen near to those of before.

    Args:
        qpos: Joint positions, in [rad]. Shape (B, 7).
        reference_rpy: Angles to be near to, in [rad]. Shape (B, 3).

    Returns:
        x, y, z [m], roll, pitch, yaw [rad]. Shape (B, 6), float32.
    """
    T_base_ee = forward_kinematics(qpos.double())
    rpy = matrix_to_rpy(T_base_ee[:, :3, :3], reference_rpy.double())
    return torch.cat([T_base_ee[:, :3, 3], rpy], dim=-1).float()


class ViewpointMover:
    """Solves moves on one device; not for use from several threads at once."""

    def __init__(
        self,
        device: str | torch.device = "cpu",
        *,
        neighbour_poses: bool = True,
        outside_workspace: OutsideWorkspace = "stay",
    ) -> None:
        """Prepares the inverse kinematics.

        Args:
            device: Where tensors live.
            neighbour_poses: Whether the nearest reachable pose within 5 cm and 10 degrees is taken for one that
                cannot be reached.
            outside_workspace: What the arm does when it cannot be reached either.
        """
        self._inverse_kinematics = InverseKinematics(device=device)
        self._neighbour_poses = neighbour_poses
        self._outside_workspace = outside_workspace

    def move(self, qpos: Tensor, viewpoint: Tensor, action: Tensor) -> ViewpointMove:
        """Adds increments to viewpoints.

        Args:
            qpos: Joint positions, in [rad]. Shape (B, 7).
            viewpoint: Where the flange is, with the angles that were asked for. Shape (B, 6).
            action: dx, dy, dz [m], droll, dpitch, dyaw [rad], clipped to [-1, 1]. Shape (B, 6).
        """
        asked = viewpoint + action.clamp(-1.0, 1.0)
        solution = self._inverse_kinematics.solve(
            viewpoint_transform(asked), qpos, neighbour=self._neighbour_poses
        )
        reach, target_qpos = solution.reach, solution.qpos
        if solution.all_reachable:
            return ViewpointMove(target_qpos.float(), reach, asked)
        taken = asked.double()
        neighbour = (reach == Reach.NEIGHBOUR)[:, None]
        unreachable = (reach == Reach.UNREACHABLE)[:, None]
        reached = solution.T_base_ee
        rpy = matrix_to_rpy(reached[:, :3, :3], taken[:, 3:])
        taken = torch.where(neighbour, torch.cat([reached[:, :3, 3], rpy], dim=-1), taken)
        if self._outside_workspace == "home":
            home = torch.zeros_like(target_qpos)
            T_home = forward_kinematics(home)
            at_home = torch.cat([T_home[:, :3, 3], torch.zeros_like(rpy)], dim=-1)
            target_qpos = torch.where(unreachable, home, target_qpos)
            taken = torch.where(unreachable, at_home, taken)
        else:
            target_qpos = torch.where(unreachable, qpos.double(), target_qpos)
            taken = torch.where(unreachable, viewpoint.double(), taken)
        return ViewpointMove(target_qpos.float(), reach, taken.float())
