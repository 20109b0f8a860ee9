"""The queries of a `RayScene` as kernels of NVIDIA Warp, on the CPU or on CUDA, with its triangles and their launches.

`RayScene` checks shapes and ranges before it asks, and its methods say what the arguments mean. Only tensors pass
between the two, all on the scene's device. The kernels have their rays traced by Embree or by Warp (`mesh_rays`).

A query copies its arguments into tensors that recorded kernels read in place, runs them in torch's current stream and
clones what they wrote. Each kind of query is recorded when it is first made.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from torch import Tensor

from maniskill_tomato.plants.organs import Plant, Role
from maniskill_tomato.raycast import (
    clearance_kernels,
    image_kernels,
    kernels,
    view_ray_kernels,
    visibility_kernels,
)
from maniskill_tomato.raycast.embree import Backend, load_embree
from maniskill_tomato.raycast.images import (
    BACKGROUND_DEPTH,
    FIRST_ORGAN_LABEL,
    NOTHING_LABEL,
    ROBOT_LABEL,
    CastImages,
    Picture,
)
from maniskill_tomato.raycast.meshes import LinkMeshes, LinkTriangles, PlantMeshes, plant_meshes
from maniskill_tomato.raycast.view_rays import NEAREST_DEPTH, RANGE, RAYS_PER_SIDE, ViewRays, ray_pattern
from maniskill_tomato.raycast.visibility import Visibility, ray_lattice
from maniskill_tomato.robot.d435 import CAMERA_FAR, CameraIntrinsics
from maniskill_tomato.robot.iiwa14 import LINK_NAMES
from maniskill_tomato.robot.spheres import sphere_table
from maniskill_tomato.warp_runtime import RecordedLaunch, room_for, start_warp

VIEWS_AT_ONCE: Final = 512
"""`visible_fraction_from` casts more views than this in several parts."""

_COARSE_RAYS_PER_SIDE: Final = 6
_FAR_AWAY: Final = 1.0e6
_RECORDED_AT_MOST: Final = 16
"""Launches that are kept, for queries, sizes of images and numbers of paths."""


class WarpScene:
    """The triangles of N environments and the queries about them; an answer outlives the next query."""

    def __init__(
        self,
        plants: Sequence[Plant],
        intrinsics: CameraIntrinsics,
        robot_meshes: LinkTriangles,
        rays_per_side: int,
        device: torch.device,
        backend: Backend,
    ) -> None:
        """Builds the meshes; the arguments are those of `RayScene`."""
        start_warp()
        self._device = device
        self._backend: Backend = backend
        self._warp_device = str(wp.device_from_torch(str(device)))
        self._camera: Any = kernels.FieldOfView()
        self._camera.left = -intrinsics.cx / intrinsics.fx
        self._camera.top = -intrinsics.cy / intrinsics.fy
        self._camera.right = (intrinsics.width - intrinsics.cx) / intrinsics.fx
        self._camera.bottom = (intrinsics.height - intrinsics.cy) / intrinsics.fy
        self._camera.square_pixels = intrinsics.fx * intrinsics.fy
        self._rays = rays_per_side**2
        self._pattern = self._points(ray_lattice(rays_per_side))
        self._coarse_pattern = self._points(ray_lattice(_COARSE_RAYS_PER_SIDE))

        self._shown = [plant_meshes(plant, self._warp_device, backend) for plant in plants]
        self._roles: _RoleTable | None = None
        self._tells_distances = False
        self._links = LinkMeshes(robot_meshes, self._warp_device, backend)
        self._scene: Any = kernels.Scene()
        embree = load_embree() if backend == "embree" else None
        if embree is not None:
            self._scene.tracer.closest_hit, self._scene.tracer.any_hit = embree.closest_hit, embree.any_hit
        self._links.describe(self._scene, device)
        self._allocate_tables()
        self._views = _Views(len(plants), self._links.count, device)
        self._views.environments.copy_(torch.arange(len(plants)))
        self._many_views: _Views | None = None
        self._first_view = _Views(1, self._links.count, device)
        self._finish_work()

    def show(self, plants: Mapping[int, Plant]) -> None:
        """Shows other plants in some environments, once all queries under way are done."""
        if not plants:
            return
        meshes = {env: plant_meshes(plant, self._warp_device, self._backend) for env, plant in plants.items()}
        # A new mesh is built in Warp's stream, and an old one must outlive the casts still under way with it.
        self._finish_work()
        for env, shown in meshes.items():
            self._shown[env] = shown
        self._roles = None
        if max(len(shown.fruits) for shown in meshes.values()) > self._fruit_meshes.shape[1]:
            self._allocate_tables()
        else:
            self._write_rows(list(meshes))

    def prepare(self, plant: Plant) -> PlantMeshes | None:
        """See `RayScene.prepare`."""
        if self._device.type != "cpu":
            return None
        meshes = plant_meshes(plant, self._warp_device, self._backend)
        if self._tells_distances:
            _ = meshes.for_distances
        return meshes

    def visibility(
        self,
        T_w_camera: Tensor,
        target_fruit: Tensor,
        T_w_plant: Tensor,
        T_w_links: Tensor | None,
        mask: Tensor | None,
    ) -> Visibility:
        """See `RayScene.visibility`."""
        self._views.place(T_w_camera, target_fruit, T_w_plant, T_w_links, mask)
        recorded = self._recorded(self._record_visibility, self._views)
        recorded.launch()
        return Visibility(recorded.outputs[0].clone())

    def visible_fraction_from(
        self,
        T_w_camera: Tensor,
        target_fruit: Tensor,
        T_w_plant: Tensor,
        T_w_links: Tensor | None,
        env_idx: Tensor,
    ) -> Tensor:
        """See `RayScene.visible_fraction_from`; the numbers are tensors of shape () or (K,)."""
        if self._many_views is None:
            self._many_views = _Views(VIEWS_AT_ONCE, self._links.count, self._device)
        views, count = self._many_views, T_w_camera.shape[0]
        recorded = self._recorded(self._record_visibility, views)
        targets, environments = target_fruit.expand(count), env_idx.expand(count)
        T_w_plants = T_w_plant.expand(count, 4, 4)
        answers = torch.empty(count, device=self._device)
        for first in range(0, count, VIEWS_AT_ONCE):
            part = slice(first, min(first + VIEWS_AT_ONCE, count))
            links = None if T_w_links is None else T_w_links[part]
            views.environments[: part.stop - first] = environments[part]
            views.place(T_w_camera[part], targets[part], T_w_plants[part], links)
            recorded.launch(part.stop - first)
            answers[part] = recorded.outputs[0][0, : part.stop - first]
        return answers

    def view_rays(
        self,
        T_w_camera: Tensor,
        target_fruit: Tensor,
        target_position: Tensor,
        T_w_plant: Tensor,
        T_w_links: Tensor | None,
        mask: Tensor | None,
    ) -> ViewRays:
        """See `RayScene.view_rays`."""
        recorded = self._recorded(self._record_view_rays)
        self._views.place(T_w_camera, target_fruit, T_w_plant, T_w_links, mask)
        recorded.inputs[0].copy_(target_position)
        recorded.launch()
        directions, distances, labels = recorded.outputs
        return ViewRays(directions.clone(), distances.clone(), labels.clone())

    def image(
        self,
        intrinsics: CameraIntrinsics,
        T_w_camera: Tensor,
        target_fruit: Tensor,
        T_w_plant: Tensor,
        T_w_links: Tensor | None,
    ) -> CastImages:
        """See `RayScene.image`."""
        recorded = self._recorded(self._record_image, intrinsics)
        self._views.place(T_w_camera, target_fruit, T_w_plant, T_w_links)
        recorded.launch()
        depth, face = recorded.outputs
        if self._roles is None:
            self._roles = _RoleTable(self._shown, self._device)
        return CastImages(depth.clone(), self._roles.of(face))

    def picture(
        self,
        intrinsics: CameraIntrinsics,
        T_w_camera: Tensor,
        T_w_plant: Tensor,
        T_w_links: Tensor | None,
        env_index: int,
    ) -> Picture:
        """See `RayScene.picture`."""
        recorded = self._recorded(self._record_picture, intrinsics)
        self._first_view.environments.fill_(env_index)
        self._first_view.place(T_w_camera, -1, T_w_plant, T_w_links)
        recorded.launch()
        depth, face, facing = (output[0].cpu().numpy() for output in recorded.outputs)
        # A face is -1 where there is nothing and -2 on the robot: the last two entries.
        organs = self._shown[env_index].plant.organ_of_face.astype(np.int32) + FIRST_ORGAN_LABEL
        labels = np.append(organs, np.array([ROBOT_LABEL, NOTHING_LABEL], np.int32))
        return Picture(depth.copy(), labels[face], facing.copy())

    def clearance(
        self, T_w_links: Tensor, T_w_plant: Tensor, env_idx: Tensor | None, farthest: float
    ) -> Tensor:
        """The smallest distance between the arm's spheres (`robot.spheres`) and a plant over S postures of each path.

        Args:
            T_w_links: Poses of `iiwa14.LINK_NAMES`. Shape (P, S, 9, 4, 4).
            T_w_plant: Poses of the plants. Shape (P, 4, 4).
            env_idx: Whose plant each path is held against; None for one path in every environment. Shape (P,).
            farthest: Largest distance that is told apart, in [m].

        Returns:
            In [m], negative where a triangle cuts a sphere. Shape (P,).
        """
        paths, samples = T_w_links.shape[:2]
        if not self._tells_distances:
            self._tells_distances = True
            self._write_rows(range(len(self._shown)))
        recorded = self._recorded(self._record_clearance, room_for(paths), samples, farthest)
        environments, plants, links, every = (tensor[:paths] for tensor in recorded.inputs)
        links.copy_(T_w_links)
        plants.copy_(T_w_plant)
        environments.copy_(every if env_idx is None else env_idx)
        clearance = recorded.outputs[0][:paths]
        clearance.fill_(farthest)
        recorded.launch(paths)
        return clearance.clone()

    def _recorded(self, record: Callable[..., "_Recorded"], *arguments: Any) -> "_Recorded":
        """What a method recorded for its arguments, recorded now if it is not at hand."""
        key = (record, *arguments)
        found = self._kept.get(key)
        if found is None:
            if len(self._kept) >= _RECORDED_AT_MOST:
                self._kept.clear()
            found = self._kept[key] = record(*arguments)
        return found

    def _points(self, points: NDArray[np.float32]) -> Any:
        return wp.from_torch(torch.tensor(points, device=self._device), dtype=wp.vec2)

    def _allocate_tables(self) -> None:
        """Makes the tables of all plants, with room for the fruits of any of them, and forgets what read other ones."""
        n, fruits, device = len(self._shown), max(len(meshes.fruits) for meshes in self._shown), self._device
        self._plant_meshes = torch.zeros(n, dtype=torch.int64, device=device)
        self._distance_meshes = torch.zeros(n, dtype=torch.int64, device=device)
        self._fruit_counts = torch.zeros(n, dtype=torch.int32, device=device)
        self._fruit_meshes = torch.zeros((n, fruits), dtype=torch.int64, device=device)
        self._fruit_spheres = torch.zeros((n, fruits, 4), device=device)
        self._fruit_is_ripe = torch.zeros((n, fruits), dtype=torch.int32, device=device)
        self._write_rows(range(n))
        self._scene.plant_meshes = wp.from_torch(self._plant_meshes, dtype=wp.uint64)
        self._scene.fruit_counts = wp.from_torch(self._fruit_counts)
        self._scene.fruit_meshes = wp.from_torch(self._fruit_meshes, dtype=wp.uint64)
        self._scene.fruit_spheres = wp.from_torch(self._fruit_spheres, dtype=wp.vec4)
        self._scene.fruit_is_ripe = wp.from_torch(self._fruit_is_ripe)
        self._kept: dict[tuple[Any, ...], _Recorded] = {}

    def _write_rows(self, envs: Sequence[int]) -> None:
        shown, fruits = [self._shown[env] for env in envs], self._fruit_meshes.shape[1]
        ids = np.zeros((len(envs), fruits), np.int64)
        spheres = np.zeros((len(envs), fruits, 4), np.float32)
        is_ripe = np.zeros((len(envs), fruits), np.int32)
        for k, meshes in enumerate(shown):
            count = len(meshes.fruits)
            ids[k, :count] = [mesh.id for mesh in meshes.fruits]
            spheres[k, :count], is_ripe[k, :count] = meshes.spheres, meshes.is_ripe
        rows = torch.tensor(list(envs), device=self._device)
        if self._tells_distances:
            nearby = torch.tensor([meshes.for_distances.id for meshes in shown])
            self._distance_meshes[rows] = nearby.to(self._device)
        for table, values in (
            (self._plant_meshes, torch.tensor([meshes.whole.id for meshes in shown])),
            (self._fruit_counts, torch.tensor([len(meshes.fruits) for meshes in shown], dtype=torch.int32)),
            (self._fruit_meshes, torch.from_numpy(ids)),
            (self._fruit_spheres, torch.from_numpy(spheres)),
            (self._fruit_is_ripe, torch.from_numpy(is_ripe)),
        ):
            table[rows] = values.to(self._device)

    def _zeros(self, *shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
        return torch.zeros(shape, dtype=dtype, device=self._device)

    def _record_visibility(self, views: "_Views") -> "_Recorded":
        b, scene, asked, camera = views.count, self._scene, views.struct, self._camera
        tallies = [self._zeros(b, dtype=torch.int32) for _ in range(3)]
        counts: Any = visibility_kernels.Counts()
        counts.silhouette, counts.visible, counts.any_seen = (wp.from_torch(tally) for tally in tallies)
        results = self._zeros(visibility_kernels.RESULTS, b)
        calls: list[tuple[Any, int | tuple[int, ...], list[Any]]] = [
            (kernels.prepare, b, [scene, asked]),
            (
                visibility_kernels.trace_target,
                (b, self._rays),
                [scene, asked, camera, self._pattern, counts],
            ),
            (
                visibility_kernels.trace_others,
                (b, self._fruit_meshes.shape[1]),
                [scene, asked, camera, self._coarse_pattern, counts],
            ),
            (
                visibility_kernels.summarise,
                b,
                [scene, asked, camera, float(self._rays), counts, wp.from_torch(results)],
            ),
        ]
        if views is not self._views:
            del calls[2]
        return _Recorded(RecordedLaunch(self._device, *calls), outputs=(results,))

    def _record_view_rays(self) -> "_Recorded":
        b, n = self._views.count, RAYS_PER_SIDE**2
        limits: Any = view_ray_kernels.Limits()
        limits.nearest, limits.farthest = NEAREST_DEPTH, RANGE
        target_positions = self._zeros(b, 3)
        directions, distances = self._zeros(b, n, 3), self._zeros(b, n)
        labels = self._zeros(b, n, dtype=torch.int8)
        targets = wp.from_torch(target_positions, dtype=wp.vec3)
        arguments = [
            self._scene,
            self._views.struct,
            self._camera,
            limits,
            self._points(ray_pattern()),
            targets,
            wp.from_torch(directions, dtype=wp.vec3),
            wp.from_torch(distances),
            wp.from_torch(labels),
        ]
        launch = RecordedLaunch(
            self._device,
            (kernels.prepare, b, [self._scene, self._views.struct]),
            (view_ray_kernels.narrow_links, b, [self._scene, self._views.struct, targets]),
            (view_ray_kernels.trace_view_rays, (b, n), arguments),
        )
        return _Recorded(launch, inputs=(target_positions,), outputs=(directions, distances, labels))

    def _record_image(self, intrinsics: CameraIntrinsics) -> "_Recorded":
        shape = (self._views.count, intrinsics.height, intrinsics.width)
        depth, face = self._zeros(*shape), self._zeros(*shape, dtype=torch.int32)
        arrays = [wp.from_torch(depth), wp.from_torch(face)]
        arguments = [self._scene, self._views.struct, _pinhole(intrinsics), BACKGROUND_DEPTH, *arrays]
        launch = RecordedLaunch(
            self._device,
            (kernels.prepare, shape[0], [self._scene, self._views.struct]),
            (image_kernels.trace_image, shape, arguments),
        )
        return _Recorded(launch, outputs=(depth, face))

    def _record_picture(self, intrinsics: CameraIntrinsics) -> "_Recorded":
        views = self._first_view
        shape = (1, intrinsics.height, intrinsics.width)
        depth, face = self._zeros(*shape), self._zeros(*shape, dtype=torch.int32)
        facing = self._zeros(*shape)
        arrays = [wp.from_torch(depth), wp.from_torch(face), wp.from_torch(facing)]
        arguments = [self._scene, views.struct, _pinhole(intrinsics), CAMERA_FAR, *arrays]
        launch = RecordedLaunch(
            self._device,
            (kernels.prepare, 1, [self._scene, views.struct]),
            (image_kernels.trace_picture, shape, arguments),
        )
        return _Recorded(launch, outputs=(depth, face, facing))

    def _record_clearance(self, paths: int, samples: int, farthest: float) -> "_Recorded":
        environments = self._zeros(paths, dtype=torch.int32)
        every = torch.arange(paths, dtype=torch.int32, device=self._device)
        plants, links = self._zeros(paths, 4, 4), self._zeros(paths, samples, len(LINK_NAMES), 4, 4)
        clearance = self._zeros(paths)
        sphere_links, spheres = (torch.tensor(table, device=self._device) for table in sphere_table())
        arguments = [
            wp.from_torch(self._distance_meshes, dtype=wp.uint64),
            wp.from_torch(environments),
            wp.from_torch(plants, dtype=wp.mat44),
            wp.from_torch(links, dtype=wp.mat44),
            wp.from_torch(sphere_links, dtype=wp.int32),
            wp.from_torch(spheres, dtype=wp.vec4),
            farthest,
            wp.from_torch(clearance),
        ]
        threads = (paths, samples, len(spheres))
        launch = RecordedLaunch(self._device, (clearance_kernels.sphere_clearance, threads, arguments))
        return _Recorded(launch, inputs=(environments, plants, links, every), outputs=(clearance,))

    def _finish_work(self) -> None:
        """Waits for what is under way on a GPU, in Warp's stream and in torch's."""
        if self._device.type == "cuda":
            wp.synchronize_device(self._warp_device)


@dataclass(frozen=True, eq=False)
class _Recorded:
    """A query's launch with the tensors it reads, beside those of its views, and writes."""

    launch: RecordedLaunch
    outputs: tuple[Tensor, ...]
    inputs: tuple[Tensor, ...] = ()


