"""Forward kinematics of the iiwa 14, joint angles to the poses of its links, and viewpoints to poses, batched.

One Warp kernel walks the chain in double precision, on the CPU and on CUDA; results come back in the
type of the input. The buffers and the recorded launch of each batch size are kept, so that a single
configuration costs about ten microseconds. Not for use from several threads at once, and the results
carry no gradient.
"""

from functools import lru_cache

import torch
import warp as wp

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.robot.iiwa14 import LINK_NAMES, NUM_JOINTS
from maniskill_tomato.robot.ik_chain import link_transforms_kernel, viewpoint_transform_kernel
from maniskill_tomato.warp_runtime import RecordedLaunch, start_warp

LARGEST_KEPT_BATCH = 4096
"""Buffers of larger batches are not kept between calls."""


class _LinkTransformsLaunch:
    """The kernel's launch for one batch size, with its tensors."""

    def __init__(self, batch: int, device: torch.device):
        start_warp()
        self.qpos = torch.zeros(batch, NUM_JOINTS, dtype=torch.float64, device=device)
        self.transforms = torch.zeros(batch, len(LINK_NAMES), 4, 4, dtype=torch.float64, device=device)
        arrays = [wp.from_torch(self.qpos), wp.from_torch(self.transforms, dtype=wp.mat44d)]
        self.run = RecordedLaunch(device, (link_transforms_kernel, batch, arrays))


class _ViewpointTransformLaunch:
    """The kernel's launch for one batch size, with its tensors."""

    def __init__(self, batch: int, device: torch.device):
        start_warp()
        self.viewpoints = torch.zeros(batch, 6, dtype=torch.float64, device=device)
        self.transforms = torch.zeros(batch, 4, 4, dtype=torch.float64, device=device)
        arrays = [wp.from_torch(self.viewpoints), wp.from_torch(self.transforms, dtype=wp.mat44d)]
        self.run = RecordedLaunch(device, (viewpoint_transform_kernel, batch, arrays))


_kept_viewpoint_transform_launch = lru_cache(maxsize=16)(_ViewpointTransformLaunch)
_kept_link_transforms_launch = lru_cache(maxsize=16)(_LinkTransformsLaunch)


def link_transforms(qpos: torch.Tensor) -> torch.Tensor:
    """Poses of all links in the base frame.

    Args:
        qpos: Joint angles, in [rad], of any floating-point type. Shape (B, 7).

    Returns:
        Transforms T_base_link in the order of `LINK_NAMES`, of the type of `qpos`. Shape (B, 9, 4, 4).

    Raises:
        InvalidInputError: `qpos` is not a floating-point tensor of shape (B, 7).
    """
    if qpos.dim() != 2 or qpos.shape[1] != NUM_JOINTS or not qpos.is_floating_point():
        raise InvalidInputError(
            f"qpos must be a floating-point tensor of shape (B, {NUM_JOINTS}); "
            f"got {qpos.dtype} of shape {tuple(qpos.shape)}"
        )
    batch = qpos.shape[0]
    if batch == 0:
        return qpos.new_zeros(0, len(LINK_NAMES), 4, 4)
    kept = batch <= LARGEST_KEPT_BATCH
    launch = (_kept_link_transforms_launch if kept else _LinkTransformsLaunch)(batch, qpos.device)
    launch.qpos.copy_(qpos.detach())
    launch.run()
    return launch.transforms.to(qpos.dtype, copy=kept)


def forward_kinematics(qpos: torch.Tensor) -> torch.Tensor:
    """Pose of the end effector `link_ee` in the base frame.

    Args:
        qpos: Joint angles, in [rad], of any floating-point type. Shape (..., 7).

    Returns:
        Transforms T_base_ee of the type of `qpos`. Shape (..., 4, 4).

    Raises:
        InvalidInputError: `qpos` is not a floating-point tensor of shape (..., 7).
    """
    if qpos.dim() == 0 or qpos.shape[-1] != NUM_JOINTS:
        raise InvalidInputError(
            f"qpos must be a floating-point tensor of shape (..., {NUM_JOINTS}); "
            f"got {qpos.dtype} of shape {tuple(qpos.shape)}"
        )
    return link_transforms(qpos.reshape(-1, NUM_JOINTS))[:, -1].reshape(*qpos.shape[:-1], 4, 4)


def viewpoint_transform(viewpoint: torch.Tensor) -> torch.Tensor:
    """The pose of a viewpoint, R = Rz(yaw) Ry(pitch) Rx(roll).

    Args:
        viewpoint: x, y, z, in [m], and roll, pitch, yaw, in [rad], of any floating-point type. Shape (B, 6).

    Returns:
        Homogeneous transforms in double precision. Shape (B, 4, 4), float64.

    Raises:
        InvalidInputError: `viewpoint` is not a floating-point tensor of shape (B, 6).
    """
    if viewpoint.dim() != 2 or viewpoint.shape[1] != 6 or not viewpoint.is_floating_point():
        raise InvalidInputError(
            "viewpoint must be a floating-point tensor of shape (B, 6); "
            f"got {viewpoint.dtype} of shape {tuple(viewpoint.shape)}"
        )
    batch = viewpoint.shape[0]
    if batch == 0:
        return viewpoint.new_zeros(0, 4, 4, dtype=torch.float64)
    kept = batch <= LARGEST_KEPT_BATCH
    launch = (_kept_viewpoint_transform_launch if kept else _ViewpointTransformLaunch)(
        batch, viewpoint.device
    )
    launch.viewpoints.copy_(viewpoint.detach())
    launch.run()
    return launch.transforms.clone() if kept else launch.transforms
