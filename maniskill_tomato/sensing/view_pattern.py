"""The pattern of rays as a sensor gives it: read from a depth image and masks, and with its errors."""

import numpy.typing as npt
import torch
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.raycast.view_rays import (
    DEPTH_MODE,
    NEAREST_DEPTH,
    RANGE,
    RayLabel,
    ViewRays,
    ray_pattern,
)
from maniskill_tomato.robot.d435 import CAMERA_NEAR, CameraIntrinsics, depth_noise_std
from maniskill_tomato.robot.look_at import look_frame


def sample_view(
    depth: npt.ArrayLike | Tensor,
    target_mask: npt.ArrayLike | Tensor,
    intrinsics: CameraIntrinsics,
    T_world_camera: Tensor,
    target_position: Tensor,
    robot_mask: npt.ArrayLike | Tensor | None = None,
) -> ViewRays:
    """Reads the pattern from a depth image and masks.

    Each ray takes the pixel that it goes through.

    Args:
        depth: Depth along the optical axis, in [m]; 0 or not finite where there is none. Shape (H, W).
        target_mask: Where the target is seen. Shape (H, W), bool.
        intrinsics: The camera of the images; its size must be theirs.
        T_world_camera: Pose of its optical frame, translation in [m]. Shape (4, 4).
        target_position: The target's centre as it is known, in the world frame, in [m]. Shape (3,).
        robot_mask: Where the robot is seen, if it can be. Shape (H, W), bool.

    Returns:
        One view (B = 1), on the device of `T_world_camera`.

    Raises:
        InvalidInputError: A shape does not fit.
    """
    device = T_world_camera.device
    size = (intrinsics.height, intrinsics.width)
    images = {"depth": torch.as_tensor(depth, dtype=torch.float32, device=device)}
    images["target_mask"] = torch.as_tensor(target_mask, dtype=torch.bool, device=device)
    if robot_mask is not None:
        images["robot_mask"] = torch.as_tensor(robot_mask, dtype=torch.bool, device=device)
    for name, image in images.items():
        if tuple(image.shape) != size:
            raise InvalidInputError(
                f"{name} must have the camera's shape {size} (height, width), got {tuple(image.shape)}"
            )
    for name, tensor, shape in (
        ("T_world_camera", T_world_camera, (4, 4)),
        ("target_position", target_position, (3,)),
    ):
        if tuple(tensor.shape) != shape:
            raise InvalidInputError(f"{name} must have shape {shape}, got {tuple(tensor.shape)}")

    T_world_camera, target = T_world_camera.double(), target_position.to(device).double()
    position = T_world_camera[:3, 3]
    pattern = torch.as_tensor(ray_pattern(), dtype=torch.float64, device=device)
    across = look_frame(position, target)[:, :2]
    towards = target + pattern @ across.T - position
    direction_c = (towards / towards.norm(dim=-1, keepdim=True)) @ T_world_camera[:3, :3]
    z = direction_c[:, 2]
    ahead = z > 0.0
    safe = torch.where(ahead, z, 1.0)
    u = torch.floor(intrinsics.fx * direction_c[:, 0] / safe + intrinsics.cx)
    v = torch.floor(intrinsics.fy * direction_c[:, 1] / safe + intrinsics.cy)
    inside = ahead & (u >= 0) & (u < intrinsics.width) & (v >= 0) & (v < intrinsics.height)
    column = torch.where(inside, u, 0.0).long()
    row = torch.where(inside, v, 0.0).long()

    measured = images["depth"][row, column].double()
    valid = inside & measured.isfinite() & (measured >= NEAREST_DEPTH)
    if robot_mask is not None:
        valid &= ~images["robot_mask"][row, column]
    distance = torch.where(valid, measured / safe, 0.0)
    hit = torch.where(images["target_mask"][row, column], int(RayLabel.TARGET), int(RayLabel.OTHER))
    label = torch.where(distance < RANGE, hit, int(RayLabel.FREE))
    label = torch.where(valid, label, int(RayLabel.OUTSIDE))
    return ViewRays(
        direction_c.float()[None], distance.clamp_max(RANGE).float()[None], label.to(torch.int8)[None]
    )


def disturb(
    rays: ViewRays,
    generator: torch.Generator,
    depth_noise: float = 1.0,
    dropout: float = 0.0,
    false_target: float = 0.0,
    missed_target: float = 0.0,
) -> ViewRays:
    """Rays as a noisy sensor and a wrong segmenter give them; each ray errs on its own.

    Args:
        rays: What is there.
        generator: On the device of the rays.
        depth_noise: Standard deviation of depths in multiples of the D435's (`depth_noise_std` of `DEPTH_MODE`).
        dropout: Share of the rays that lose their answer.
        false_target: Share of the OTHER rays that become TARGET.
        missed_target: Share of the TARGET rays that become OTHER.

    Raises:
        InvalidInputError: A share is outside [0, 1] or the noise is negative.
    """
    shares = {"dropout": dropout, "false_target": false_target, "missed_target": missed_target}
    for name, share in shares.items():
        if not 0.0 <= share <= 1.0:
            raise InvalidInputError(f"{name} must lie in [0, 1], got {share}")
    if not 0.0 <= depth_noise < float("inf"):
        raise InvalidInputError(f"depth_noise must be a number from 0 up, got {depth_noise}")

    def chance(share: float) -> Tensor:
        drawn = torch.rand(rays.label.shape, generator=generator, device=rays.label.device)
        return drawn < share

    is_target, is_other = rays.label == RayLabel.TARGET, rays.label == RayLabel.OTHER
    # The noise grows with the square of the depth, so that one number says all.
    at_one_metre = depth_noise * float(depth_noise_std(1.0, DEPTH_MODE))
    z = rays.direction_c[..., 2]
    normal = torch.randn(rays.distance.shape, generator=generator, device=rays.distance.device)
    noisy = rays.distance + at_one_metre * rays.distance.square() * z * normal
    distance = torch.where(is_target | is_other, noisy.clamp(CAMERA_NEAR, RANGE), rays.distance)
    label = torch.where(is_other & chance(false_target), int(RayLabel.TARGET), rays.label)
    label = torch.where(is_target & chance(missed_target), int(RayLabel.OTHER), label)
    lost = chance(dropout)
    label = torch.where(lost, int(RayLabel.OUTSIDE), label)
    return ViewRays(rays.direction_c, torch.where(lost, 0.0, distance), label.to(torch.int8))
