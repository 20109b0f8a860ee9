"""Where a camera looks at a target: its axes, its pose, and the flange's viewpoint that belongs to it.

The look frame has the axes right, up and forward of a camera that stands at a position, looks at a target and
holds its picture upright. Right, up, forward is left-handed, so its matrix changes coordinates but is no
rotation. The optical frame is right, down, forward (x, y, z). World is the robot's base frame, z up.
"""

import math
from functools import cache
from typing import Final

import torch
from torch import Tensor

from maniskill_tomato.robot.d435 import T_flange_camera_color_optical
from maniskill_tomato.robot.rotations import matrix_to_rpy, require_trailing

CAMERA_ROLLS: Final = tuple(
    math.radians(angle) for angle in (0, 30, -30, 60, -60, 90, -90, 120, -120, 150, -150, 180)
)
"""Turns of the camera about its optical axis in the order in which they are tried, in [rad]."""

_SMALLEST = 1.0e-6


def look_frame(position: Tensor, target: Tensor) -> Tensor:
    """The axes right, up and forward of an upright camera that looks at a target.

    Straight up or down, where every direction is level, right is -y, as for a camera that faces +x. A camera
    at the target itself faces +x.

    Args:
        position: Where the camera stands, in the world frame, in [m]. Shape (..., 3).
        target: What it looks at, in the world frame, in [m]; broadcast against `position`. Shape (..., 3).

    Returns:
        The axes as columns, in the world frame: a move (right, up, forward) times this is a translation in the
        world. Shape (..., 3, 3).

    Raises:
        InvalidInputError: A tensor is not floating point or its last dimension is not 3.
    """
    for name, tensor in (("position", position), ("target", target)):
        require_trailing(name, tensor, (3,))
    ahead = target - position
    distance = ahead.norm(dim=-1, keepdim=True)
    x_axis = ahead.new_tensor((1.0, 0.0, 0.0)).expand_as(ahead)
    forward = torch.where(distance > _SMALLEST, ahead / distance.clamp_min(_SMALLEST), x_axis)
    # forward x z_world, which is level.
    level = torch.stack([forward[..., 1], -forward[..., 0], torch.zeros_like(forward[..., 0])], dim=-1)
    length = level.norm(dim=-1, keepdim=True)
    minus_y = ahead.new_tensor((0.0, -1.0, 0.0)).expand_as(ahead)
    right = torch.where(length > _SMALLEST, level / length.clamp_min(_SMALLEST), minus_y)
    return torch.stack([right, torch.linalg.cross(right, forward), forward], dim=-1)


def look_at_pose(position: Tensor, target: Tensor, roll: Tensor | float = 0.0) -> Tensor:
    """The pose of a camera that looks at a target.

    Args:
        position: Where the optical frame stands, in the world frame, in [m]. Shape (..., 3).
        target: What its z axis points at, in the world frame, in [m]. Shape (..., 3).
        roll: Turn about the optical axis from the upright picture, from right towards down, in [rad].
            Shape (...).

    Returns:
        T_world_camera of the optical frame. Shape (..., 4, 4).

    Raises:
        InvalidInputError: A tensor is not floating point or its last dimension is not 3.
    """
    right, up, forward = look_frame(position, target).unbind(-1)
    turn = torch.as_tensor(roll, dtype=right.dtype, device=right.device)[..., None]
    cosine, sine = torch.cos(turn), torch.sin(turn)
    x = cosine * right - sine * up
    y = -sine * right - cosine * up
    upper = torch.stack([x, y, forward.expand_as(x), position.expand_as(x)], dim=-1)
    last = upper.new_tensor((0.0, 0.0, 0.0, 1.0)).expand(*upper.shape[:-2], 1, 4)
    return torch.cat([upper, last], dim=-2)


def camera_to_flange(T_world_camera: Tensor) -> Tensor:
    """The pose of `link_ee` that puts the colour camera's optical frame at a pose. Shape (..., 4, 4)."""
    require_trailing("T_world_camera", T_world_camera, (4, 4))
    inverse: Tensor = _mount(T_world_camera.dtype, T_world_camera.device)[1]
    return _product(T_world_camera, inverse)


def flange_to_camera(T_world_flange: Tensor) -> Tensor:
    """The pose of the colour camera's optical frame when `link_ee` is at a pose. Shape (..., 4, 4)."""
    require_trailing("T_world_flange", T_world_flange, (4, 4))
    mount: Tensor = _mount(T_world_flange.dtype, T_world_flange.device)[0]
    return _product(T_world_flange, mount)


def carried_pose(T_world_flange: Tensor, T_flange_camera: Tensor) -> Tensor:
    """The pose of a camera that the flange carries, multiplied in double precision.

    Args:
        T_world_flange: Of any floating-point type. Shape (..., 4, 4).
        T_flange_camera: Where it is mounted, in double precision. Shape (4, 4).

    Returns:
        Of the type of `T_world_flange`. Shape (..., 4, 4).
    """
    return _product(T_world_flange.double(), T_flange_camera).to(T_world_flange.dtype)


def _product(first: Tensor, second: Tensor) -> Tensor:
    """Products of 4 x 4 matrices that round in a batch as they do alone, which those of `torch.matmul` do not.

    The last digit matters: the inverse kinematics seeks the lowest place of a flat valley, and finds another one.
    """
    columns = [first[..., k, None] * second[..., k, None, :] for k in range(4)]
    return (columns[0] + columns[1]) + (columns[2] + columns[3])


def camera_to_viewpoint(T_world_camera: Tensor, reference_rpy: Tensor) -> Tensor:
    """The viewpoint (of the flange) that puts the colour camera's optical frame at a pose.

    Args:
        T_world_camera: Poses of the optical frame. Shape (B, 4, 4).
        reference_rpy: Roll, pitch, yaw to be near to, in [rad], as in `matrix_to_rpy`. Shape (B, 3).

    Returns:
        x, y, z, in [m], roll, pitch, yaw, in [rad]. Shape (B, 6).
    """
    T_world_flange = camera_to_flange(T_world_camera)
    rpy = matrix_to_rpy(T_world_flange[..., :3, :3], reference_rpy)
    return torch.cat([T_world_flange[..., :3, 3], rpy], dim=-1)


@cache
def _mount(dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """T_flange_camera of the colour camera's optical frame, and its inverse."""
    mount = torch.tensor(T_flange_camera_color_optical, dtype=torch.float64)
    return mount.to(device, dtype), torch.linalg.inv(mount).to(device, dtype)
