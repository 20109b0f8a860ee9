"""A glasshouse round the plants and the robot, for pictures alone: rays, physics and the games know nothing of it."""

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Final

import numpy as np
import sapien
import sapien.render
from numpy.typing import NDArray

from maniskill_tomato.plants.generator import generate_plant
from maniskill_tomato.plants.kinds import config_of
from maniskill_tomato.plants.organs import Plant, SemanticClass
from maniskill_tomato.plants.row import ROW_SPACING
from maniskill_tomato.plants.seed_splits import SEED_SPLITS
from maniskill_tomato.rendering import surfaces
from maniskill_tomato.rendering.plant_actors import make_render_shape, merged_parts
from maniskill_tomato.rendering.surfaces import tiled_box

Float64 = NDArray[np.float64]

ROW_DISTANCE: Final = 1.6
"""From one row of plants to the next, in [m]: the usual 1.6 m of high-wire tomatoes."""

HALF_LENGTH: Final = 7.0
"""Half of the length of rows that is built, in [m]."""

FLOOR: Final = -0.62
"""Height of the ground cover, in [m]: gutters hang at 0.4 m, and the robot stands on a cart between them."""

SLAB_TOP: Final = -0.12
"""Height of the slabs that the plants root in, in [m]."""

KEPT_FREE: Final = 1.2
"""Half of the length of the first row that is left to the plants of the game, in [m]."""

REACH: Final = (4.2, 3.4)
"""How far along y the first and the second row are planted, in [m]; farther plants would be a few pixels."""

VARIETY: Final = 6
"""Plants that these rows are made of, grown once per process."""

PIPE_RADIUS: Final = 0.0255
"""Of the heating pipes, which carts run on: 51 mm across is the usual size, in [m]."""

_ALONG_Y: Final = [0.7071068, 0.0, 0.0, 0.7071068]


class Glasshouse:
    """Gutters, slabs, pipe rails, posts, rows beside and behind, and the robot's cart, in a SAPIEN scene that renders.

    The rows run along y. Everything but the cart follows the plants' x; each stem stands in a block of rock wool.
    """

    def __init__(self, scene: sapien.Scene) -> None:
        """Builds it with the first row at x = 0; see `place`.

        Args:
            scene: It must have a renderer.
        """
        self._scene = scene
        rng = np.random.default_rng(11)
        self._wool = surfaces.dirty((0.36, 0.3, 0.22), rng, dirt=0.6)
        shapes = [*_hardware(rng), *_rows(rng, self._wool)]
        self._house = self._add(shapes)
        self._add(_cart())
        self._blocks: list[sapien.Entity] = []

    def place(self, row_x: float, feet_w: Float64) -> None:
        """Moves the glasshouse to where the plants stand.

        Args:
            row_x: x of the row, world frame, in [m].
            feet_w: Where the stems leave the ground, world frame, in [m]. Shape (K, 3).
        """
        self._house.pose = sapien.Pose([row_x, 0.0, 0.0])
        while len(self._blocks) < len(feet_w):
            self._blocks.append(self._add([tiled_box([0.05, 0.05, 0.05], self._wool)]))
        below = sapien.Pose([0.0, 0.0, FLOOR - 1.0])
        for number, block in enumerate(self._blocks):
            if number >= len(feet_w):
                block.pose = below
                continue
            x, y, z = feet_w[number]
            block.pose = sapien.Pose([x, y, z - 0.04])

    def _add(self, shapes: Sequence[sapien.render.RenderShape]) -> sapien.Entity:
        body = sapien.render.RenderBodyComponent()
        for shape in shapes:
            body.attach(shape)
        entity = sapien.Entity()
        entity.add_component(body)
        self._scene.add_entity(entity)
        return entity


def light(scene: sapien.Scene) -> None:
    """Lights a scene as on a bright day: the sun from behind the robot, and light from all sides."""
    scene.set_ambient_light([0.03, 0.03, 0.03])
    scene.add_directional_light(
        [0.5, 0.42, -0.76],
        [1.9, 1.8, 1.55],
        shadow=True,
        position=[1.0, 0.0, 0.8],
        shadow_scale=7.0,
        shadow_map_size=2048,
    )
    scene.set_environment_map(surfaces.dome((0.76, 0.8, 0.84), (0.42, 0.43, 0.4), 0.25))


def stem_feet(plant: Plant) -> Float64:
    """Where the stems of a plant, or of a row as one plant, leave the ground, in its frame, in [m]. Shape (K, 3)."""
    stems = [organ.vertices for organ in plant.organs if organ.semantic_class == SemanticClass.STEM]
    if not stems:
        return np.zeros((1, 3))
    points = np.concatenate(stems).astype(np.float64)
    points = points[points[:, 2] < points[:, 2].min() + 0.03]
    order = points[np.argsort(points[:, 1])]
    apart = np.flatnonzero(np.diff(order[:, 1]) > 0.5 * ROW_SPACING) + 1
    return np.stack([foot.mean(0) for foot in np.split(order, apart)])


def _moved(
    shape: sapien.render.RenderShape, place: Sequence[float], turn: Sequence[float] = (1.0, 0.0, 0.0, 0.0)
) -> sapien.render.RenderShape:
    shape.local_pose = sapien.Pose(list(place), list(turn))
    return shape


