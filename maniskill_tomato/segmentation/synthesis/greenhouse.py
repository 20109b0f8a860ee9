"""A rendered scene: a row of plants with its surroundings, and light, depth and thing of every pixel of a view."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import sapien
import sapien.render
from numpy.random import Generator
from numpy.typing import NDArray

from maniskill_tomato.plants.generator import generate_plant
from maniskill_tomato.plants.organs import MeshPart, Plant, SemanticClass
from maniskill_tomato.plants.row import ROW_SPACING, Row, generate_row
from maniskill_tomato.rendering.plant_actors import make_render_shape, merged_parts
from maniskill_tomato.rendering.surfaces import dome
from maniskill_tomato.rendering.vulkan_probe import render_backend
from maniskill_tomato.robot.d435 import CAMERA_FAR, CAMERA_NEAR, R_CAMERA_OPTICAL, CameraIntrinsics
from maniskill_tomato.segmentation.datasets.annotations import BEHIND
from maniskill_tomato.segmentation.synthesis import surroundings
from maniskill_tomato.segmentation.synthesis.appearance import SceneAppearance, draw_crop
from maniskill_tomato.segmentation.synthesis.paint import PlantMaterials

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

CATEGORY: dict[SemanticClass, str] = {
    SemanticClass.STEM: "stem",
    SemanticClass.LEAF: "leaf",
    SemanticClass.FRUIT_RIPE: "tomato_ripe",
    SemanticClass.FRUIT_TURNING: "tomato_turning",
    SemanticClass.FRUIT_GREEN: "tomato_unripe",
    SemanticClass.ROBOT: "robot",
}
"""The annotated category of each semantic class."""

DISTANT_PLANTS = 6
"""Plants that the rows behind are made of; they are grown once per process."""

SKY, GROUND = (0.78, 0.81, 0.83), (0.33, 0.33, 0.31)
"""Linear colours of the light from above and below at a strength of 1."""

_SUN_CENTRE = [0.0, 0.0, 0.8]


@dataclass(frozen=True, eq=False)
class Thing:
    """Something in a scene that a pixel may show and an annotation name."""

    name: str
    category: str
    in_front: bool
    """Whether it belongs to the row in front, or else to those behind."""
    vertices: Float32 | None = None
    """A fruit's, in the plant frame, in [m]. Shape (V, 3)."""
    faces: NDArray[np.int32] | None = None
    """A fruit's. Shape (F, 3)."""


@dataclass(frozen=True, kw_only=True)
class Shot:
    """What the camera sees, before its own faults."""

    light: Float32
    """Linear RGB, 1 about white. Shape (height, width, 3)."""
    depth_m: Float64
    """Along the optical axis, in [m]; infinite where nothing is. Shape (height, width)."""
    thing: NDArray[np.int32]
    """Index in the scene's things, -1 for everything else. Shape (height, width)."""


def grow(appearance: SceneAppearance, seed: int, seeds: tuple[int, int]) -> tuple[Row, Row]:
    """A row, in few triangles, and with the middle plant in fine ones, as cameras come near it.

    Args:
        appearance: Its crop.
        seed: The middle plant's.
        seeds: Half-open range of its neighbours' seeds.
    """
    # The neighbours are kept by their configuration; a crop drawn anew would only fill that store.
    coarse = generate_row(appearance.crop, seed, "training", appearance.leaf_density, seeds=seeds)  # type: ignore[arg-type]
    middle = generate_plant(appearance.crop, seed, "picture", appearance.leaf_density)
    organs = [
        better if appearance.fine_leaves or better.semantic_class != SemanticClass.LEAF else plain
        for plain, better in zip(coarse.organs, middle.organs, strict=False)
    ]
    return coarse, replace(coarse, organs=(*organs, *coarse.organs[len(organs) :]))


@lru_cache(maxsize=DISTANT_PLANTS)
def _distant_plant(number: int, low: int) -> Plant:
    rng = np.random.default_rng([77, number, low])
    crop = replace(draw_crop(rng), leaves_kept_below_truss=3)
    return generate_plant(crop, low + int(rng.integers(0, 1000)), "training", float(rng.uniform(0.7, 1.3)))