def _pinhole(intrinsics: CameraIntrinsics) -> Any:
    pinhole: Any = image_kernels.Pinhole()
    pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy = (
        intrinsics.fx,
        intrinsics.fy,
        intrinsics.cx,
        intrinsics.cy,
    )
    return pinhole


class _RoleTable:
    """The role of every triangle that is shown, for all environments in one tensor."""

    def __init__(self, shown: Sequence[PlantMeshes], device: torch.device) -> None:
        special = torch.zeros(3, dtype=torch.uint8)
        for face, role in (
            (image_kernels.NO_FACE, Role.BACKGROUND),
            (image_kernels.FACE_OF_ROBOT, Role.ROBOT),
            (image_kernels.FACE_OF_TARGET, Role.TARGET),
        ):
            special[face] = int(role)
        starts: dict[int, int] = {}
        parts, length = [special], len(special)
        for meshes in shown:
            if id(meshes) not in starts:
                starts[id(meshes)] = length
                parts.append(meshes.role_of_face)
                length += len(meshes.role_of_face)
        self._table = torch.cat(parts).to(device)
        first = torch.tensor([starts[id(meshes)] for meshes in shown], device=device)
        self._first = first[:, None, None]
        self._specials = len(special)

    def of(self, face: Tensor) -> Tensor:
        """Roles of triangles as the kernel numbers them, below 0 what is none. Shape (N, H, W), int32 to uint8."""
        return self._table[torch.where(face < 0, face + self._specials, face + self._first)]


