"""The arm and the camera of a profile for programs with a loop of their own: moves that end, and pictures since then.

Every move goes through `GuardedArm`, with what the camera has seen of the plant.
"""

import math
from typing import Final

import numpy as np
import torch

from maniskill_tomato.deploy.capture import Capture
from maniskill_tomato.deploy.deploy_errors import RefusedError
from maniskill_tomato.deploy.interface import Float64, Frame, JointMove
from maniskill_tomato.deploy.plant_points import PlantPoints
from maniskill_tomato.deploy.workcell import Workcell
from maniskill_tomato.robot.kinematics import forward_kinematics

SETTLE_S: Final = 0.5
"""Between the end of a move and a picture, in [s]."""

WAIT_SLICE: Final = 0.2
"""While the arm moves it is looked at this often, in [s]."""

STANDS: Final = 1e-4
"""An arm that is so near to where it is sent stays, in [rad]."""


class ArmSession:
    """Moves block until the arm stands, and a picture is one that was taken since."""

    def __init__(self, workcell: Workcell, may_move: bool = True) -> None:
        """Touches nothing; `connect` does.

        Args:
            workcell: Devices, calibration and safety.
            may_move: Whether a real arm may move at all; a simulated one always may.
        """
        self.workcell = workcell
        self._may_move = may_move or workcell.simulated
        self._points = PlantPoints(workcell.profile.T_flange_camera, model=workcell.arm.model)
        self._capture = Capture(workcell.camera, workcell.profile.capture, workcell.clock)
        self._settled_at = -math.inf
        self._frame: Frame | None = None
        self._frame_joints: Float64 | None = None

    @property
    def is_connected(self) -> bool:
        """Whether arm and camera can be used."""
        return self.workcell.arm.is_connected and self.workcell.camera.is_connected

    def connect(self) -> None:
        """Connects arm and camera; neither stays connected if one cannot be.

        Raises:
            DeployError: A device is not there.
        """
        try:
            self.workcell.arm.connect()
            self.workcell.camera.connect()
        except BaseException:
            self.disconnect()
            raise
        self.workcell.guarded_arm.begin_run(lambda: None)
        self._settled_at = self.workcell.clock.now()

    def disconnect(self) -> None:
        """Disconnects both; a move under way is stopped as far as the arm can be. Never raises."""
        if self.workcell.guarded_arm.is_under_way:
            self.workcell.guarded_arm.stop()
        self.workcell.camera.disconnect()
        self.workcell.arm.disconnect()

    def joint_positions(self) -> Float64:
        """As measured now, in [rad]. Shape (7,).

        Raises:
            DeployError: The arm gives none that could be true.
        """
        return self.workcell.guarded_arm.read().joint_positions

    def go_to(self, joint_positions: Float64) -> Float64:
        """Moves there, at the speed of the profile, and returns when the arm stands.

        Args:
            joint_positions: Where to, in [rad]. Shape (7,).

        Returns:
            What was really sent, or where the arm is if it was there already, in [rad]. Shape (7,).

        Raises:
            RefusedError: `safety` speaks against it, or the arm may not move; it has not moved.
            StoppedError: An earlier move was broken off; `connect` begins anew.
            DeployError: A device fails; the arm was told to stop.
        """
        arm = self.workcell.guarded_arm
        here = arm.read().joint_positions
        # NaN goes on to safety, which refuses it.
        if np.abs(joint_positions - here).max() <= STANDS:
            return here
        if not self._may_move:
            raise RefusedError("a real arm moves only for programs that say so; this one only looks")
        move = JointMove(joint_positions=joint_positions, speed_fraction=arm.safety.config.speed_fraction)
        sent = arm.command(move, None if self._frame is None else self._frame.stamp, self._points.points_w)
        self._frame = self._frame_joints = None
        try:
            while not arm.wait(WAIT_SLICE):
                pass
        except BaseException:
            arm.stop()
            raise
        self.workcell.clock.sleep(SETTLE_S)
        self._settled_at = self.workcell.clock.now()
        return sent.joint_positions

    def look(self, again: bool = False) -> tuple[Frame, Float64]:
        """A picture taken since the arm stands, and its joint angles, in [rad].

        Args:
            again: Whether to take a new one although the arm has not moved since the last.

        Raises:
            DeployError: The camera gives none that can be used.
        """
        if again or self._frame is None or self._frame_joints is None:
            if self._frame is None:
                self.workcell.camera.begin_view()
            after = self._settled_at if self._frame is None else self._frame.stamp
            self._frame = self._capture.take(after)
            self._frame_joints = self.workcell.guarded_arm.read().joint_positions
            self._points.add(self._frame, self.camera_pose(self._frame_joints), self._frame_joints)
        return self._frame, self._frame_joints

    def camera_pose(self, joint_positions: Float64) -> Float64:
        """The colour camera's optical frame in the world at joint angles in [rad], by the calibration. Shape (4, 4)."""
        flange = forward_kinematics(
            torch.as_tensor(np.array(joint_positions)), self.workcell.arm.model
        ).numpy()
        return np.asarray(flange @ self.workcell.profile.T_flange_camera, np.float64)
