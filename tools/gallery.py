"""Renders tomato plants in a greenhouse row: a contact sheet of presets and seeds, or a single picture.

Needs Vulkan (lavapipe on a CPU will do). Examples:

    python tools/gallery.py
    python tools/gallery.py --view close --preset full --seed 3 --out close.jpg
    python tools/gallery.py --mesh foreign --out docs/images/foreign.jpg
"""

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import sapien
import sapien.render
import tyro
from mani_skill.render import PREBUILT_SHADER_CONFIGS, set_shader_pack
from numpy.typing import NDArray

from maniskill_tomato.errors import RenderingUnavailableError
from maniskill_tomato.plants.generator import Detail, generate_plant
from maniskill_tomato.plants.hiding import view_direction
from maniskill_tomato.plants.mesh_set import ALL, MeshSource
from maniskill_tomato.plants.organs import Plant
from maniskill_tomato.rendering.plant_actors import make_render_shape

logger = logging.getLogger("gallery")
UInt8 = NDArray[np.uint8]
ROW_SPACING = 1.5
"""Distance between plant rows, in [m]; greenhouse practice 1.5-1.6 m."""
PLANT_SPACING = 0.45
"""Distance between plants in a row, in [m]; greenhouse practice 0.4-0.5 m."""
COLOUR_FOV = np.radians(42.5)
"""Vertical field of view of the D435's colour camera, in [rad]."""
SUPERSAMPLING = 2


@dataclass(frozen=True)
class Args:
    """Which picture to render."""

    view: Literal["sheet", "whole", "camera", "close"] = "sheet"
    """The contact sheet, or one plant: whole, from the wrist camera's distance, or close to a fruit."""
    preset: str = "full"
    """Preset of a single picture."""
    seed: int = 0
    """Seed of a single picture."""
    fruit: int = 0
    """Fruit that a single picture looks at."""
    azimuth: float = 0.0
    """Direction of the camera seen from the fruit, 0 on the robot's side, in [deg]."""
    elevation: float = 5.0
    """Elevation of the camera seen from the fruit, in [deg]."""
    detail: Detail = "picture"
    """Level of detail of the plant."""
    mesh: Path | None = None
    """A folder of mesh files: the sheet shows six of its plants, from all over its list, in place of ours."""
    out: Path = Path("docs/images/gallery.jpg")
    """File to write; its ending chooses the format."""


Column = tuple[Plant, int, tuple[float, float] | None]
"""A plant, the fruit that is looked at, and azimuth and elevation of the nearer view in [deg]; None looks for them."""


