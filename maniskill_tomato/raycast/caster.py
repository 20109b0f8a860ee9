"""Visible fraction of a fruit by ray casting, batched over environments with different plants.

`VisibilityCaster` holds the triangles of the plants and of the robot; `cast` answers, for each environment,
which share V / T (Eq. 4-4 of the thesis) of a target fruit a camera sees:

    caster = VisibilityCaster(plants=plants, intrinsics=intrinsics, robot_meshes=link_meshes())
    seen = caster.cast(T_world_camera, target_fruit, T_world_plant, link_transforms(qpos))
    seen.visible_fraction, seen.any_visible
    caster.replace_plant(env_index, new_plant)

T is the area of the target's whole silhouette in the image plane with nothing in front, also outside the
image. V is the part of it inside the image that no leaf, stem, other fruit or robot link hides. The camera
looks along the z axis of its optical frame, x points right and y down. One ray stands for an equal part of
the rectangle around the silhouette, on a fixed lattice: the same scene gives the same answer.

The target counts as not visible (V = 0) where its bounding sphere lies behind the camera's near plane or
holds the camera. It has no silhouette then, and T is that of such a sphere straight ahead.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.plants.organs import Plant
from maniskill_tomato.raycast import kernels
from maniskill_tomato.raycast.lattice import ray_lattice
from maniskill_tomato.raycast.meshes import PlantMeshCache, PlantMeshes, build_mesh
from maniskill_tomato.raycast.view_buffers import make_view
from maniskill_tomato.raycast.visibility import Visibility
from maniskill_tomato.robot.d435 import CameraIntrinsics
from maniskill_tomato.robot.iiwa14 import LINK_NAMES
from maniskill_tomato.warp_runtime import start_warp

LinkMeshes = Mapping[str, tuple[NDArray[Any], NDArray[Any]]]
"""Vertices in the link frame, in [m], Shape (V, 3), and faces, Shape (F, 3), by link name."""

_COARSE_RAYS_PER_SIDE = 6
_FAR_AWAY = 1.0e6


class VisibilityCaster:
    """Casts rays at one target fruit per environment."""

    def __init__(
        self,
        *,
        plants: Sequence[Plant],
        intrinsics: CameraIntrinsics,
        robot_meshes: LinkMeshes | None = None,
        rays_per_side: int = 16,
        cached_plants: int = 64,
        device: str | torch.device = "cpu",
    ) -> None:
        """Builds the meshes.

        Args:
            plants: The plant of each environment; environments that show the same object share its meshes.
            intrinsics: The camera, the same in all environments.
            robot_meshes: Links that can hide the target, keyed by `iiwa14.LINK_NAMES`; None for no robot.
            rays_per_side: The silhouette's bounding rectangle gets the square of this number of rays.
            cached_plants: How many plants' meshes are kept for environments that show them again.
            device: Where the rays are cast and all tensors live: "cpu" or a CUDA device.

        Raises:
            InvalidInputError: No plants, a plant without fruits, an unknown link, or a number out of range.
        """
        if len(plants) == 0:
            raise InvalidInputError("plants must name the plant of at least one environment, got none")
        if rays_per_side < 2:
            raise InvalidInputError(f"rays_per_side must be at least 2, got {rays_per_side}")
        if cached_plants < 1:
            raise InvalidInputError(f"cached_plants must be at least 1, got {cached_plants}")
        start_warp()
        self._device = torch.device(device)
        self._warp_device = str(wp.device_from_torch(str(self._device)))
        self._is_cuda = self._device.type == "cuda"
        self._cache = PlantMeshCache(self._warp_device, cached_plants)
        self._shown = [self._cache.get(plant) for plant in plants]
        self._rays = rays_per_side**2
        self._pattern = self._array(ray_lattice(rays_per_side), wp.vec2)
        self._coarse_pattern = self._array(ray_lattice(_COARSE_RAYS_PER_SIDE), wp.vec2)
        self._camera = kernels.Camera()
        self._camera.left = -intrinsics.cx / intrinsics.fx
        self._camera.top = -intrinsics.cy / intrinsics.fy
        self._camera.right = (intrinsics.width - intrinsics.cx) / intrinsics.fx
        self._camera.bottom = (intrinsics.height - intrinsics.cy) / intrinsics.fy
        self._camera.square_pixels = intrinsics.fx * intrinsics.fy

        self._links = self._build_links(robot_meshes or {})
        self._allocate_inputs()
        self._launches: list[Callable[[Any], None]] = []
        self._record(max(len(meshes.fruits) for meshes in self._shown))

    @property
    def num_envs(self) -> int:
        """Number of environments B."""
        return len(self._shown)

    @property
    def device(self) -> torch.device:
        """Where the rays are cast."""
        return self._device

    @property
    def scene(self) -> Any:
        """The tables of plants and links (`kernels.Scene`), for other kernels over the same meshes.

        They follow `replace_plant`; a plant with more fruits than any before brings a new object.
        """
        return self._scene

    @property
    def camera(self) -> Any:
        """What the image covers (`kernels.Camera`)."""
        return self._camera

    def plant(self, env_index: int) -> Plant:
        """The plant that an environment shows."""
        return self._shown[env_index].plant

    def replace_plant(self, env_index: int, plant: Plant) -> None:
        """Shows another plant in one environment.

        Args:
            env_index: Which environment, from 0 to B - 1.
            plant: A plant object used lately is found again, a new one costs the time to sort its triangles.
        """
        if not 0 <= env_index < self.num_envs:
            raise InvalidInputError(f"env_index must be from 0 to {self.num_envs - 1}, got {env_index}")
        meshes = self._cache.get(plant)
        # A new mesh is built in Warp's stream, and an old one must outlive the casts still under way with it.
        self._finish_work()
        self._shown[env_index] = meshes
        if len(meshes.fruits) > self._fruit_meshes.shape[1]:
            self._record(len(meshes.fruits))
        else:
            self._write_row(env_index, meshes)

    def cast(
        self,
        T_world_camera: Tensor,
        target_fruit: Tensor,
        T_world_plant: Tensor,
        link_transforms: Tensor | None = None,
    ) -> Visibility:
        """Looks at the targets.

        Args:
            T_world_camera: Poses of the optical frames, translation in [m]. Shape (B, 4, 4).
            target_fruit: Indices into the plants' `fruits`; not checked on CUDA, where one that does not
                exist gives NaN. Shape (B,).
            T_world_plant: Poses of the plants. Shape (B, 4, 4).
            link_transforms: World poses of `iiwa14.LINK_NAMES`; None for no robot. Shape (B, 9, 4, 4).

        Raises:
            InvalidInputError: A tensor has the wrong shape or a target does not exist.
        """
        if (
            T_world_camera.shape != self._pose_shape
            or T_world_plant.shape != self._pose_shape
            or target_fruit.shape != self._target_shape
            or (link_transforms is not None and link_transforms.shape != self._links_shape)
        ):
            raise self._shape_error(T_world_camera, target_fruit, T_world_plant, link_transforms)
        self._camera_poses.copy_(T_world_camera)
        self._plant_poses.copy_(T_world_plant)
        self._targets.copy_(target_fruit)
        if link_transforms is not None:
            self._link_poses.copy_(link_transforms)
            self._robot_present = True
        elif self._robot_present:
            self._link_poses.copy_(self._links_away)
            self._robot_present = False
        if not self._is_cuda:
            self._check_targets()
            stream = None
        else:
            stream = wp.stream_from_torch(torch.cuda.current_stream(self._device))
        for launch in self._launches:
            launch(stream)
        return Visibility(self._results.clone())

    def _array(self, values: NDArray[Any], dtype: Any) -> Any:
        return wp.array(values, dtype=dtype, device=self._warp_device)

    def _build_links(self, robot_meshes: LinkMeshes) -> list[tuple[int, NDArray[np.float32], Any]]:
        """Index in `LINK_NAMES`, vertices and mesh of each link that has triangles."""
        links = []
        for name, (vertices, faces) in robot_meshes.items():
            if name not in LINK_NAMES:
                raise InvalidInputError.choice("a key of robot_meshes", name, LINK_NAMES)
            if len(faces):
                points = np.ascontiguousarray(vertices, dtype=np.float32)
                links.append((LINK_NAMES.index(name), points, build_mesh(points, faces, self._warp_device)))
        return links

    def _allocate_inputs(self) -> None:
        """The buffers that `cast` fills; the kernels read them in place."""
        b, device = self.num_envs, self._device
        self._pose_shape = torch.Size((b, 4, 4))
        self._target_shape = torch.Size((b,))
        self._links_shape = torch.Size((b, len(LINK_NAMES), 4, 4))
        self._camera_poses = torch.zeros(self._pose_shape, device=device)
        self._plant_poses = torch.zeros(self._pose_shape, device=device)
        self._targets = torch.zeros(b, dtype=torch.int32, device=device)
        self._links_away = torch.eye(4, device=device).repeat(b, len(LINK_NAMES), 1, 1)
        self._links_away[..., :3, 3] = _FAR_AWAY
        self._link_poses = self._links_away.clone()
        self._robot_present = False
        self._results = torch.zeros((kernels.RESULTS, b), device=device)

    def _write_row(self, env: int, meshes: PlantMeshes) -> None:
        count = len(meshes.fruits)
        self._plant_meshes[env] = meshes.whole.id
        self._first_fruit_faces[env] = meshes.first_fruit_face
        self._fruit_counts[env] = count
        self._fruit_meshes[env, :count] = torch.tensor([mesh.id for mesh in meshes.fruits])
        self._fruit_spheres[env, :count] = torch.from_numpy(meshes.spheres)
        self._fruit_is_ripe[env] = 0
        self._fruit_is_ripe[env, :count] = torch.from_numpy(meshes.is_ripe)
        self._num_fruits[env] = count

    def _record(self, max_fruits: int) -> None:
        """Allocates the tables of the scene and prepares the launches that read them."""
        b, device = self.num_envs, self._device
        self._plant_meshes = torch.zeros(b, dtype=torch.int64, device=device)
        self._first_fruit_faces = torch.zeros(b, dtype=torch.int32, device=device)
        self._fruit_counts = torch.zeros(b, dtype=torch.int32, device=device)
        self._fruit_meshes = torch.zeros((b, max_fruits), dtype=torch.int64, device=device)
        self._fruit_spheres = torch.zeros((b, max_fruits, 4), device=device)
        self._fruit_is_ripe = torch.zeros((b, max_fruits), dtype=torch.int32, device=device)
        self._num_fruits = [0] * b
        for env, meshes in enumerate(self._shown):
            self._write_row(env, meshes)

        scene = kernels.Scene()
        scene.plant_meshes = wp.from_torch(self._plant_meshes, dtype=wp.uint64)
        scene.first_fruit_faces = wp.from_torch(self._first_fruit_faces)
        scene.fruit_counts = wp.from_torch(self._fruit_counts)
        scene.fruit_meshes = wp.from_torch(self._fruit_meshes, dtype=wp.uint64)
        scene.fruit_spheres = wp.from_torch(self._fruit_spheres, dtype=wp.vec4)
        scene.fruit_is_ripe = wp.from_torch(self._fruit_is_ripe)
        scene.link_meshes = self._array(
            np.array([m.id for _, _, m in self._links], dtype=np.uint64), wp.uint64
        )
        scene.link_indices = self._array(np.array([i for i, _, _ in self._links], dtype=np.int32), wp.int32)
        lows = [points.min(axis=0) for _, points, _ in self._links]
        highs = [points.max(axis=0) for _, points, _ in self._links]
        scene.link_lows = self._array(np.array(lows, dtype=np.float32).reshape(-1, 3), wp.vec3)
        scene.link_highs = self._array(np.array(highs, dtype=np.float32).reshape(-1, 3), wp.vec3)

        self._scene = scene
        view = make_view(b, len(self._links), self._warp_device)
        targets = wp.from_torch(self._targets)
        poses = [
            wp.from_torch(self._camera_poses, dtype=wp.mat44),
            wp.from_torch(self._plant_poses, dtype=wp.mat44),
            wp.from_torch(self._link_poses, dtype=wp.mat44),
        ]
        results = wp.from_torch(self._results)
        calls: list[tuple[Any, Any, list[Any]]] = [
            (kernels.prepare, b, [scene, view, *poses, targets]),
            (kernels.trace_target, (b, self._rays), [scene, view, self._camera, self._pattern, targets]),
            (
                kernels.trace_others,
                (b, max_fruits),
                [scene, view, self._camera, self._coarse_pattern, targets],
            ),
            (kernels.summarise, b, [scene, view, self._camera, float(self._rays), targets, results]),
        ]
        commands: list[Any] = [
            wp.launch(kernel, dim=dim, inputs=inputs, device=self._warp_device, record_cmd=True)
            for kernel, dim, inputs in calls
        ]
        # A recorded launch keeps addresses, not arrays: what they point to must stay alive with it.
        self._launched_with = [inputs for _, _, inputs in calls]
        self._launches = [command.launch for command in commands]
        self._finish_work()

    def _finish_work(self) -> None:
        """Waits for what is under way on a GPU, in Warp's stream and in torch's."""
        if self._is_cuda:
            wp.synchronize_device(self._warp_device)

    def _check_targets(self) -> None:
        for env, (target, count) in enumerate(zip(self._targets.tolist(), self._num_fruits, strict=True)):
            if not 0 <= target < count:
                raise InvalidInputError(
                    f"target_fruit[{env}] must be from 0 to {count - 1} for its plant, got {target}"
                )

    def _shape_error(
        self, camera: Tensor, target: Tensor, plant: Tensor, links: Tensor | None
    ) -> InvalidInputError:
        wanted = [
            ("T_world_camera", camera, self._pose_shape),
            ("target_fruit", target, self._target_shape),
            ("T_world_plant", plant, self._pose_shape),
        ]
        if links is not None:
            wanted.append(("link_transforms", links, self._links_shape))
        wrong = [
            f"{n} must have shape {tuple(s)}, got {tuple(t.shape)}" for n, t, s in wanted if t.shape != s
        ]
        return InvalidInputError("; ".join(wrong))
