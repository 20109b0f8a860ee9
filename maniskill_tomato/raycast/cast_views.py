"""The visible fraction from many viewpoints of one plant at once, for planners that may know the truth."""

from typing import Any

import numpy as np
import torch
import warp as wp
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.raycast import kernels
from maniskill_tomato.raycast.caster import VisibilityCaster
from maniskill_tomato.raycast.lattice import ray_lattice
from maniskill_tomato.raycast.view_buffers import make_view
from maniskill_tomato.robot.iiwa14 import LINK_NAMES

_FAR_AWAY = 1.0e6


class CastViews:
    """Casts the rays of a `VisibilityCaster` from K cameras at one fruit of one of its plants."""

    def __init__(self, caster: VisibilityCaster, rays_per_side: int = 16, at_once: int = 512) -> None:
        """Shares the meshes of a caster, and follows its `replace_plant`.

        Args:
            caster: Whose plants are looked at.
            rays_per_side: As for `VisibilityCaster`.
            at_once: More views than this are cast in several parts.
        """
        if rays_per_side < 2:
            raise InvalidInputError(f"rays_per_side must be at least 2, got {rays_per_side}")
        if at_once < 1:
            raise InvalidInputError(f"at_once must be at least 1, got {at_once}")
        self._caster = caster
        self._device = caster.device
        self._warp_device = str(wp.device_from_torch(str(caster.device)))
        self._rays = rays_per_side**2
        self._at_once = at_once
        pattern = np.ascontiguousarray(ray_lattice(rays_per_side))
        self._pattern = wp.array(pattern, dtype=wp.vec2, device=self._warp_device)
        self._camera_poses = torch.eye(4, device=self._device).repeat(at_once, 1, 1)
        self._plant_poses = torch.eye(4, device=self._device).repeat(at_once, 1, 1)
        self._links_away = torch.eye(4, device=self._device).repeat(at_once, len(LINK_NAMES), 1, 1)
        self._links_away[..., :3, 3] = _FAR_AWAY
        self._link_poses = self._links_away.clone()
        self._targets = torch.zeros(at_once, dtype=torch.int32, device=self._device)
        self._results = torch.zeros((kernels.RESULTS, at_once), device=self._device)
        self._recorded_scene: Any = None
        self._commands: list[tuple[Any, bool]] = []

    def visible_fraction(
        self,
        T_world_camera: Tensor,
        target_fruit: int,
        T_world_plant: Tensor,
        link_transforms: Tensor | None = None,
        env_index: int = 0,
    ) -> Tensor:
        """V_f of one fruit from K viewpoints, the same numbers that `VisibilityCaster.cast` gives one by one.

        Args:
            T_world_camera: Poses of the optical frames, translation in [m]. Shape (K, 4, 4).
            target_fruit: Index into the plant's `fruits`.
            T_world_plant: Pose of the plant. Shape (4, 4).
            link_transforms: World poses of `iiwa14.LINK_NAMES` for each viewpoint; None for no robot.
                Shape (K, 9, 4, 4).
            env_index: Which of the caster's environments shows the plant.

        Returns:
            V_f in [0, 1]. Shape (K,).

        Raises:
            InvalidInputError: A shape does not fit, or the fruit or the environment does not exist.
        """
        count = T_world_camera.shape[0] if T_world_camera.dim() == 3 else 0
        for name, tensor, shape in (
            ("T_world_camera", T_world_camera, (count, 4, 4)),
            ("T_world_plant", T_world_plant, (4, 4)),
            ("link_transforms", link_transforms, (count, len(LINK_NAMES), 4, 4)),
        ):
            if tensor is not None and tuple(tensor.shape) != shape:
                raise InvalidInputError(f"{name} must have shape {shape}, got {tuple(tensor.shape)}")
        if not 0 <= env_index < self._caster.num_envs:
            raise InvalidInputError(
                f"env_index must be from 0 to {self._caster.num_envs - 1}, got {env_index}"
            )
        fruits = len(self._caster.plant(env_index).fruits)
        if not 0 <= target_fruit < fruits:
            raise InvalidInputError(f"target_fruit must be from 0 to {fruits - 1}, got {target_fruit}")

        if self._recorded_scene is not self._caster.scene:
            self._record()
        self._look_at(env_index)
        self._targets.fill_(target_fruit)
        self._plant_poses.copy_(T_world_plant)
        answers = torch.empty(count, device=self._device)
        for first in range(0, count, self._at_once):
            part = min(self._at_once, count - first)
            self._camera_poses[:part] = T_world_camera[first : first + part]
            if link_transforms is None:
                self._link_poses.copy_(self._links_away)
            else:
                self._link_poses[:part] = link_transforms[first : first + part]
            self._launch(part)
            answers[first : first + part] = self._results[0, :part]
        return answers

    def _look_at(self, env_index: int) -> None:
        """Points every row of the tables at the plant of one environment."""
        for own, source in self._tables:
            own.copy_(source[env_index : env_index + 1].expand_as(own))

    def _launch(self, count: int) -> None:
        stream = None
        if self._device.type == "cuda":
            stream = wp.stream_from_torch(torch.cuda.current_stream(self._device))
        for command, per_ray in self._commands:
            command.set_dim((count, self._rays) if per_ray else count)
            command.launch(stream)

    def _record(self) -> None:
        shared: Any = self._caster.scene
        n = self._at_once
        scene: Any = kernels.Scene()
        self._tables: list[tuple[Tensor, Tensor]] = []
        for name in (
            "plant_meshes",
            "first_fruit_faces",
            "fruit_counts",
            "fruit_meshes",
            "fruit_spheres",
            "fruit_is_ripe",
        ):
            array = getattr(shared, name)
            source = wp.to_torch(array)
            if source.dtype == torch.uint64:
                source = source.view(torch.int64)
            own = torch.zeros((n, *source.shape[1:]), dtype=source.dtype, device=self._device)
            self._tables.append((own, source))
            setattr(scene, name, wp.from_torch(own, dtype=array.dtype))
        for name in ("link_meshes", "link_indices", "link_lows", "link_highs"):
            setattr(scene, name, getattr(shared, name))
        view = make_view(n, int(shared.link_lows.shape[0]), self._warp_device)
        targets = wp.from_torch(self._targets)
        poses = [
            wp.from_torch(tensor, dtype=wp.mat44)
            for tensor in (self._camera_poses, self._plant_poses, self._link_poses)
        ]
        camera = self._caster.camera
        calls: list[tuple[Any, bool, list[Any]]] = [
            (kernels.prepare, False, [scene, view, *poses, targets]),
            (kernels.trace_target, True, [scene, view, camera, self._pattern, targets]),
            (
                kernels.summarise,
                False,
                [scene, view, camera, float(self._rays), targets, wp.from_torch(self._results)],
            ),
        ]
        self._commands = [
            (
                wp.launch(
                    kernel,
                    dim=(n, self._rays) if per_ray else n,
                    inputs=inputs,
                    device=self._warp_device,
                    record_cmd=True,
                ),
                per_ray,
            )
            for kernel, per_ray, inputs in calls
        ]
        # A recorded launch keeps addresses, not arrays: what they point to must stay alive with it.
        self._launched_with = [inputs for _, _, inputs in calls]
        self._recorded_scene = shared
        if self._device.type == "cuda":
            # What was made just now was made in Warp's stream, and the casts run in torch's.
            wp.synchronize_device(self._warp_device)
