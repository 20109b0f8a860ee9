"""Forward kinematics of an arm, joint angles to the poses of its links, and viewpoints to poses, batched.

One Warp kernel walks the chain in double precision, on the CPU and on CUDA; results come back in the
type of the input. Not for use from several threads at once, and the results carry no gradient.
"""

from functools import cache

import torch
import warp as wp

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.robot.arm_model import NUM_JOINTS, ArmModel
from maniskill_tomato.robot.iiwa14 import IIWA14
from maniskill_tomato.robot.ik_chain import chain_of, link_transforms_kernel, viewpoint_transform_kernel
from maniskill_tomato.robot.rotations import require_trailing
from maniskill_tomato.warp_runtime import BatchKernel

_viewpoint_transform = BatchKernel(
    viewpoint_transform_kernel,
    inputs=[((6,), torch.float64, wp.float64)],
    constants=[],
    outputs=[((4, 4), torch.float64, wp.mat44d)],
)


@cache
def _link_transforms(model: ArmModel) -> BatchKernel:
    return BatchKernel(
        link_transforms_kernel,
        inputs=[((NUM_JOINTS,), torch.float64, wp.float64)],
        constants=[chain_of(model)],
        outputs=[((len(model.link_names), 4, 4), torch.float64, wp.mat44d)],
    )


def link_transforms(qpos: torch.Tensor, model: ArmModel = IIWA14) -> torch.Tensor:
    """Poses of all links in the base frame.

    Args:
        qpos: Joint angles, in [rad], of any floating-point type. Shape (B, 7).
        model: Of the arm.

    Returns:
        Transforms T_base_link in the order of its `link_names`, of the type of `qpos`. Shape (B, 9, 4, 4).

    Raises:
        InvalidInputError: `qpos` is not a floating-point tensor of shape (B, 7).
    """
    _require_rows("qpos", qpos, NUM_JOINTS)
    if not len(qpos):
        return qpos.new_zeros(0, len(model.link_names), 4, 4)
    poses = _link_transforms(model)(qpos)[0]
    if model.link_turns is not None:
        poses = poses.clone()
        poses[..., :3, :3] = poses[..., :3, :3] @ torch.tensor(model.link_turns, device=poses.device)
    return poses.to(qpos.dtype, copy=True)


def forward_kinematics(qpos: torch.Tensor, model: ArmModel = IIWA14) -> torch.Tensor:
    """Pose of the end effector, the model's flange link, in the base frame.

    Args:
        qpos: Joint angles, in [rad], of any floating-point type. Shape (..., 7).
        model: Of the arm.

    Returns:
        Transforms T_base_ee of the type of `qpos`. Shape (..., 4, 4).

    Raises:
        InvalidInputError: `qpos` is not a floating-point tensor of shape (..., 7).
    """
    require_trailing("qpos", qpos, (NUM_JOINTS,))
    return link_transforms(qpos.reshape(-1, NUM_JOINTS), model)[:, -1].reshape(*qpos.shape[:-1], 4, 4)


def viewpoint_transform(viewpoint: torch.Tensor) -> torch.Tensor:
    """The pose of a viewpoint, R = Rz(yaw) Ry(pitch) Rx(roll).

    Args:
        viewpoint: x, y, z, in [m], and roll, pitch, yaw, in [rad], of any floating-point type. Shape (B, 6).

    Returns:
        Homogeneous transforms in double precision. Shape (B, 4, 4), float64.

    Raises:
        InvalidInputError: `viewpoint` is not a floating-point tensor of shape (B, 6).
    """
    _require_rows("viewpoint", viewpoint, 6)
    if not len(viewpoint):
        return viewpoint.new_zeros(0, 4, 4, dtype=torch.float64)
    return _viewpoint_transform(viewpoint)[0].clone()


def _require_rows(name: str, tensor: torch.Tensor, width: int) -> None:
    if tensor.dim() != 2 or tensor.shape[1] != width or not tensor.is_floating_point():
        raise InvalidInputError(
            f"{name} must be a floating-point tensor of shape (B, {width}); "
            f"got {tensor.dtype} of shape {tuple(tensor.shape)}"
        )
