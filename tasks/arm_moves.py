"""From an action to where the arm should go: kinematics only."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor

from maniskill_tomato.robot.inverse_kinematics import Reach
from maniskill_tomato.robot.kinematics import forward_kinematics
from maniskill_tomato.robot.look_at import camera_to_viewpoint, flange_to_camera
from maniskill_tomato.robot.look_at_move import LookAtMover
from maniskill_tomato.robot.transit import Transit
from maniskill_tomato.robot.viewpoint_move import OutsideWorkspace, ViewpointMover

Control = Literal["viewpoint", "look_at"]
"""What an action is: increments of the flange's viewpoint, or a move of the camera about its target."""

ACTION_SIZES: Mapping[Control, int] = {"viewpoint": 6, "look_at": 3}
"""Numbers of an action."""

CONTROL_MODES: Mapping[str, Control] = {"pd_viewpoint": "viewpoint", "pd_look_at": "look_at"}
"""The same in ManiSkill's words."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Plan:
    """Where the arms of N environments should go, and who looks from there."""

    target_qpos: Tensor
    """Joint positions at the end, in [rad]. Shape (N, 7), float32."""
    reach: Tensor
    """Values of `Reach`. Shape (N,), int64."""
    viewpoint: Tensor
    """Where the flange is if the arm arrives exactly; see `WorldState.viewpoint`. Shape (N, 6), float32."""
    transits: Mapping[int, Transit] = field(default_factory=dict)
    """The way of the environments that go by their ready posture; the others go straight."""
    turned: Tensor | None = None
    """The environments that turn to their next target, after a move is done; None for a move. Shape (b,)."""

    @property
    def moves_arms(self) -> bool:
        """Whether any arm is to move."""
        return self.turned is None or bool(self.transits)


class ArmMoves:
    """Plans the moves of one kind of action; not for use from several threads at once."""

    def __init__(
        self,
        control: Control,
        device: str | torch.device = "cpu",
        *,
        neighbour_poses: bool = True,
        outside_workspace: OutsideWorkspace = "stay",
    ) -> None:
        """Prepares the inverse kinematics.

        Args:
            control: What an action is.
            device: Where tensors live.
            neighbour_poses: As for `ViewpointMover`, like the next; both are about viewpoints only.
            outside_workspace: What an arm does about a viewpoint that it cannot take.
        """
        self.control: Control = control
        self._viewpoints = ViewpointMover(
            device, neighbour_poses=neighbour_poses, outside_workspace=outside_workspace
        )
        self._look_at = LookAtMover(device=device)

    def plan(self, qpos: Tensor, viewpoint: Tensor, target_position: Tensor, action: Tensor) -> Plan:
        """Where actions send the arms.

        Args:
            qpos: Joint positions, in [rad]. Shape (N, 7).
            viewpoint: Where the flange is; see `WorldState.viewpoint`. Shape (N, 6).
            target_position: What the camera looks at, in the base frame, in [m]. Shape (N, 3).
            action: Shape (N, A).
        """
        if self.control == "viewpoint":
            move = self._viewpoints.move(qpos, viewpoint, action)
            return Plan(target_qpos=move.qpos, reach=move.reach, viewpoint=move.viewpoint)
        T_world_camera = flange_to_camera(forward_kinematics(qpos.double()))
        look = self._look_at.move(qpos, T_world_camera[:, :3, 3], target_position, action)
        refused = (look.reach == int(Reach.UNREACHABLE))[:, None]
        taken = camera_to_viewpoint(look.T_world_camera, viewpoint[:, 3:].double()).float()
        return Plan(
            target_qpos=torch.where(refused, qpos, look.qpos.float()),
            reach=look.reach,
            viewpoint=torch.where(refused, viewpoint, taken),
        )
