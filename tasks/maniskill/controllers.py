"""The control modes `pd_viewpoint` and `pd_look_at`: the world's plans as ManiSkill controllers."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from mani_skill.agents.controllers.base_controller import BaseController, ControllerConfig
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.robot.viewpoint_move import viewpoint_of
from maniskill_tomato.tasks.arm_moves import ACTION_SIZES, ArmMoves, Control


class ArmMoveController(BaseController):  # type: ignore[misc]
    """Turns actions into joint targets, for an arm outside the tasks; in them the world plans and this is passed by."""

    config: "ArmMoveControllerConfig"
    sets_target_qpos = True
    sets_target_qvel = False

    viewpoint: Tensor
    """Where the end-effector is or is heading: x, y, z [m], roll, pitch, yaw [rad], base frame. Shape
    (num_envs, 6), float32."""
    target_position: Tensor | None = None
    """What `pd_look_at` looks at, base frame, in [m]; to be set before its actions. Shape (num_envs, 3)."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._moves = ArmMoves(self.config.control, self.device)
        self.viewpoint = torch.zeros(self.scene.num_envs, 6, device=self.device)

    def _initialize_action_space(self) -> None:
        self.single_action_space = spaces.Box(-1.0, 1.0, (ACTION_SIZES[self.config.control],), np.float32)

    def set_drive_property(self) -> None:
        """Gives every joint its PD gains and torque limit."""
        config = self.config
        gains = zip(self.joints, config.stiffness, config.damping, config.force_limit, strict=True)
        for joint, stiffness, damping, force_limit in gains:
            joint.set_drive_properties(stiffness, damping, force_limit=force_limit, mode="force")

    def reset(self) -> None:
        """Takes the arm as it stands as the viewpoint reached, with the angles nearest to those of before."""
        reached = viewpoint_of(self.qpos, self.viewpoint[:, 3:])
        self.viewpoint = torch.where(self.scene._reset_mask[:, None], reached, self.viewpoint)

    def set_action(self, action: Any) -> None:
        """Sets the joint drives' targets.

        Args:
            action: Shape (num_envs, A).

        Raises:
            InvalidInputError: Nobody has said where the target is.
        """
        target = self.target_position
        if target is None:
            if self.config.control == "look_at":
                raise InvalidInputError(
                    "control_mode='pd_look_at' needs a target: set agent.controller.target_position to (num_envs, 3)"
                )
            target = self.viewpoint[:, :3]
        plan = self._moves.plan(self.qpos, self.viewpoint, target, action)
        self.viewpoint = plan.viewpoint
        self.articulation.set_joint_drive_targets(plan.target_qpos, self.joints, self.active_joint_indices)

    def get_state(self) -> dict[str, Tensor]:
        """The viewpoint. Shape (num_envs, 6)."""
        return {"viewpoint": self.viewpoint.clone()}

    def set_state(self, state: dict[str, Tensor]) -> None:
        """Takes back what `get_state` gave; the joints must have been set before."""
        self.viewpoint = state["viewpoint"].to(self.device).clone()


@dataclass
class ArmMoveControllerConfig(ControllerConfig):  # type: ignore[misc]
    """Options of these control modes."""

    stiffness: tuple[float, ...]
    """Proportional gain of each joint's drive, in [N m/rad]."""
    damping: tuple[float, ...]
    """Derivative gain of each joint's drive, in [N m s/rad]."""
    force_limit: tuple[float, ...]
    """Largest torque of each joint, in [N m]."""
    control: Control
    """What an action is."""
    controller_cls = ArmMoveController
