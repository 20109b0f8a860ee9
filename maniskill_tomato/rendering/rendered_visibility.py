"""The visible fraction counted in rendered segmentation images: the reference that the rays must agree with.

V is the number of pixels of the target in an image with everything shown, T the number of its pixels in an image
with everything else hidden. T's image has the same focal length and the same pixel grid but is shifted to the target,
so that it holds the whole silhouette wherever that lies. Needs a Vulkan device.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import sapien
import sapien.render
import torch
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.envs.utils.system.backend import parse_sim_and_render_backend
from mani_skill.render import PREBUILT_SHADER_CONFIGS, set_shader_pack
from numpy.typing import NDArray

from maniskill_tomato.plants.generator import generate_plant
from maniskill_tomato.plants.organs import Plant
from maniskill_tomato.raycast.scene import RayScene
from maniskill_tomato.rendering.plant_actors import build_plant_actors
from maniskill_tomato.robot.d435 import CAMERA_NEAR, R_CAMERA_OPTICAL, CameraIntrinsics

Float64 = NDArray[np.float64]

COMPARISON_INTRINSICS: Final = CameraIntrinsics.from_fov(width=640, height=480, fov_y=np.deg2rad(42.5))
"""The image of the comparison: VGA with the D435's vertical field of view (data sheet: 42 to 43 degrees)."""

_PRESETS: Final = ("one_tomato", "three_tomatoes", "full")
_SILHOUETTE_SIZE: Final = 384


@dataclass(frozen=True, kw_only=True)
class ComparedView:
    """One viewpoint, judged twice."""

    preset: str
    seed: int
    """The plant's."""
    target_fruit: int
    T_plant_camera: Float64
    """Pose of the optical frame in the plant's frame. Shape (4, 4)."""
    rendered: float
    """V_f counted in the rendered images."""
    cast: float
    """V_f by ray casting."""

    @property
    def difference(self) -> float:
        """Cast minus rendered."""
        return self.cast - self.rendered


class SegmentedPlant:
    """A plant alone in a scene, seen by two cameras that draw segmentation ids."""

    def __init__(self, plant: Plant, intrinsics: CameraIntrinsics) -> None:
        """Builds the scene with the plant's frame at the world's.

        Args:
            plant: What is looked at.
            intrinsics: The camera that sees V.
        """
        self.plant = plant
        self._intrinsics = intrinsics
        backend = parse_sim_and_render_backend("cpu", "cpu")
        set_shader_pack(PREBUILT_SHADER_CONFIGS["minimal"])
        scene = sapien.Scene(
            [sapien.physx.PhysxCpuSystem(), sapien.render.RenderSystem(backend.render_device)]
        )
        wrapped = ManiSkillScene([scene], device=torch.device("cpu"), backend=backend)
        actors = build_plant_actors(wrapped, plant, scene_idxs=[0], pose=sapien.Pose(), name_prefix="")
        self._scene = scene
        entities = [actor._objs[0] for actor in actors]
        self._ids = [entity.per_scene_id for entity in entities]
        self._bodies: list[Any] = [
            e.find_component_by_type(sapien.render.RenderBodyComponent) for e in entities
        ]
        self._image = _add_camera(scene, intrinsics.width, intrinsics.height)
        self._silhouette = _add_camera(scene, _SILHOUETTE_SIZE, _SILHOUETTE_SIZE)

    def count(self, T_plant_camera: Float64, target_fruit: int) -> tuple[int, int]:
        """V and T of one view, in [px].

        Args:
            T_plant_camera: Pose of the optical frame in the plant's. Shape (4, 4).
            target_fruit: Index into the plant's fruits.
        """
        fruit = self.plant.fruits[target_fruit]
        target_id = self._ids[fruit.organ_index]
        i = self._intrinsics
        centre = np.linalg.inv(T_plant_camera) @ np.append(fruit.centre.astype(np.float64), 1.0)
        column = round(i.fx * centre[0] / centre[2] + i.cx) - _SILHOUETTE_SIZE // 2
        row = round(i.fy * centre[1] / centre[2] + i.cy) - _SILHOUETTE_SIZE // 2
        visible = self._draw(self._image, T_plant_camera, i.cx, i.cy)[..., 3] == target_id
        for body in self._bodies:
            body.visibility = 0.0
        self._bodies[fruit.organ_index].visibility = 1.0
        whole = self._draw(self._silhouette, T_plant_camera, i.cx - column, i.cy - row)[..., 3] == target_id
        for body in self._bodies:
            body.visibility = 1.0
        edge = np.concatenate([whole[0], whole[-1], whole[:, 0], whole[:, -1]])
        if edge.any():
            raise ValueError(f"the target's silhouette does not fit into {_SILHOUETTE_SIZE} pixels")
        return int(np.count_nonzero(visible)), int(np.count_nonzero(whole))

    def picture(self, T_plant_camera: Float64) -> NDArray[np.int64]:
        """Index into the plant's organs for every pixel, -1 where there is none. Shape (height, width)."""
        return self.picture_with_depth(T_plant_camera)[0]

    def picture_with_depth(self, T_plant_camera: Float64) -> tuple[NDArray[np.int64], Float64]:
        """What `picture` gives, and the depth of every pixel, in [m] and whole millimetres as a D435 gives it.

        Pixels that show nothing have the depth infinity.
        """
        drawn = self._draw(self._image, T_plant_camera, self._intrinsics.cx, self._intrinsics.cy)
        organs = np.full(drawn.shape[:2], -1, dtype=np.int64)
        for index, segmentation_id in enumerate(self._ids):
            organs[drawn[..., 3] == segmentation_id] = index
        # The picture holds positions in the renderer's camera frame, which looks along -z, in millimetres.
        return organs, np.where(organs >= 0, -drawn[..., 2] / 1000.0, np.inf)

    def _draw(self, camera: Any, T_plant_camera: Float64, cx: float, cy: float) -> NDArray[np.int16]:
        T_plant_frame = T_plant_camera.copy()
        T_plant_frame[:3, :3] = T_plant_camera[:3, :3] @ R_CAMERA_OPTICAL.T
        i = self._intrinsics
        camera.set_perspective_parameters(CAMERA_NEAR, 10.0, i.fx, i.fy, cx, cy, 0.0)
        camera.local_pose = sapien.Pose(T_plant_frame)
        self._scene.update_render()
        camera.take_picture()
        drawn: NDArray[np.int16] = camera.get_picture("PositionSegmentation")
        return drawn