class Greenhouse:
    """A plant in its row, with light, floor and neighbours."""

    def __init__(self, plant: Plant) -> None:
        set_shader_pack(PREBUILT_SHADER_CONFIGS["default"])
        try:
            render = sapien.render.RenderSystem()
        except RuntimeError as error:
            raise RenderingUnavailableError(
                "the gallery needs a Vulkan device; on a CPU install Mesa's lavapipe (mesa-vulkan-drivers)"
            ) from error
        self.scene = sapien.Scene([sapien.physx.PhysxCpuSystem(), render])
        self._materials: dict[str, sapien.render.RenderMaterial] = {}
        self._add_plant(plant, 0.0, 0.0)
        for row in range(3):
            for place in range(-4 - row, 5 + row):
                if row == 0 and abs(place) < 2:
                    continue
                neighbour = generate_plant("full", 1000 + 50 * row + place, leaf_density=1.4)
                shift = 0.06 * np.sin(7.0 * place + row)
                self._add_plant(neighbour, row * ROW_SPACING, place * PLANT_SPACING + float(shift))
            self._add_box((row * ROW_SPACING, 0.0, -0.06), (0.11, 6.0, 0.05), (0.52, 0.54, 0.55))
        self._add_box((0.0, 0.0, -0.32), (12.0, 12.0, 0.01), (0.34, 0.34, 0.32))
        for x, y in ((9.0, 0.0), (-9.0, 0.0), (0.0, 9.0), (0.0, -9.0)):
            self._add_box(
                (x, y, 3.0), (9.0 if x == 0 else 0.02, 9.0 if y == 0 else 0.02, 8.0), (0.44, 0.52, 0.55)
            )
        self.scene.set_ambient_light([0.42, 0.45, 0.46])
        self.scene.add_directional_light(
            [0.75, 0.30, -1.0],
            [2.9, 2.8, 2.5],
            shadow=True,
            shadow_scale=1.3,
            shadow_near=-4.0,
            shadow_far=4.0,
            shadow_map_size=4096,
        )
        self.scene.add_directional_light([0.4, -1.0, -0.5], [0.8, 0.85, 0.9])

    def _add_plant(self, plant: Plant, x: float, y: float) -> None:
        body = sapien.render.RenderBodyComponent()
        for organ in plant.organs:
            for part in organ.parts:
                body.attach(make_render_shape(part, self._materials))
        self._add(body, [x, y, 0.0])
        # The string on which the plant is trained.
        white = sapien.render.RenderMaterial(base_color=[0.85, 0.85, 0.80, 1.0], roughness=0.9)
        string = sapien.render.RenderBodyComponent()
        string.attach(sapien.render.RenderShapeCylinder(0.0012, 1.5, white))
        upright = [float(np.sqrt(0.5)), 0.0, float(np.sqrt(0.5)), 0.0]
        self._add(string, [x + 0.011, y + 0.004, 1.5], upright)

    def _add_box(
        self,
        centre: tuple[float, float, float],
        half_size: tuple[float, float, float],
        colour: tuple[float, float, float],
    ) -> None:
        material = sapien.render.RenderMaterial(base_color=[*colour, 1.0], roughness=0.9, specular=0.1)
        body = sapien.render.RenderBodyComponent()
        body.attach(sapien.render.RenderShapeBox(half_size, material))
        self._add(body, list(centre))

    def _add(
        self,
        body: sapien.render.RenderBodyComponent,
        position: list[float],
        quat_wxyz: list[float] | None = None,
    ) -> None:
        entity = sapien.Entity()
        entity.add_component(body)
        entity.set_pose(sapien.Pose(position, quat_wxyz or [1.0, 0.0, 0.0, 0.0]))
        self.scene.add_entity(entity)

    def photograph(
        self, eye: NDArray[np.float64], target: NDArray[np.float64], size: tuple[int, int], fov: float
    ) -> UInt8:
        """A picture from a place towards another.

        Args:
            eye: Camera position, in [m]. Shape (3,).
            target: Point at the centre of the picture, in [m]. Shape (3,).
            size: Width and height, in pixels.
            fov: Vertical field of view, in [rad].

        Returns:
            Shape (height, width, 3), BGR.
        """
        forward = (target - eye) / np.linalg.norm(target - eye)
        left = np.cross([0.0, 0.0, 1.0], forward)
        left /= np.linalg.norm(left)
        T_world_camera = np.eye(4)
        T_world_camera[:3, :3] = np.stack([forward, left, np.cross(forward, left)], 1)
        T_world_camera[:3, 3] = eye
        width, height = (SUPERSAMPLING * n for n in size)
        camera = self.scene.add_camera("photo", width, height, fov, 0.01, 30.0)
        camera.entity.set_pose(sapien.Pose(T_world_camera))
        self.scene.update_render()
        camera.take_picture()
        colour = np.clip(camera.get_picture("Color")[..., 2::-1], 0.0, 1.0)
        self.scene.remove_entity(camera.entity)
        small = cv2.resize((255 * colour).astype(np.uint8), size, interpolation=cv2.INTER_AREA)
        return np.asarray(small, np.uint8)


def whole(house: Greenhouse, size: tuple[int, int]) -> UInt8:
    """The plant from the aisle."""
    return house.photograph(np.array([-1.9, 0.25, 0.95]), np.array([0.0, 0.0, 0.76]), size, 0.80)


