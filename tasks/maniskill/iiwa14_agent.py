"""The iiwa 14 with a D435 on its flange, as ManiSkill agents."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import sapien
import torch
from mani_skill.agents.base_agent import BaseAgent, Keyframe
from mani_skill.agents.controllers import (
    PDEEPosController,
    PDEEPosControllerConfig,
    PDEEPoseController,
    PDEEPoseControllerConfig,
    PDJointPosControllerConfig,
)
from mani_skill.agents.controllers.utils.kinematics import Kinematics
from mani_skill.agents.registration import register_agent
from mani_skill.sensors.camera import CameraConfig

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.robot import d435, iiwa14
from maniskill_tomato.robot.iiwa14 import READY_QPOS as READY_QPOS
from maniskill_tomato.robot.iiwa14 import REST_QPOS as REST_QPOS
from maniskill_tomato.robot.robot_description import urdf_path
from maniskill_tomato.tasks.maniskill.controllers import ArmMoveControllerConfig

STIFFNESS = (10000.0, 10000.0, 5000.0, 5000.0, 2500.0, 1600.0, 800.0)
"""Proportional gain of each joint's drive, in [N m / rad]."""

DAMPING = (500.0, 500.0, 190.0, 190.0, 60.0, 40.0, 16.0)
"""Derivative gain of each joint's drive, in [N m s / rad]."""

JOINT_STEP = 0.1
"""Largest joint increment of one `pd_joint_delta_pos` action, in [rad]."""

POSITION_STEP = 0.1
"""Largest translation of one `pd_ee_delta_pose` or `pd_ee_delta_pos` action along each axis of the base, in [m]."""

ROTATION_STEP = 0.1
"""Largest rotation of one `pd_ee_delta_pose` action, in [rad]."""

MAX_REACH = 1.306
"""Bound on each coordinate of a `pd_ee_pose` action, in [m]: the height of the stretched arm."""


@dataclass
class D435CameraConfig(CameraConfig):  # type: ignore[misc]
    """A ManiSkill camera whose intrinsics follow from the D435's stream and the size asked for.

    `gym.make(..., sensor_configs=dict(width=640, height=480))` changes the size and this class the focal
    length with it; `sensor_configs=dict(d435=dict(calibration="measured"))` takes a real device's numbers. An
    `intrinsic` or another `fov` given there wins.
    """

    fov: Any = None
    """Vertical field of view, in [rad]; filled in where neither this nor `intrinsic` is given."""
    stream: d435.Stream = "color"
    """Which of the D435's pictures this is."""
    calibration: d435.Calibration = "nominal"
    """The data sheet's numbers, or those of one real device (colour only)."""
    derived_fov: float | None = None
    """The `fov` that this class filled in; not for users."""
    derived_intrinsic: Any = None
    """The `intrinsic` that this class filled in; not for users."""

    def __post_init__(self) -> None:
        """Fills in the intrinsics; ManiSkill calls this again after it has applied the user's changes."""
        fov: Any = None if self.fov == self.derived_fov else self.fov
        intrinsic: Any = None if self.intrinsic is self.derived_intrinsic else self.intrinsic
        if intrinsic is None and fov is None:
            intrinsics = self._stream_intrinsics()
            if intrinsics.symmetric:
                fov = self.derived_fov = intrinsics.fov_y
            else:
                intrinsic = self.derived_intrinsic = intrinsics.matrix
        # ManiSkill takes one or the other, and does not say that they exclude each other.
        self.intrinsic: Any = intrinsic
        self.fov = fov if intrinsic is None else None
        super().__post_init__()

    def _stream_intrinsics(self) -> d435.CameraIntrinsics:
        if self.stream == "color":
            return d435.color_intrinsics(self.width, self.height, self.calibration)
        if self.calibration != "nominal":
            raise InvalidInputError(
                f"calibration {self.calibration!r} is known for the colour stream only; leave it "
                "'nominal' for depth, or give `intrinsic`"
            )
        return d435.depth_intrinsics(self.width, self.height)


class LimitedKinematics(Kinematics):  # type: ignore[misc]
    """ManiSkill's inverse kinematics, of which solutions beyond the joints' limits count as none."""

    def compute_ik(self, pose: Any, q0: torch.Tensor, *arguments: Any, **options: Any) -> torch.Tensor | None:
        """Joint positions that reach a pose, those of `q0` for arms that do not. Shape (num_envs, 7)."""
        solved: Any = super().compute_ik(pose, q0, *arguments, **options)
        if solved is None:
            return None
        lower, upper = self.articulation.get_qlimits().unbind(-1)
        within = ((solved >= lower) & (solved <= upper)).all(dim=-1, keepdim=True)
        limited: torch.Tensor = torch.where(within, solved, q0)
        return limited


class EEPosController(PDEEPosController):  # type: ignore[misc]
    """ManiSkill's end-effector controller, within the joints' limits."""

    def _initialize_joints(self) -> None:
        super()._initialize_joints()
        config = self.config
        self.kinematics = LimitedKinematics(
            config.urdf_path, config.ee_link, self.articulation, self.active_joint_indices
        )


class EEPoseController(EEPosController, PDEEPoseController):  # type: ignore[misc]
    """The same for position and orientation."""


