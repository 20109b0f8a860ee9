"""The task's belief and observation from an arm's measured joints and what its camera sighted."""

import numpy as np
import torch

from maniskill_tomato.deploy.interface import Float64
from maniskill_tomato.deploy.robot_perception import Sighting
from maniskill_tomato.robot.kinematics import forward_kinematics, link_transforms
from maniskill_tomato.robot.rotations import matrix_to_rpy
from maniskill_tomato.sensing.belief import Belief
from maniskill_tomato.sensing.observation import ObservationLayout, ViewpointObserver

FIRST_RPY = (0.0, np.pi / 2, 0.0)
"""The angles that those of the first view are near to, in [rad], as in the task: along +x, upright."""


class RobotBelief:
    """What is known of one target, view after view, as `TomatoViewpoint-v1` takes them."""

    def __init__(
        self,
        T_flange_camera: Float64,
        max_moves: int,
        layout: ObservationLayout | None = None,
    ) -> None:
        """Begins without a view.

        Args:
            T_flange_camera: The camera's optical frame in `link_ee`. Shape (4, 4).
            max_moves: Moves of an episode.
            layout: What the observation holds.
        """
        self._exact_mount = torch.as_tensor(np.array(T_flange_camera), dtype=torch.float64)
        self._mount = self._exact_mount.float()
        self._observer = ViewpointObserver(1, layout=layout, max_moves=max_moves)
        self._rpy = torch.tensor([FIRST_RPY])
        self._has_views = False

    def camera_pose(self, joint_positions: Float64) -> Float64:
        """Pose of the optical frame, in single precision as in the task. Shape (4, 4)."""
        pose: Float64 = self._poses(joint_positions)[1][0].double().numpy()
        return pose

    def camera_position(self, joint_positions: Float64) -> Float64:
        """Where a move begins, in the precision of the task's `pd_look_at`, world frame, in [m]. Shape (3,)."""
        joints = torch.tensor(joint_positions[None], dtype=torch.float32).double()
        pose = forward_kinematics(joints) @ self._exact_mount
        position: Float64 = pose[0, :3, 3].numpy()
        return position

    def observe(self, joint_positions: Float64, sighting: Sighting, moves_left: int) -> Belief:
        """Takes a view into the memory; once for every view.

        Args:
            joint_positions: When the picture was taken, in [rad]. Shape (7,).
            sighting: What the picture told.
            moves_left: Moves until the run ends.
        """
        if not self._has_views:
            target = torch.as_tensor(sighting.target_position, dtype=torch.float32)[None]
            self._observer.begin(torch.zeros(1, dtype=torch.int64), target)
            self._has_views = True
        elif sighting.recall is not None:
            sighting.recall(self._observer)
        T_world_flange, T_world_camera = self._poses(joint_positions)
        self._rpy = matrix_to_rpy(T_world_flange[:, :3, :3], self._rpy)
        viewpoint = torch.cat([T_world_flange[:, :3, 3], self._rpy], dim=-1)
        self._observer.observe(
            viewpoint,
            T_world_camera,
            sighting.rays,
            torch.tensor([sighting.visible_fraction], dtype=torch.float32),
            torch.tensor([moves_left]),
        )
        return self._observer.belief

    def _poses(self, joint_positions: Float64) -> tuple[torch.Tensor, torch.Tensor]:
        joints = torch.as_tensor(np.array(joint_positions)[None], dtype=torch.float32)
        flange = link_transforms(joints)[:, -1]
        return flange, flange @ self._mount