def at_fruit(
    house: Greenhouse,
    plant: Plant,
    fruit: int,
    size: tuple[int, int],
    distance: float,
    azimuth: float,
    elevation: float,
) -> UInt8:
    """A picture of a fruit with the D435's field of view, from a distance in [m] and two angles in [deg]."""
    centre = plant.fruits[fruit].centre.astype(np.float64)
    return house.photograph(
        centre + distance * view_direction(azimuth, elevation), centre, size, float(COLOUR_FOV)
    )


def clearest_view(house: Greenhouse, plant: Plant, fruit: int) -> tuple[float, float]:
    """Azimuth and elevation from which most of a ripe fruit shows, in [deg], of a few on either side."""

    def red(view: tuple[float, float]) -> int:
        image = at_fruit(house, plant, fruit, (64, 48), 0.33, *view).astype(int)[8:40, 14:50]
        return int(((image[..., 2] > 70) & (image[..., 2] > 2 * image[..., 1])).sum())

    return max(((a, e) for a in (-58.0, -42.0, 42.0, 58.0) for e in (-28.0, -14.0)), key=red)


def sheet(columns: Sequence[Column]) -> UInt8:
    """Whole plants, the wrist camera's view of a fruit below, a nearer view of it below that; 1,600 wide for six."""
    tile, gap = 264, 4
    rows: list[list[UInt8]] = [[], [], []]
    for plant, fruit, near in columns:
        house = Greenhouse(plant)
        rows[0].append(whole(house, (tile, 480)))
        rows[1].append(at_fruit(house, plant, fruit, (tile, 220), 0.65, -8.0, 10.0))
        view = clearest_view(house, plant, fruit) if near is None else near
        rows[2].append(at_fruit(house, plant, fruit, (tile, 220), 0.33, *view))
        logger.info("rendered %s %d", plant.preset, plant.seed)
    bands = []
    for row in rows:
        padded = [np.pad(image, ((0, gap), (0, gap), (0, 0)), constant_values=255) for image in row]
        bands.append(np.hstack(padded))
    return np.vstack(bands)[:-gap, :-gap]


def our_columns(detail: Detail) -> Iterator[Column]:
    """Two plants of each preset of the tasks."""
    for preset in ("one_tomato", "three_tomatoes", "full"):
        for seed in (1, 2):
            plant = generate_plant(preset, seed, detail)
            fruit = len(plant.fruits) // 2 if preset == "three_tomatoes" else min(3, len(plant.fruits) - 1)
            yield plant, fruit, (15.0, -10.0) if preset == "full" else None


def mesh_columns(folder: Path, count: int = 6) -> Iterator[Column]:
    """Plants of a folder of mesh files, each with the ripe fruit that is nearest to the robot."""
    plants = MeshSource.parse(folder).plants
    seeds = plants.seeds(ALL)
    for k in np.unique(np.linspace(0, len(seeds) - 1, count).round().astype(int)):
        plant = plants.grow(seeds[k])
        ripe = [i for i, fruit in enumerate(plant.fruits) if fruit.ripeness == "ripe"]
        yield plant, min(ripe, key=lambda i: float(plant.fruits[i].centre[0])), None


def main(args: Args) -> None:
    """Renders and writes what was asked for."""
    if args.view == "sheet":
        image = sheet(list(our_columns(args.detail) if args.mesh is None else mesh_columns(args.mesh)))
    else:
        plant = generate_plant(args.preset, args.seed, args.detail)
        house = Greenhouse(plant)
        if args.view == "whole":
            image = whole(house, (540, 960))
        else:
            distance = 0.65 if args.view == "camera" else 0.32
            image = at_fruit(house, plant, args.fruit, (1120, 720), distance, args.azimuth, args.elevation)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    quality = [cv2.IMWRITE_JPEG_QUALITY, 88] if args.out.suffix.lower() in (".jpg", ".jpeg") else []
    if not cv2.imwrite(str(args.out), image, quality):
        raise OSError(f"could not write {args.out}; choose a .jpg or .png in a writable folder")
    logger.info("wrote %s", args.out)


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    main(tyro.cli(Args))
