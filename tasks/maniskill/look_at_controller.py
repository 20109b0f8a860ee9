"""The look-at control mode: a translation of the camera in its look frame, then it looks at the target again."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.robot.inverse_kinematics import Reach
from maniskill_tomato.robot.kinematics import forward_kinematics
from maniskill_tomato.robot.look_at import camera_to_viewpoint, flange_to_camera
from maniskill_tomato.robot.look_at_move import LookAtMover
from maniskill_tomato.tasks.maniskill.viewpoint_controller import (
    ViewpointController,
    ViewpointControllerConfig,
)


class LookAtController(ViewpointController):
    """Turns an action (right, up, forward), 1 meaning 0.12 m, into joint targets; see `robot.look_at_move`.

    A task sets `target_position` before every action.
    """

    target_position: Tensor | None
    """What the camera looks at, base frame, in [m]. Shape (num_envs, 3)."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._mover = LookAtMover(device=self.device)
        self.target_position = None

    def _initialize_action_space(self) -> None:
        self.single_action_space = spaces.Box(-1.0, 1.0, (3,), np.float32)

    def set_action(self, action: Any) -> None:
        """Moves the camera and sets the joint drives' targets.

        Args:
            action: Right, up, forward in the look frame; longer ones are cut to norm 1. Shape (num_envs, 3).

        Raises:
            InvalidInputError: Nobody has said where the target is.
        """
        if self.target_position is None:
            raise InvalidInputError(
                "control_mode='pd_look_at' needs a target: set agent.controller.target_position to (num_envs, 3)"
            )
        qpos = self.articulation.get_qpos()
        T_world_camera = flange_to_camera(forward_kinematics(qpos.double()))
        move = self._mover.move(qpos, T_world_camera[:, :3, 3], self.target_position, action)
        refused = (move.reach == int(Reach.UNREACHABLE))[:, None]
        taken = camera_to_viewpoint(move.T_world_camera, self.viewpoint[:, 3:].double()).float()
        self.viewpoint = torch.where(refused, self.viewpoint, taken)
        self.reach, self.target_qpos = move.reach, torch.where(refused, qpos, move.qpos.float())
        if self.config.drive_joints:
            self.articulation.set_joint_drive_targets(
                self.target_qpos, self.joints, self.active_joint_indices
            )


@dataclass
class LookAtControllerConfig(ViewpointControllerConfig):
    """Options of the look-at control mode; those about poses out of reach do not apply."""

    controller_cls = LookAtController