def _add_camera(scene: sapien.Scene, width: int, height: int) -> Any:
    camera = sapien.render.RenderCameraComponent(width, height)
    entity = sapien.Entity()
    entity.add_component(camera)
    scene.add_entity(entity)
    return camera


def random_view(plant: Plant, rng: np.random.Generator) -> tuple[int, Float64]:
    """A fruit of the plant and a camera 0.25 to 0.9 m from it that looks roughly towards it.

    Every direction but from right above or below is as likely as another; the camera is rolled at random and misses
    the fruit's centre by up to 35 degrees, so that some targets lie partly or wholly outside the image.

    Returns:
        Index into the plant's fruits, and the pose of the optical frame in the plant's frame, Shape (4, 4).
    """
    target = int(rng.integers(len(plant.fruits)))
    azimuth, sine = rng.uniform(-np.pi, np.pi), rng.uniform(-0.8, 0.8)
    cosine = np.sqrt(1 - sine**2)
    forward = np.array([cosine * np.cos(azimuth), cosine * np.sin(azimuth), sine])
    right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    T_plant_camera = np.eye(4)
    T_plant_camera[:3, 3] = plant.fruits[target].centre - rng.uniform(0.25, 0.9) * forward
    turn = _rotation(2, rng.uniform(-np.pi, np.pi)) @ _rotation(1, np.deg2rad(35) * rng.uniform(-1, 1) ** 3)
    T_plant_camera[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1) @ turn
    return target, T_plant_camera


def compare(
    num_plants: int = 30,
    views_per_plant: int = 10,
    rays_per_side: int = 16,
    seed: int = 0,
    on_plant: Callable[[int], object] | None = None,
) -> list[ComparedView]:
    """Judges random views of random plants by rays and by rendered images.

    Args:
        num_plants: The presets take turns; plants have the seeds from `seed` on.
        views_per_plant: Random views of each.
        rays_per_side: As for `RayScene`.
        seed: Which plants and views.
        on_plant: Called with the number of finished plants.

    Raises:
        RuntimeError: There is no Vulkan device.
    """
    rng = np.random.default_rng(seed)
    views = []
    for index in range(num_plants):
        plant = generate_plant(_PRESETS[index % len(_PRESETS)], seed + index, "training")
        segmented = SegmentedPlant(plant, COMPARISON_INTRINSICS)
        scene = RayScene([plant], COMPARISON_INTRINSICS, rays_per_side=rays_per_side)
        for _ in range(views_per_plant):
            target, pose = random_view(plant, rng)
            visible, total = segmented.count(pose, target)
            seen = scene.visibility(
                torch.from_numpy(pose.astype(np.float32))[None],
                torch.tensor([target]),
                torch.eye(4)[None],
            )
            views.append(
                ComparedView(
                    preset=plant.preset,
                    seed=plant.seed,
                    target_fruit=target,
                    T_plant_camera=pose,
                    rendered=visible / total,
                    cast=float(seen.visible_fraction[0]),
                )
            )
        if on_plant is not None:
            on_plant(index + 1)
    return views


def _rotation(axis: int, angle: float) -> Float64:
    """A right-handed rotation about a coordinate axis. Shape (3, 3)."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[i, i] = matrix[j, j] = np.cos(angle)
    matrix[i, j], matrix[j, i] = -np.sin(angle), np.sin(angle)
    return matrix