class _Views:
    """Cameras, plants, links and targets of B views, in tensors that the kernels read in place."""

    def __init__(self, count: int, links: int, device: torch.device) -> None:
        self.count = count
        self.environments = torch.zeros(count, dtype=torch.int32, device=device)
        self._targets = torch.zeros(count, dtype=torch.int32, device=device)
        self._camera_poses = torch.eye(4, device=device).repeat(count, 1, 1)
        self._plant_poses = torch.eye(4, device=device).repeat(count, 1, 1)
        self._links_away = torch.eye(4, device=device).repeat(count, len(LINK_NAMES), 1, 1)
        self._links_away[..., :3, 3] = _FAR_AWAY
        self._link_poses = self._links_away.clone()
        self._robot_present = False
        self._asked = torch.ones(count, dtype=torch.int32, device=device)
        self._all_asked = True

        def floats(dtype: Any, *shape: int) -> Any:
            return wp.from_torch(torch.zeros(shape, device=device), dtype=dtype)

        views: Any = kernels.Views()
        views.environments = wp.from_torch(self.environments)
        views.targets = wp.from_torch(self._targets)
        views.camera_poses = wp.from_torch(self._camera_poses, dtype=wp.mat44)
        views.plant_poses = wp.from_torch(self._plant_poses, dtype=wp.mat44)
        views.link_poses = wp.from_torch(self._link_poses, dtype=wp.mat44)
        views.asked = wp.from_torch(self._asked)
        views.plant_rotations = floats(wp.mat33, count, 3, 3)
        views.plant_positions = floats(wp.vec3, count, 3)
        views.link_rotations = floats(wp.mat33, count, links, 3, 3)
        views.link_positions = floats(wp.vec3, count, links, 3)
        views.links_in_front = wp.from_torch(torch.zeros(count, dtype=torch.int32, device=device))
        views.links_before_target = wp.from_torch(torch.zeros(count, dtype=torch.int32, device=device))
        views.rectangles = floats(wp.vec4, count, 4)
        self.struct = views

    def place(
        self,
        T_w_camera: Tensor,
        target_fruit: Tensor | int,
        T_w_plant: Tensor,
        T_w_links: Tensor | None,
        mask: Tensor | None = None,
    ) -> None:
        """Fills the first K views.

        Args:
            T_w_camera: Shape (K, 4, 4), or (4, 4) for one.
            target_fruit: Shape (K,), or one for all.
            T_w_plant: Shape (K, 4, 4), or (4, 4) for all.
            T_w_links: Shape (K, 9, 4, 4), or (9, 4, 4) for one; None for no robot.
            mask: Which are asked about; all if None. Shape (B,), bool.
        """
        if mask is not None:
            self._asked.copy_(mask)
        elif not self._all_asked:
            self._asked.fill_(1)
        self._all_asked = mask is None
        count = T_w_camera.shape[0] if T_w_camera.dim() == 3 else 1
        tables = self._camera_poses, self._plant_poses, self._targets, self._link_poses
        cameras, plants, targets, links = (
            tables if count == self.count else (table[:count] for table in tables)
        )
        cameras.copy_(T_w_camera)
        plants.copy_(T_w_plant)
        if isinstance(target_fruit, int):
            targets.fill_(target_fruit)
        else:
            targets.copy_(target_fruit)
        if T_w_links is not None:
            links.copy_(T_w_links)
            self._robot_present = True
        elif self._robot_present:
            self._link_poses.copy_(self._links_away)
            self._robot_present = False
