"""The robot: observations are joint angles and pictures, actions are joint angles, in [rad].

Every action goes through the guard of maniskill-tomato, whatever policy or teleoperator it comes from.
"""

import logging
from functools import cached_property
from typing import Any

import numpy as np
from lerobot.cameras import make_cameras_from_configs
from lerobot.robots import Robot
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

from lerobot_robot_kuka_iiwa.config_kuka_iiwa import KukaIiwaConfig
from maniskill_tomato.deploy.arm_session import ArmSession
from maniskill_tomato.deploy.deploy_errors import ProfileError, RefusedError
from maniskill_tomato.deploy.depth_units import in_millimetres
from maniskill_tomato.deploy.profile import load_profile
from maniskill_tomato.deploy.workcell import make_workcell
from maniskill_tomato.errors import InvalidInputError

WRIST = "wrist"
"""Key of the profile's camera, as in data sets of `maniskill-tomato convert`."""

logger = logging.getLogger(__name__)


class KukaIiwa(Robot):
    """A seven-joint arm and the camera on its flange, as a profile describes them.

    `send_action` returns when the arm stands: the arm takes one move at a time, and a picture from a moving camera is
    of no use. A loop therefore runs at the arm's pace, not at a rate.
    """

    config_class = KukaIiwaConfig
    name = "kuka_iiwa"

    def __init__(self, config: KukaIiwaConfig) -> None:
        """Reads the profile; no device is touched.

        Raises:
            ProfileError: It cannot be used.
        """
        super().__init__(config)
        self.config = config
        self._session = ArmSession(
            make_workcell(load_profile(config.profile), config.seed), may_move=config.allow_motion
        )
        workcell = self._session.workcell
        self._keys = tuple(f"{name}.pos" for name in workcell.arm.model.joint_names)
        self._size = workcell.camera.announced_size or (config.width, config.height)
        if None in self._size:
            raise ProfileError(
                "this camera's driver does not tell the size of its pictures; give --robot.width and --robot.height"
            )
        self.cameras = make_cameras_from_configs(config.cameras)

    @property
    def _joint_features(self) -> dict[str, type]:
        return dict.fromkeys(self._keys, float)

    @cached_property
    def observation_features(self) -> dict[str, Any]:
        """Joint angles, the wrist's pictures, and those of further cameras."""
        width, height = self._size
        features: dict[str, Any] = {**self._joint_features, WRIST: (height, width, 3)}
        if self.config.use_depth:
            features[f"{WRIST}_depth"] = (height, width, 1)
        for name, camera in self.config.cameras.items():
            features[name] = (camera.height, camera.width, 3)
        return features

    @cached_property
    def action_features(self) -> dict[str, type]:
        """Joint angles to go to."""
        return self._joint_features

    @property
    def is_connected(self) -> bool:
        """Whether arm and all cameras are."""
        return self._session.is_connected and all(camera.is_connected for camera in self.cameras.values())

    def connect(self, calibrate: bool = True) -> None:
        """Connects arm and cameras; nothing moves.

        Raises:
            DeviceAlreadyConnectedError: It is connected.
            DeployError: A device is not there, or the camera's pictures have another size than told.
        """
        if self.is_connected:
            raise DeviceAlreadyConnectedError(f"{self} is connected already")
        try:
            self._session.connect()
            found = self._session.workcell.camera.intrinsics
            if (found.width, found.height) != self._size:
                raise ProfileError(
                    f"the wrist camera's pictures have {found.width} x {found.height} px, told were "
                    f"{self._size[0]} x {self._size[1]}"
                )
            for camera in self.cameras.values():
                camera.connect()
        except BaseException:
            self._release()
            raise
        for problem in self._session.workcell.calibration_problems():
            logger.warning("the arm will not move: %s", problem)

    @property
    def is_calibrated(self) -> bool:
        """Always: the camera's calibration is the profile's, and the guard asks for it before a real arm moves."""
        return True

    def calibrate(self) -> None:
        """Nothing: `maniskill-tomato deploy calibrate` does that."""

    def configure(self) -> None:
        """Nothing: the profile says it all."""

    def get_observation(self) -> dict[str, Any]:
        """A new picture, and the joint angles with it, in [rad].

        Raises:
            DeviceNotConnectedError: It is not connected.
            DeployError: A device gives nothing that can be used.
        """
        self._check()
        frame, joints = self._session.look(again=True)
        observation: dict[str, Any] = dict(zip(self._keys, map(float, joints), strict=True))
        observation[WRIST] = frame.color.copy()
        if self.config.use_depth:
            observation[f"{WRIST}_depth"] = in_millimetres(frame.depth)[0][..., None]
        for name, camera in self.cameras.items():
            observation[name] = camera.read_latest()
        return observation

    def send_action(self, action: dict[str, Any]) -> dict[str, float]:
        """Moves there, and returns when the arm stands.

        Args:
            action: A number for every key of `action_features`, in [rad].

        Returns:
            What was really sent.

        Raises:
            DeviceNotConnectedError: It is not connected.
            InvalidInputError: A joint is missing or unknown, or something is no number.
            RefusedError: The guard refuses the move, and `on_refusal` is `raise`; the arm has not moved.
            DeployError: A device fails.
        """
        self._check()
        joints = self._joints(action)
        try:
            sent = self._session.go_to(joints)
        except RefusedError as error:
            if self.config.on_refusal == "raise":
                raise
            logger.warning("the arm stays: %s", error)
            sent = self._session.joint_positions()
        return dict(zip(self._keys, map(float, sent), strict=True))

    def disconnect(self) -> None:
        """Lets arm and cameras go; a move under way is stopped as far as the arm can be.

        Raises:
            DeviceNotConnectedError: It is not connected.
        """
        self._check()
        self._release()

    def _release(self) -> None:
        self._session.disconnect()
        for camera in self.cameras.values():
            if camera.is_connected:
                camera.disconnect()

    def _check(self) -> None:
        if not self.is_connected:
            raise DeviceNotConnectedError(f"{self} is not connected; call connect() first")

    def _joints(self, action: dict[str, Any]) -> np.ndarray:
        if set(action) != set(self._keys):
            missing = [key for key in self._keys if key not in action]
            unknown = [key for key in action if key not in self._keys]
            raise InvalidInputError(
                f"an action must hold {', '.join(self._keys)} in [rad] and nothing else; missing: {missing}, "
                f"unknown: {unknown}"
            )
        try:
            joints = np.array([float(action[key]) for key in self._keys])
        except (TypeError, ValueError) as error:
            raise InvalidInputError(f"an action must hold numbers: {error}") from error
        return joints