class GreenhouseScene:
    """A row in its surroundings, with one camera."""

    def __init__(
        self,
        row: Plant,
        appearance: SceneAppearance,
        intrinsics: CameraIntrinsics,
        rng: Generator,
        *,
        first_seed: int = 0,
    ) -> None:
        """Builds the scene; the plant frame is the world's.

        Args:
            row: The plants in front.
            appearance: How it looks.
            intrinsics: The camera.
            rng: Places what the appearance leaves open.
            first_seed: The first seed of the split that the plants behind are taken from.

        Raises:
            RenderingUnavailableError: There is no Vulkan device.
        """
        self.row = row
        self.appearance = appearance
        self._intrinsics = intrinsics
        sapien.render.set_camera_shader_dir("default")
        device = sapien.Device("cuda" if render_backend() == "gpu" else "cpu")
        self._scene = sapien.Scene([sapien.physx.PhysxCpuSystem(), sapien.render.RenderSystem(device)])
        self.things: list[Thing] = []
        self._thing_of_id: dict[int, int] = {}
        self._materials = PlantMaterials(appearance, rng)
        for organ in row.organs:
            if organ.semantic_class == SemanticClass.OBJECT:
                self._add_parts(organ.parts, sapien.Pose())
                continue
            category = CATEGORY[organ.semantic_class]
            fruit = category.startswith("tomato")
            thing = Thing(
                organ.name,
                category,
                True,
                organ.vertices if fruit else None,
                organ.faces if fruit else None,
            )
            self._name(thing, [self._add_parts(organ.parts, sapien.Pose())])
        self._add_rows_behind(rng, first_seed)
        surroundings.add_surroundings(self._add, appearance, rng)
        if appearance.robot:
            links = surroundings.add_arm(self._scene, rng)
            self._name(Thing("robot", "robot", True), links)
        self._add_light()
        self._camera = sapien.render.RenderCameraComponent(intrinsics.width, intrinsics.height)
        i = intrinsics
        self._camera.set_perspective_parameters(CAMERA_NEAR, CAMERA_FAR, i.fx, i.fy, i.cx, i.cy, 0.0)
        holder = sapien.Entity()
        holder.add_component(self._camera)
        self._scene.add_entity(holder)

    def shoot(self, T_plant_optical: Float64) -> Shot:
        """Renders one view.

        Args:
            T_plant_optical: Pose of the camera's optical frame, in [m]. Shape (4, 4).
        """
        frame = T_plant_optical.copy()
        frame[:3, :3] = T_plant_optical[:3, :3] @ R_CAMERA_OPTICAL.T
        self._camera.entity.pose = sapien.Pose(frame)
        self._scene.update_render()
        self._camera.take_picture()
        light = self._camera.get_picture("Lighting")[..., :3]
        depth = -self._camera.get_picture("Position")[..., 2].astype(np.float64)
        ids = self._camera.get_picture("Segmentation")[..., 1].astype(np.int64)
        table = np.full(int(ids.max()) + 1, -1, dtype=np.int32)
        for number, thing in self._thing_of_id.items():
            if number < len(table):
                table[number] = thing
        light = np.nan_to_num(light, nan=0.0, posinf=8.0, neginf=0.0)
        return Shot(
            light=np.ascontiguousarray(np.clip(light, 0.0, 8.0), dtype=np.float32),
            depth_m=np.where(depth > 0, depth, np.inf),
            thing=table[ids],
        )

    def relight(self, appearance: SceneAppearance) -> None:
        """Moves the sun and changes its strength, for another view of the same scene."""
        # SAPIEN's declared types want arrays of a fixed shape; it takes any three numbers.
        ahead: Any = np.array([1, 0, 0], np.float32)
        sun: Any = np.array(appearance.sun_direction, np.float32)
        turn = sapien.math.shortest_rotation(ahead, sun)
        self._sun.pose = sapien.Pose(_SUN_CENTRE, turn)
        self._sun.set_color(list(appearance.sun))

    def _add(self, shapes: Sequence[sapien.render.RenderShape], pose: sapien.Pose) -> sapien.Entity:
        body = sapien.render.RenderBodyComponent()
        for shape in shapes:
            body.attach(shape)
        entity = sapien.Entity()
        entity.add_component(body)
        entity.pose = pose
        self._scene.add_entity(entity)
        return entity

    def _add_parts(self, parts: Sequence[MeshPart], pose: sapien.Pose) -> sapien.Entity:
        return self._add([make_render_shape(part, self._materials) for part in parts], pose)

    def _name(self, thing: Thing, entities: Sequence[sapien.Entity]) -> None:
        for entity in entities:
            self._thing_of_id[int(entity.per_scene_id)] = len(self.things)
        self.things.append(thing)

    def _add_rows_behind(self, rng: Generator, first_seed: int) -> None:
        appearance = self.appearance
        rows = {"foliage": (1, 2), "gutters": (1,), "bright": ()}[appearance.backdrop]
        for k in rows:
            width = 3 if k == 1 else 2
            for j in range(-width, width + 1):
                if appearance.backdrop == "gutters" and rng.random() < 0.35:
                    continue
                plant = _distant_plant(int(rng.integers(DISTANT_PLANTS)), first_seed)
                angle = float(rng.uniform(-0.6, 0.6) + (np.pi if rng.random() < 0.5 else 0.0))
                place = [appearance.row_distance * k, ROW_SPACING * j + float(rng.normal(0, 0.05)), 0.0]
                pose = sapien.Pose(place, [np.cos(angle / 2), 0, 0, np.sin(angle / 2)])
                green = [p for o in plant.organs if o.semantic_class <= SemanticClass.LEAF for p in o.parts]
                self._add_parts(merged_parts(green), pose)
                T = pose.to_transformation_matrix()
                for organ in plant.organs:
                    if not CATEGORY.get(organ.semantic_class, "").startswith("tomato"):
                        continue
                    vertices = (organ.vertices @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
                    name = f"{BEHIND}{k}_{j}/{organ.name}"
                    thing = Thing(name, CATEGORY[organ.semantic_class], False, vertices, organ.faces)
                    self._name(thing, [self._add_parts(organ.parts, pose)])

    def _add_light(self) -> None:
        appearance = self.appearance
        self._scene.set_ambient_light([0.12 * appearance.sky] * 3)
        self._sun = self._scene.add_directional_light(
            list(appearance.sun_direction),
            list(appearance.sun),
            shadow=True,
            position=_SUN_CENTRE,
            shadow_scale=1.4,
            shadow_near=-1.9,
            shadow_far=4.0,
            shadow_map_size=2048,
        )
        self._scene.set_environment_map(_sky(round(appearance.sky, 1)))


def _sky(strength: float) -> sapien.render.RenderCubemap:
    sky, ground = (tuple(min(c * strength, 1.0) for c in colour) for colour in (SKY, GROUND))
    return dome(sky, ground, 0.4)
