"""ManiSkill's `BaseRealAgent` over any arm and camera of a profile; every move goes through `GuardedArm` and ends."""

import math
from collections.abc import Sequence
from typing import Any, Final

import cv2
import numpy as np
import torch
from mani_skill.agents.base_real_agent import BaseRealAgent
from numpy.typing import NDArray
from torch import Tensor

from maniskill_tomato.deploy.arm_session import ArmSession
from maniskill_tomato.deploy.deploy_errors import NotConnectedError, RefusedError
from maniskill_tomato.deploy.interface import Float64, Frame
from maniskill_tomato.deploy.workcell import Workcell
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.robot.arm_model import NUM_JOINTS
from maniskill_tomato.robot.d435 import CameraIntrinsics

RESET_STEP: Final = 0.4
"""The most that a joint turns in one piece of a way back to a start, in [rad]."""

OPENGL_OPTICAL: Final = np.diag([1.0, -1.0, -1.0, 1.0])
"""From OpenGL's camera (y up, looking along -z) to the optical frame (y down, looking along +z)."""


class IiwaRealAgent(BaseRealAgent):  # type: ignore[misc]
    """A real iiwa with a D435, or their twin, where ManiSkill wants a robot.

    Moves block until the arm stands, because `Sim2RealEnv` observes right after its command. Pictures come in the size
    and field of view of the simulated camera, with the channel axis that ManiSkill has.
    """

    def __init__(self, workcell: Workcell, camera_name: str = "d435") -> None:
        """Touches nothing; `start` connects.

        Args:
            workcell: Devices, calibration and safety.
            camera_name: Of the simulated sensor that the camera stands for.
        """
        super().__init__()
        self.workcell = workcell
        self._camera_name = camera_name
        self._session = ArmSession(workcell)

    def start(self) -> None:
        """Connects arm and camera."""
        self._session.connect()

    def stop(self) -> None:
        """Disconnects both; a move under way is stopped as far as the arm can be."""
        self._session.disconnect()

    def set_target_qpos(self, qpos: Any) -> None:
        """Moves there and returns when the arm stands.

        Args:
            qpos: Joint angles, in [rad]. Shape (7,) or (1, 7).

        Raises:
            RefusedError: `safety` speaks against it; the arm has not moved.
            DeployError: A device fails.
        """
        self._session.go_to(_joints(qpos))

    def set_target_qvel(self, qvel: Any) -> None:
        """Not offered.

        Raises:
            RefusedError: Always: nothing stops a velocity when its sender fails.
        """
        raise RefusedError("this robot takes joint positions only; choose a control mode that sets positions")

    def reset(self, qpos: Any) -> None:
        """Moves there in small pieces on a straight line in joint space, each of them checked.

        Args:
            qpos: Joint angles, in [rad]. Shape (7,) or (1, 7).

        Raises:
            RefusedError: `safety` speaks against a piece; the arm stands at its beginning.
            DeployError: A device fails.
        """
        goal, start = _joints(qpos), self.workcell.guarded_arm.read().joint_positions
        pieces = max(1, math.ceil(float(np.abs(goal - start).max()) / RESET_STEP))
        for k in range(1, pieces + 1):
            self.set_target_qpos(start + (goal - start) * (k / pieces))

    def look(self) -> tuple[Frame, Float64]:
        """A picture taken since the arm stands, and its joint angles, in [rad]; the same until the arm moves.

        Raises:
            DeployError: The camera gives none that can be used.
        """
        return self._session.look()

    def capture_sensor_data(self, sensor_names: Sequence[str] | None = None) -> None:
        """Takes a picture, unless one was taken since the arm stands."""
        self._check_names(sensor_names)
        self.look()

    def get_sensor_data(self, sensor_names: Sequence[str] | None = None) -> dict[str, dict[str, Tensor]]:
        """The picture as the simulated camera would give it.

        Returns:
            `rgb`, uint8, shape (1, H, W, 3), and `depth` in [mm], int16, shape (1, H, W, 1).
        """
        self._check_names(sensor_names)
        frame, _ = self.look()
        wanted = self._simulated_intrinsics() or frame.intrinsics
        depth = depth_in_mm(fit_depth(frame, wanted))
        data = {
            "rgb": torch.from_numpy(fit_color(frame, wanted))[None],
            "depth": torch.from_numpy(depth)[None, ..., None],
        }
        return {self._camera_name: data}

    def get_sensor_params(self, sensor_names: Sequence[str] | None = None) -> dict[str, dict[str, Tensor]]:
        """Pose and intrinsics of the camera at the last picture.

        Returns:
            `extrinsic_cv`, shape (1, 3, 4), `cam2world_gl`, (1, 4, 4), `intrinsic_cv`, (1, 3, 3), float32.
        """
        self._check_names(sensor_names)
        frame, joints = self.look()
        wanted = self._simulated_intrinsics() or frame.intrinsics
        T_world_camera = self.camera_pose(joints)
        params = {
            "extrinsic_cv": np.linalg.inv(T_world_camera)[:3],
            "cam2world_gl": T_world_camera @ OPENGL_OPTICAL,
            "intrinsic_cv": wanted.matrix,
        }
        tensors = {name: torch.as_tensor(value, dtype=torch.float32)[None] for name, value in params.items()}
        return {self._camera_name: tensors}

    def camera_pose(self, joint_positions: Float64) -> Float64:
        """The colour camera's optical frame in the world at joint angles in [rad], by the calibration. Shape (4, 4)."""
        return self._session.camera_pose(joint_positions)

    def get_qpos(self) -> Tensor:
        """Measured joint angles, in [rad]. Shape (1, 7), float32."""
        state = self.workcell.guarded_arm.read()
        return torch.as_tensor(np.array(state.joint_positions), dtype=torch.float32)[None]

    def get_qvel(self) -> Tensor:
        """Measured joint speeds, in [rad/s]. Shape (1, 7), float32."""
        state = self.workcell.guarded_arm.read()
        return torch.as_tensor(np.array(state.joint_velocities), dtype=torch.float32)[None]

    def _simulated_intrinsics(self) -> CameraIntrinsics | None:
        """Of the simulated camera that this one stands for, once there is a simulation."""
        sim_agent: Any = self._sim_agent
        sensors = getattr(getattr(sim_agent, "scene", None), "sensors", {})
        if self._camera_name not in sensors:
            return None
        config = sensors[self._camera_name].config
        if config.intrinsic is None:
            return CameraIntrinsics.from_fov(width=config.width, height=config.height, fov_y=config.fov)
        K = np.asarray(config.intrinsic, dtype=np.float64).reshape(3, 3)
        return CameraIntrinsics(
            width=config.width, height=config.height, fx=K[0, 0], fy=K[1, 1], cx=K[0, 2], cy=K[1, 2]
        )

    def _check_names(self, names: Sequence[str] | None) -> None:
        others = [name for name in names or () if name != self._camera_name]
        if others:
            raise NotConnectedError(
                f"there is one camera, {self._camera_name}, but the simulation asks for {', '.join(others)}; use "
                "robot_uids='iiwa14_d435'"
            )