def _hardware(rng: np.random.Generator) -> list[sapien.render.RenderShape]:
    gutter = surfaces.dirty((0.86, 0.87, 0.86), rng, dirt=0.35)
    slab = surfaces.dirty((0.88, 0.89, 0.88), rng, dirt=0.25)
    ground = surfaces.dirty((0.7, 0.7, 0.67), rng, dirt=0.5)
    pipe = surfaces.plain((0.82, 0.82, 0.8), roughness=0.35)
    steel = surfaces.plain((0.62, 0.64, 0.65), roughness=0.35)
    shapes = [_moved(tiled_box([9.0, HALF_LENGTH + 3.0, 0.01], ground), (0.0, 0.0, FLOOR - 0.01))]
    for k in range(-1, 4):
        x = ROW_DISTANCE * k
        shapes += [
            _moved(tiled_box([0.14, HALF_LENGTH, 0.03], gutter), (x, 0.0, SLAB_TOP - 0.11)),
            _moved(tiled_box([0.1, HALF_LENGTH, 0.04], slab), (x, 0.0, SLAB_TOP - 0.04)),
        ]
        half = 0.5 * (SLAB_TOP - 0.14 - FLOOR)
        for y in np.arange(-HALF_LENGTH, HALF_LENGTH, 1.5):
            shapes.append(_moved(tiled_box([0.02, 0.02, half], pipe), (x, float(y), FLOOR + half)))
        for side in (-0.27, 0.27):
            rail = sapien.render.RenderShapeCylinder(PIPE_RADIUS, HALF_LENGTH, pipe)
            shapes.append(_moved(rail, (x - 0.5 * ROW_DISTANCE + side, 0.0, FLOOR + 0.06), _ALONG_Y))
    for x in (1.5 * ROW_DISTANCE, 2.5 * ROW_DISTANCE):
        for y in np.arange(-6.0, 6.1, 3.0):
            shapes.append(_moved(tiled_box([0.03, 0.03, 2.2], steel), (x, float(y), FLOOR + 2.2)))
    for y in np.arange(-6.0, 6.1, 1.5):
        shapes.append(_moved(tiled_box([7.0, 0.025, 0.05], steel), (0.0, float(y), 3.6)))
    for x in np.arange(-4.0, 6.1, ROW_DISTANCE):
        shapes.append(_moved(tiled_box([0.02, 8.0, 0.02], steel), (float(x), 0.0, 3.66)))
    haze = surfaces.glowing((0.8, 0.84, 0.86))
    for sign in (-1.0, 1.0):
        shapes += [
            _moved(tiled_box([14.0, 0.01, 5.0], haze), (0.0, 9.5 * sign, 0.0)),
            _moved(tiled_box([0.01, 14.0, 5.0], haze), (9.0 * sign, 0.0, 0.0)),
        ]
    return shapes


def _rows(rng: np.random.Generator, wool: sapien.render.RenderMaterial) -> list[sapien.render.RenderShape]:
    """The plants beside those of the game, and a row behind them."""
    shapes: list[sapien.render.RenderShape] = []
    materials: dict[str, sapien.render.RenderMaterial] = {}
    for k, reach in enumerate(REACH):
        for y in np.arange(-reach, reach, 0.9 * ROW_SPACING):
            if k == 0 and abs(y) < KEPT_FREE:
                continue
            number, turn = int(rng.integers(VARIETY)), float(rng.uniform(-0.5, 0.5))
            turn += np.pi if rng.random() < 0.5 else 0.0
            place = (ROW_DISTANCE * k, float(y + rng.normal(0.0, 0.04)), 0.0)
            shapes.append(_moved(tiled_box([0.05, 0.05, 0.05], wool), (place[0], place[1], -0.04)))
            for part in merged_parts([part for organ in _neighbour(number).organs for part in organ.parts]):
                shape = make_render_shape(part, materials)
                shapes.append(_moved(shape, place, (np.cos(0.5 * turn), 0.0, 0.0, np.sin(0.5 * turn))))
    return shapes


@lru_cache(maxsize=VARIETY)
def _neighbour(number: int) -> Plant:
    """A vine with side shoots, dying leaves and trusses in flower, none of which the plants of the games have."""
    seed = SEED_SPLITS["train"][0] + number
    config = replace(
        config_of("full", seed), leaf_density=1.3, wilted_share=0.12, flowering_trusses=1 + number % 3
    )
    return generate_plant(config, seed)


def _cart() -> list[sapien.render.RenderShape]:
    """What the robot's base, at the origin, stands on."""
    steel = surfaces.plain((0.62, 0.64, 0.65), roughness=0.35)
    dark = surfaces.plain((0.13, 0.15, 0.16), roughness=0.5)
    paint = surfaces.plain((0.62, 0.47, 0.16), roughness=0.6)
    wheel = surfaces.plain((0.05, 0.05, 0.05))
    shapes = [
        _moved(tiled_box([0.17, 0.17, 0.02], steel), (0.0, 0.0, -0.02)),
        _moved(tiled_box([0.11, 0.11, 0.16], dark), (0.0, 0.0, -0.2)),
        _moved(tiled_box([0.36, 0.42, 0.05], paint), (0.0, 0.0, -0.41)),
    ]
    for x in (-0.27, 0.27):
        for y in (-0.3, 0.3):
            shapes.append(_moved(sapien.render.RenderShapeCylinder(0.06, 0.03, wheel), (x, y, -0.48)))
    return shapes
