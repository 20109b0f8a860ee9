"""Checks that the controller and our kinematics agree about the flange's pose."""

import math

import numpy as np
import torch

from maniskill_tomato.deploy.deploy_errors import FaultError
from maniskill_tomato.deploy.interface import Float64
from maniskill_tomato.deploy.sunrise.sunrise_config import SunriseConfig
from maniskill_tomato.robot.kinematics import forward_kinematics
from maniskill_tomato.robot.rotations import rotation_angle_between, rpy_to_matrix


def pose_difference(told: Float64, joint_positions: Float64, config: SunriseConfig) -> tuple[float, float]:
    """How far the controller's tool, or flange, is from ours.

    Args:
        told: What the controller says: x, y, z, in [m], A, B, C, in [rad], base frame. Shape (6,).
        joint_positions: At the same time, in [rad]. Shape (7,).
        config: Flange, tool and tolerances.

    Returns:
        In [m] and [rad].

    Raises:
        FaultError: Farther than the tolerances.
    """
    qpos = torch.from_numpy(np.array(joint_positions))
    expected = forward_kinematics(qpos) @ _transform(config.flange_xyz, config.flange_rpy)
    if config.tool_xyzabc is not None:
        x, y, z, a, b, c = config.tool_xyzabc
        expected = expected @ _transform((x, y, z), (c, b, a))
    actual = _transform((told[0], told[1], told[2]), (told[5], told[4], told[3]))
    distance = float(torch.linalg.vector_norm(expected[:3, 3] - actual[:3, 3]))
    angle = float(rotation_angle_between(expected[:3, :3], actual[:3, :3]))
    if distance <= config.pose_tolerance_m and angle <= config.pose_tolerance_rad:
        return distance, angle
    apart = [round(1000.0 * float(v), 1) for v in (torch.linalg.inv(expected) @ actual)[:3, 3]]
    raise FaultError(
        f"the controller's flange is {1000 * distance:.1f} mm and {math.degrees(angle):.2f} degrees from where our "
        f"kinematics put it (off by {apart} mm in its frame); set arm.flange_xyz and arm.flange_rpy to the mounted "
        "flange, and arm.tool_xyzabc to the tool"
    )


def _transform(xyz: tuple[float, float, float], rpy: tuple[float, float, float]) -> torch.Tensor:
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = rpy_to_matrix(torch.tensor(rpy, dtype=torch.float64))
    pose[:3, 3] = torch.tensor(xyz, dtype=torch.float64)
    return pose
