"""What a view tells about the surroundings of its target: a pattern of rays with labels and distances.

The rays cross the plane through the target's centre, perpendicular to the line from the camera to it, in a square
of +-0.28 m, most of them near the middle. Their order is row by row from the upper left, where right and up are those
of `robot.look_at.look_frame`: the pattern does not turn with the camera about its optical axis.

`ViewRayCaster` casts them at the meshes of a `VisibilityCaster`, `sample_view` reads them from a depth image and masks,
which is what a robot has. Neither knows more than a D435 could say: outside the image, nearer than its stereo
matching reaches, or where the robot stands in the way, a ray has no answer.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import torch
import warp as wp
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.raycast import view_ray_kernels
from maniskill_tomato.raycast.caster import VisibilityCaster
from maniskill_tomato.raycast.view_buffers import make_view
from maniskill_tomato.robot.d435 import (
    CAMERA_NEAR,
    CameraIntrinsics,
    depth_intrinsics,
    depth_noise_std,
)
from maniskill_tomato.robot.iiwa14 import LINK_NAMES
from maniskill_tomato.robot.look_at import look_frame

RAYS_PER_SIDE: Final = 16
"""The pattern has this number of rays squared."""

PATTERN_HALF_WIDTH: Final = 0.28
"""The pattern's square on the plane through the target reaches this far from its centre, in [m]."""

RANGE: Final = 1.5
"""What lies farther than this along a ray counts as nothing, in [m]."""

DEPTH_MODE: Final = depth_intrinsics(424, 240)
"""The D435's smallest depth mode, which measures nearest: leaves close to the camera matter more than fine detail."""

NEAREST_DEPTH: Final = 0.1
"""Depth below which that mode measures nothing, in [m]: 84 mm by `d435.min_depth`, and a sixth more, as the data sheet
has it in the other modes (195 mm for the formula's 168 at 848 x 480)."""

_FAR_AWAY = 1.0e6


class RayLabel(IntEnum):
    """What a ray met."""

    OUTSIDE = 0
    """No answer: outside the image, no valid depth, or the robot itself."""
    FREE = 1
    """Nothing within `RANGE`."""
    TARGET = 2
    """The target fruit."""
    OTHER = 3
    """A leaf, a stem or another fruit."""


@dataclass(frozen=True, eq=False)
class ViewRays:
    """The answers of B views along N rays each."""

    direction_c: Tensor
    """Unit directions in the optical frame. Shape (B, N, 3)."""
    distance: Tensor
    """Distance along the ray, in [m]: 0 where OUTSIDE, `RANGE` where FREE. Shape (B, N)."""
    label: Tensor
    """Values of `RayLabel`. Shape (B, N), int8."""


def ray_pattern() -> npt.NDArray[np.float32]:
    """Where the rays cross the plane through the target: to the right and up from its centre, in [m].

    With u evenly spaced in (-1, 1), a coordinate is 0.28 m times u / 4 + 3 u^3 / 4: near the middle neighbours are
    9 mm apart, so that a dozen rays meet a whole tomato, at the edge 69 mm.

    Returns:
        Row by row from the upper left. Shape (N, 2).
    """
    u = (np.arange(RAYS_PER_SIDE) + 0.5) / RAYS_PER_SIDE * 2.0 - 1.0
    coordinate = PATTERN_HALF_WIDTH * (0.25 * u + 0.75 * u**3)
    right, down = np.meshgrid(coordinate, coordinate)
    return np.stack([right.ravel(), -down.ravel()], axis=-1).astype(np.float32)


