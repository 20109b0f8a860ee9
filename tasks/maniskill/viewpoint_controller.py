"""The viewpoint control mode: an increment of the end-effector's position and roll, pitch, yaw, then move
there and look.

The increment is added to where the end-effector is; the closed-form inverse kinematics says whether the arm
can take that pose, and `outside_workspace` what it does when it cannot. The action's 1 means 1 m or 1 rad, as
the thesis's tanh output does (section 4-3-2).
"""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from gymnasium import spaces
from mani_skill.agents.controllers.base_controller import BaseController, ControllerConfig
from torch import Tensor

from maniskill_tomato.robot.inverse_kinematics import InverseKinematics, Reach
from maniskill_tomato.robot.kinematics import forward_kinematics, viewpoint_transform
from maniskill_tomato.robot.rotations import matrix_to_rpy


class ViewpointController(BaseController):  # type: ignore[misc]
    """Turns an action (dx, dy, dz, droll, dpitch, dyaw) in the base frame into joint targets.

    The orientation is an increment of angles whose matrix is singular at pitch = pi/2, the usual viewing
    direction, so the controller remembers the angles that it asked for (`viewpoint`) instead of reading them
    back from a matrix.
    """

    config: "ViewpointControllerConfig"
    sets_target_qpos = True
    sets_target_qvel = False

    viewpoint: Tensor
    """Where the end-effector is or is heading: x, y, z [m], roll, pitch, yaw [rad], base frame. Shape
    (num_envs, 6), float32."""
    reach: Tensor
    """`Reach` of the pose asked for last. Shape (num_envs,), int64."""
    target_qpos: Tensor
    """Joint positions of `viewpoint`, in [rad]. Shape (num_envs, 7), float32."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        n = self.scene.num_envs
        self._inverse_kinematics = InverseKinematics(device=str(self.device))
        self.viewpoint = torch.zeros(n, 6, device=self.device)
        self.reach = torch.full((n,), int(Reach.REACHABLE), dtype=torch.int64, device=self.device)
        self.target_qpos = torch.zeros(n, 7, device=self.device)

    def _initialize_action_space(self) -> None:
        self.single_action_space = spaces.Box(-1.0, 1.0, (6,), np.float32)

    def set_drive_property(self) -> None:
        """Gives every joint its PD gains and torque limit."""
        config = self.config
        gains = zip(self.joints, config.stiffness, config.damping, config.force_limit, strict=True)
        for joint, stiffness, damping, force_limit in gains:
            joint.set_drive_properties(stiffness, damping, force_limit=force_limit, mode="force")

    def reset(self) -> None:
        """Takes the arm as it stands as the pose reached, with the angles nearest to those of before."""
        mask = self.scene._reset_mask
        self.reach = torch.where(mask, int(Reach.REACHABLE), self.reach)
        self.observe(mask)

    def observe(self, mask: Tensor | None = None) -> None:
        """Sets `viewpoint` and `target_qpos` from the joints as they are.

        Args:
            mask: The environments to update, all if None. Shape (num_envs,), bool.
        """
        qpos = self.qpos.clone()
        T_base_ee = forward_kinematics(qpos.double())
        rpy = matrix_to_rpy(T_base_ee[:, :3, :3], self.viewpoint[:, 3:].double())
        viewpoint = torch.cat([T_base_ee[:, :3, 3], rpy], dim=-1).float()
        if mask is not None:
            viewpoint = torch.where(mask[:, None], viewpoint, self.viewpoint)
            qpos = torch.where(mask[:, None], qpos, self.target_qpos)
        self.viewpoint, self.target_qpos = viewpoint, qpos

    def go_to(self, viewpoint: Tensor) -> None:
        """Asks for absolute viewpoints; `viewpoint`, `reach` and `target_qpos` then say what comes of it.

        Args:
            viewpoint: x, y, z [m], roll, pitch, yaw [rad] in the base frame. Shape (num_envs, 6).
        """
        qpos = self.articulation.get_qpos()
        solution = self._inverse_kinematics.solve(
            viewpoint_transform(viewpoint), qpos, neighbour=self.config.neighbour_poses
        )
        reach, target_qpos, taken = solution.reach, solution.qpos, viewpoint
        if int(reach.max()) != Reach.REACHABLE:
            taken = taken.double()
            neighbour = (reach == Reach.NEIGHBOUR)[:, None]
            unreachable = (reach == Reach.UNREACHABLE)[:, None]
            reached = solution.T_base_ee
            rpy = matrix_to_rpy(reached[:, :3, :3], taken[:, 3:])
            taken = torch.where(neighbour, torch.cat([reached[:, :3, 3], rpy], dim=-1), taken)
            if self.config.outside_workspace == "home":
                home = torch.zeros_like(target_qpos)
                T_home = forward_kinematics(home)
                at_home = torch.cat([T_home[:, :3, 3], torch.zeros_like(rpy)], dim=-1)
                target_qpos = torch.where(unreachable, home, target_qpos)
                taken = torch.where(unreachable, at_home, taken)
            else:
                target_qpos = torch.where(unreachable, qpos.double(), target_qpos)
                taken = torch.where(unreachable, self.viewpoint.double(), taken)
        self.viewpoint, self.reach, self.target_qpos = taken.float(), reach, target_qpos.float()

    def set_action(self, action: Any) -> None:
        """Adds the action, clipped to [-1, 1], to the viewpoint and sets the joint drives' targets.

        Args:
            action: dx, dy, dz [m], droll, dpitch, dyaw [rad]. Shape (num_envs, 6).
        """
        self.go_to(self.viewpoint + action.clamp(-1.0, 1.0))
        if self.config.drive_joints:
            self.articulation.set_joint_drive_targets(
                self.target_qpos, self.joints, self.active_joint_indices
            )

    def get_state(self) -> dict[str, Tensor]:
        """The viewpoint, shape (num_envs, 6), and the reach of the last pose asked for, shape (num_envs,
        1)."""
        return {"viewpoint": self.viewpoint.clone(), "reach": self.reach[:, None].float()}

    def set_state(self, state: dict[str, Tensor]) -> None:
        """Takes back what `get_state` gave; the joints must have been set before.

        Args:
            state: `viewpoint` of shape (num_envs, 6) and `reach` of shape (num_envs, 1).
        """
        self.viewpoint = state["viewpoint"].to(self.device).clone()
        self.reach = state["reach"][:, 0].to(self.device, torch.int64)
        self.target_qpos = self.qpos.clone()


@dataclass
class ViewpointControllerConfig(ControllerConfig):  # type: ignore[misc]
    """Options of the viewpoint control mode."""

    stiffness: tuple[float, ...]
    """Proportional gain of each joint's drive, in [N m/rad]."""
    damping: tuple[float, ...]
    """Derivative gain of each joint's drive, in [N m s/rad]."""
    force_limit: tuple[float, ...]
    """Largest torque of each joint, in [N m]."""
    neighbour_poses: bool = True
    """Whether the nearest reachable pose within 5 cm and 10 degrees is taken for one that cannot be
    reached."""
    outside_workspace: Literal["home", "stay"] = "stay"
    """An unreachable pose sends the arm to its home configuration (all joints 0), or leaves it where it
    is."""
    drive_joints: bool = True
    """Whether to hand the targets to the joint drives; a purely kinematic user sets the joints itself."""
    controller_cls = ViewpointController