def _joints(qpos: Any) -> Float64:
    on_cpu = qpos.detach().cpu() if isinstance(qpos, Tensor) else qpos
    values = np.asarray(on_cpu, dtype=np.float64).reshape(-1)
    if values.shape != (NUM_JOINTS,):
        raise InvalidInputError(f"qpos must be {NUM_JOINTS} joint angles, got {values.size}")
    return values


def fit_color(frame: Frame, wanted: CameraIntrinsics) -> NDArray[np.uint8]:
    """The colour picture for other intrinsics, averaged where it shrinks; black outside the real picture.

    Args:
        frame: The real picture.
        wanted: Of the simulated camera.

    Returns:
        RGB. Shape (H, W, 3) of `wanted`.
    """
    have = frame.intrinsics
    if have == wanted:
        return frame.color.copy()
    # Sampled so finely that no pixel of the real picture is left out, then averaged.
    finer = max(1, math.ceil(max(have.fx / wanted.fx, have.fy / wanted.fy)))
    large = wanted.scaled(finer * wanted.width, finer * wanted.height)
    picture = _warped(frame.color, have, large, cv2.INTER_LINEAR)
    if finer > 1:
        picture = cv2.resize(picture, (wanted.width, wanted.height), interpolation=cv2.INTER_AREA)
    return np.asarray(picture, dtype=np.uint8)


def fit_depth(frame: Frame, wanted: CameraIntrinsics) -> NDArray[np.float32]:
    """The depth picture for other intrinsics by the nearest pixel; 0 outside the real picture.

    Args:
        frame: The real picture.
        wanted: Of the simulated camera.

    Returns:
        In [m]. Shape (H, W) of `wanted`.
    """
    return np.asarray(_warped(frame.depth, frame.intrinsics, wanted, cv2.INTER_NEAREST), dtype=np.float32)


def depth_in_mm(depth: NDArray[np.float32]) -> NDArray[np.int16]:
    """Depth in whole [mm] as ManiSkill has it; what is beyond 32.767 m counts as no depth. Any shape."""
    millimetres = np.rint(1000.0 * depth)
    return np.where(millimetres <= np.iinfo(np.int16).max, millimetres, 0.0).astype(np.int16)


def _warped(
    picture: NDArray[Any], have: CameraIntrinsics, wanted: CameraIntrinsics, interpolation: int
) -> NDArray[Any]:
    # Both cameras look along the same axis, so that columns and rows are stretched and shifted. OpenCV counts from the
    # centre of the first pixel.
    sx, sy = have.fx / wanted.fx, have.fy / wanted.fy
    matrix = np.array(
        [
            [sx, 0.0, have.cx - 0.5 - sx * (wanted.cx - 0.5)],
            [0.0, sy, have.cy - 0.5 - sy * (wanted.cy - 0.5)],
        ]
    )
    warped = cv2.warpAffine(
        picture, matrix, (wanted.width, wanted.height), flags=interpolation | cv2.WARP_INVERSE_MAP
    )
    result: NDArray[Any] = warped
    return result