class ViewRayCaster:
    """Casts the pattern at the plants and links of a `VisibilityCaster`, for all its environments."""

    def __init__(self, caster: VisibilityCaster) -> None:
        """Shares the meshes of a caster, and follows its `replace_plant`.

        Args:
            caster: Whose environments are looked at.
        """
        self._caster = caster
        self._device = caster.device
        self._warp_device = str(wp.device_from_torch(str(caster.device)))
        b, n, device = caster.num_envs, RAYS_PER_SIDE**2, self._device
        self._pose_shape = torch.Size((b, 4, 4))
        self._links_shape = torch.Size((b, len(LINK_NAMES), 4, 4))
        self._camera_poses = torch.eye(4, device=device).repeat(b, 1, 1)
        self._plant_poses = torch.eye(4, device=device).repeat(b, 1, 1)
        self._links_away = torch.eye(4, device=device).repeat(b, len(LINK_NAMES), 1, 1)
        self._links_away[..., :3, 3] = _FAR_AWAY
        self._link_poses = self._links_away.clone()
        self._robot_present = False
        self._targets = torch.zeros(b, dtype=torch.int32, device=device)
        self._target_positions = torch.zeros(b, 3, device=device)
        self._directions = torch.zeros(b, n, 3, device=device)
        self._distances = torch.zeros(b, n, device=device)
        self._labels = torch.zeros(b, n, dtype=torch.int8, device=device)
        self._pattern = wp.array(ray_pattern(), dtype=wp.vec2, device=self._warp_device)
        self._limits: Any = view_ray_kernels.Limits()
        self._limits.nearest = NEAREST_DEPTH
        self._limits.farthest = RANGE
        self._launches: list[Callable[[Any], None]] = []
        self._record()

    def cast(
        self,
        T_world_camera: Tensor,
        target_fruit: Tensor,
        target_position: Tensor,
        T_world_plant: Tensor,
        link_transforms: Tensor | None = None,
    ) -> ViewRays:
        """Looks along the pattern.

        Args:
            T_world_camera: Poses of the optical frames, translation in [m]. Shape (B, 4, 4).
            target_fruit: Indices into the plants' `fruits`; all rays are OUTSIDE for one that does not exist.
                Shape (B,).
            target_position: Where the pattern is centred: the target's centre as it is known, in the world
                frame, in [m]. Shape (B, 3).
            T_world_plant: Poses of the plants. Shape (B, 4, 4).
            link_transforms: World poses of `iiwa14.LINK_NAMES`; None for no robot. Shape (B, 9, 4, 4).

        Raises:
            InvalidInputError: A tensor has the wrong shape.
        """
        wanted: list[tuple[str, Tensor, torch.Size]] = [
            ("T_world_camera", T_world_camera, self._pose_shape),
            ("target_fruit", target_fruit, self._targets.shape),
            ("target_position", target_position, self._target_positions.shape),
            ("T_world_plant", T_world_plant, self._pose_shape),
        ]
        if link_transforms is not None:
            wanted.append(("link_transforms", link_transforms, self._links_shape))
        for name, tensor, shape in wanted:
            if tensor.shape != shape:
                raise InvalidInputError(f"{name} must have shape {tuple(shape)}, got {tuple(tensor.shape)}")
        self._camera_poses.copy_(T_world_camera)
        self._plant_poses.copy_(T_world_plant)
        self._targets.copy_(target_fruit)
        self._target_positions.copy_(target_position)
        if link_transforms is not None:
            self._link_poses.copy_(link_transforms)
            self._robot_present = True
        elif self._robot_present:
            self._link_poses.copy_(self._links_away)
            self._robot_present = False
        if self._scene is not self._caster.scene:
            self._record()
        stream = None
        if self._device.type == "cuda":
            stream = wp.stream_from_torch(torch.cuda.current_stream(self._device))
        for launch in self._launches:
            launch(stream)
        return ViewRays(self._directions.clone(), self._distances.clone(), self._labels.clone())

    def _record(self) -> None:
        """Prepares the launches that read the caster's tables as they are now."""
        self._scene = self._caster.scene
        scene: Any = self._scene
        b = self._caster.num_envs
        view = make_view(b, int(scene.link_lows.shape[0]), self._warp_device)
        cameras = wp.from_torch(self._camera_poses, dtype=wp.mat44)
        calls: list[tuple[Any, Any, list[Any]]] = [
            (
                view_ray_kernels.prepare_rays,
                b,
                [
                    scene,
                    view,
                    cameras,
                    wp.from_torch(self._plant_poses, dtype=wp.mat44),
                    wp.from_torch(self._link_poses, dtype=wp.mat44),
                ],
            ),
            (
                view_ray_kernels.trace_view_rays,
                self._labels.shape,
                [
                    scene,
                    view,
                    self._caster.camera,
                    self._limits,
                    self._pattern,
                    cameras,
                    wp.from_torch(self._target_positions, dtype=wp.vec3),
                    wp.from_torch(self._targets),
                    wp.from_torch(self._directions, dtype=wp.vec3),
                    wp.from_torch(self._distances),
                    wp.from_torch(self._labels),
                ],
            ),
        ]
        commands: list[Any] = [
            wp.launch(
                kernel,
                dim=tuple(dim) if not isinstance(dim, int) else dim,
                inputs=inputs,
                device=self._warp_device,
                record_cmd=True,
            )
            for kernel, dim, inputs in calls
        ]
        # A recorded launch keeps addresses, not arrays: what they point to must stay alive with it.
        self._launched_with = [inputs for _, _, inputs in calls]
        self._launches = [command.launch for command in commands]
        if self._device.type == "cuda":
            # What was made just now was made in Warp's stream, and the casts run in torch's.
            wp.synchronize_device(self._warp_device)


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
