"""What a view tells about the surroundings of its target: a pattern of rays with labels and distances.

The rays cross the plane through the target's centre, perpendicular to the line from the camera to it, in a square
of +-0.28 m, most of them near the middle. Their order is row by row from the upper left, where right and up are those
of `robot.look_at.look_frame`: the pattern does not turn with the camera about its optical axis.

`RayScene.view_rays` casts them, `sensing.view_pattern.sample_view` reads them from a depth image and masks, which is
what a robot has. Neither knows more than a D435 could say: outside the image, nearer than its stereo
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
from maniskill_tomato.robot.d435 import depth_intrinsics
from maniskill_tomato.robot.iiwa14 import LINK_NAMES

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