class EEDeltaPoseController(EEPoseController):
    """ManiSkill's end-effector controller, turning the way the action says.

    The original scales rotations by their lower bound, so that +1 about an axis turns by -`ROTATION_STEP`.
    """

    def _clip_and_scale_action(self, action: torch.Tensor) -> torch.Tensor:
        scaled: torch.Tensor = super()._clip_and_scale_action(action)
        return torch.hstack([scaled[:, :3], -scaled[:, 3:]])


@register_agent()
class Iiwa14D435(BaseAgent):  # type: ignore[misc]
    """KUKA LBR iiwa 14 R820 with a RealSense D435 on its flange.

    Its sensor `d435` is the colour camera with depth aligned to it, as the SDK's align gives it. The default
    of 160 x 120 px suits learning; the real camera's usual mode of 640 x 480 has the same field of view.
    Every size up to 16:9, square ones too, keeps the vertical field of view of 42.5 degrees.
    """

    CONTROL_MODES = (
        "pd_viewpoint",
        "pd_look_at",
        "pd_joint_pos",
        "pd_joint_delta_pos",
        "pd_ee_delta_pos",
        "pd_ee_delta_pose",
        "pd_ee_pose",
    )
    """The control modes; the first is the default. `pd_ee_delta_pos` moves the flange along the axes of the base and
    keeps its orientation; as with the other two of the end-effector, an arm that does not get there stays."""

    uid = "iiwa14_d435"
    fix_root_link = True
    disable_self_collisions = False
    ee_link_name = iiwa14.EE_LINK_NAME

    keyframes: dict[str, Any] = {
        "home": Keyframe(qpos=np.array(iiwa14.HOME_QPOS), pose=sapien.Pose()),
        "ready": Keyframe(qpos=READY_QPOS, pose=sapien.Pose()),
        "rest": Keyframe(qpos=REST_QPOS, pose=sapien.Pose()),
    }

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        # ManiSkill offers a download and exits the process when the file is missing.
        self.urdf_path = urdf_path()
        super().__init__(*args, **kwargs)

    def _after_init(self) -> None:
        links = self.robot.links_map
        self.ee_link = links[iiwa14.EE_LINK_NAME]
        self.color_frame = links[d435.COLOR_FRAME_NAME]

    @property
    def _controller_configs(self) -> dict[str, Any]:
        drives: dict[str, Any] = dict(
            stiffness=STIFFNESS,
            damping=DAMPING,
            force_limit=tuple(iiwa14.TORQUE_LIMITS),
        )
        joints = list(iiwa14.JOINT_NAMES)
        end_effector: dict[str, Any] = dict(**drives, ee_link=iiwa14.EE_LINK_NAME, urdf_path=self.urdf_path)
        delta_pos = PDEEPosControllerConfig(joints, -POSITION_STEP, POSITION_STEP, **end_effector)
        delta_pos.controller_cls = EEPosController
        delta_pose = PDEEPoseControllerConfig(
            joints,
            -POSITION_STEP,
            POSITION_STEP,
            rot_lower=-ROTATION_STEP,
            rot_upper=ROTATION_STEP,
            **end_effector,
        )
        delta_pose.controller_cls = EEDeltaPoseController
        pose = PDEEPoseControllerConfig(
            joints, -MAX_REACH, MAX_REACH, use_delta=False, normalize_action=False, **end_effector
        )
        pose.controller_cls = EEPoseController
        return {
            "pd_viewpoint": ArmMoveControllerConfig(joints, **drives, control="viewpoint"),
            "pd_look_at": ArmMoveControllerConfig(joints, **drives, control="look_at"),
            "pd_joint_pos": PDJointPosControllerConfig(joints, None, None, normalize_action=False, **drives),
            "pd_joint_delta_pos": PDJointPosControllerConfig(
                joints, -JOINT_STEP, JOINT_STEP, use_delta=True, **drives
            ),
            "pd_ee_delta_pos": delta_pos,
            "pd_ee_delta_pose": delta_pose,
            "pd_ee_pose": pose,
        }

    @property
    def _sensor_configs(self) -> list[Any]:
        return [self._camera("d435", "color", d435.COLOR_FRAME_NAME)]

    def _camera(self, uid: str, stream: d435.Stream, frame: str) -> D435CameraConfig:
        pose: Any = sapien.Pose()
        return D435CameraConfig(
            uid=uid,
            pose=pose,
            width=160,
            height=120,
            near=d435.CAMERA_NEAR,
            far=d435.CAMERA_FAR,
            mount=self.robot.links_map[frame],
            stream=stream,
        )


@register_agent()
class Iiwa14D435RawDepth(Iiwa14D435):
    """The same robot whose depth comes from where the D435 measures it.

    Its sensors are `d435` as before, and `d435_depth` in the left infrared imager, 15 mm to the right of the
    colour camera, with the depth stream's wider field of view.
    """

    uid = "iiwa14_d435_raw_depth"

    @property
    def _sensor_configs(self) -> list[Any]:
        return [*super()._sensor_configs, self._camera("d435_depth", "depth", d435.DEPTH_FRAME_NAME)]
