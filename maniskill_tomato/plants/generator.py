"""From a seed to a tomato plant: draws the organs, hides fruits if the preset asks for it, meshes."""

from dataclasses import replace
from math import cos, pi, radians, sin, sqrt
from typing import Literal, get_args

import numpy as np

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.plants.clutter import clutter_organs
from maniskill_tomato.plants.flower import grow_flowers
from maniskill_tomato.plants.fruit import berry_patch, draw_berry
from maniskill_tomato.plants.hiding import choose_clear_directions, clear_view, hang_curtain
from maniskill_tomato.plants.kinds import config_of
from maniskill_tomato.plants.leaf import Leaf, draw_leaf, draw_rachis, leaf_parts, wilted
from maniskill_tomato.plants.meshing import join
from maniskill_tomato.plants.organs import Fruit, Organ, Plant, Ripeness, SemanticClass, placed
from maniskill_tomato.plants.plant_config import PlantConfig
from maniskill_tomato.plants.random_streams import Stream, normal, stream, uniform
from maniskill_tomato.plants.stem import Shoot, grow_shoot, stem_patch
from maniskill_tomato.plants.truss import Hanging, Truss, draw_truss, truss_parts

Detail = Literal["training", "picture"]

SIDE_ANGLES_DEG = (40.0, 75.0, 110.0)
"""Angle of the side-shoot leaves of a node to its leaf, in [deg]: as many as `MAX_LEAF_DENSITY` asks for; [looks]."""

SIDE_TURNS = len(SIDE_ANGLES_DEG)

FRUIT_CLASS: dict[Ripeness, SemanticClass] = {
    "ripe": SemanticClass.FRUIT_RIPE,
    "turning": SemanticClass.FRUIT_TURNING,
    "green": SemanticClass.FRUIT_GREEN,
}


def _grow_trusses(config: PlantConfig, shoot: Shoot, seed: int) -> list[Truss]:
    trusses = []
    for k, (node, count) in enumerate(zip(shoot.truss_nodes, config.fruits_per_truss, strict=True)):
        if node >= len(shoot.heights) or count == 0:
            continue
        rng = stream(seed, Stream.TRUSS, k)
        if config.hiding:
            azimuth = float(shoot.azimuths[node + 1]) + radians(
                normal(rng, 0.0, config.hiding.truss_spread_deg)
            )
            # Trusses lean to the aisle, so the outer ones turn back part of the way.
            aside = (azimuth - pi + pi) % (2 * pi) - pi
            azimuth = pi + config.hiding.truss_lean * aside
        else:
            azimuth = pi + radians(normal(rng, 0.0, config.truss.azimuth_spread_deg, 2.0))
        height = float(shoot.heights[node]) + 0.012
        berries = [
            draw_berry(config.fruit, stream(seed, Stream.FRUIT, 100 * k + i), k, i) for i in range(count)
        ]
        truss = draw_truss(config.truss, rng, shoot.on_skin(height, azimuth), azimuth, berries)
        trusses.append(truss)
    return trusses


def _grow_leaves(config: PlantConfig, shoot: Shoot, seed: int, fruits: list[Hanging]) -> list[Leaf]:
    hiding = config.hiding
    hidden = choose_clear_directions(hiding, fruits, seed) if hiding else []
    lowest = max(shoot.truss_nodes[0] + 1 - config.leaves_kept_below_truss, 0)
    last = len(shoot.heights) - 1
    curtains = {shoot.truss_nodes[i] + 1: i for i in range(len(hidden))}
    density, wilting = config.leaf_density, wilted(config.leaf)
    leaves = []
    for turn in range(SIDE_TURNS + 1):
        side_shoot = turn > 0
        kind = Stream.SIDE_LEAF if side_shoot else Stream.LEAF
        share = density - turn if side_shoot else sqrt(density)
        for node in range(lowest, last + 1):
            rng = stream(seed, kind, node + 1000 * max(turn - 1, 0))
            # Drawn first, so that the foliage of a lower density is part of that of a higher one.
            if rng.random() >= share:
                continue
            youngest = config.leaf.youngest_size
            vigour = min(1.0, youngest + (1.0 - youngest) * (last - node) / max(config.leaf.young_leaves, 1))
            azimuth = float(shoot.azimuths[node])
            if side_shoot:
                azimuth += radians(SIDE_ANGLES_DEG[turn - 1]) * (1.0 if rng.random() < 0.5 else -1.0)
                vigour *= 0.75
            base = shoot.on_skin(float(shoot.heights[node]), azimuth)
            if hiding and node in curtains and not side_shoot:
                leaf = hang_curtain(hiding, config.leaf, seed, node, base, hidden, curtains[node])
            else:
                dying = config.wilted_share > 0.0 and bool(
                    stream(seed, Stream.WILTED, 100 * node + turn).random() < config.wilted_share
                )
                numbers = wilting if dying else config.leaf
                rachis = draw_rachis(numbers, rng, base, azimuth, vigour)
                leaf = replace(draw_leaf(numbers, rng, rachis, vigour), is_wilted=dying)
                if hiding:
                    leaf = leaf.keeping(clear_view(hiding, leaf, hidden))
            keep = [
                side_shoot or rank < sqrt(density)
                for rank in rng.random(max(16, len(leaf.leaflets))).tolist()[: len(leaf.leaflets)]
            ]
            leaf = leaf.keeping(keep)
            if leaf.leaflets:
                leaves.append(leaf)
    return leaves


def _shoot(config: PlantConfig, seed: int, detail: Detail) -> Plant:
    """One shoot with all that grows on it."""
    picture = detail == "picture"
    shoot = grow_shoot(config, seed)
    trusses = _grow_trusses(config, shoot, seed)
    fruits = [hanging for truss in trusses for hanging in truss.fruits]
    leaves = _grow_leaves(config, shoot, seed, fruits)

    organs = [Organ("stem", SemanticClass.STEM, (join([stem_patch(shoot, picture=picture)], "stem"),))]
    for i, leaf in enumerate(leaves):
        organs.append(Organ(f"leaf_{i:02d}", SemanticClass.LEAF, leaf_parts(leaf, picture=picture)))
    for i, truss in enumerate(trusses):
        parts = truss_parts(config.truss, truss, picture=picture)
        organs.append(Organ(f"truss_{i:02d}", SemanticClass.STEM, parts))
    described = []
    for i, hanging in enumerate(fruits):
        berry = hanging.berry
        centre = np.round(hanging.centre, 6)
        skin = join(
            [berry_patch(berry, hanging.centre, picture=picture)], f"fruit_{berry.ripeness}_{berry.variant}"
        )
        away = skin.vertices.astype(np.float64) - centre.astype(np.float32)
        radius = round(float(np.sqrt((away * away).sum(1).max())), 6) + 1e-6
        described.append(Fruit(len(organs), centre.astype(np.float32), radius, berry.ripeness))
        organs.append(Organ(f"fruit_{i:02d}", FRUIT_CLASS[berry.ripeness], (skin,)))
    for i, parts in enumerate(grow_flowers(config, shoot, seed)):
        organs.append(Organ(f"flowers_{i:02d}", SemanticClass.STEM, parts))
    return Plant(preset=config.name, seed=seed, detail=detail, organs=tuple(organs), fruits=tuple(described))


def _bush(config: PlantConfig, seed: int, detail: Detail) -> Plant:
    """Several shoots that lean away from their middle."""
    rng = stream(seed, Stream.SHOOT)
    first = 2 * pi * rng.random()
    organs: list[Organ] = []
    fruits: list[Fruit] = []
    for k in range(config.shoots):
        # The first shoot leans too; each has random numbers of its own.
        own = seed if k == 0 else int(stream(seed, Stream.SHOOT, k).integers(2**31))
        away = first + 2 * pi * k / config.shoots + normal(rng, 0.0, 0.25)
        lean = radians(uniform(rng, config.shoot_lean_range_deg))
        turn = np.array([[cos(away), -sin(away), 0.0], [sin(away), cos(away), 0.0], [0.0, 0.0, 1.0]])
        tilt = np.array([[cos(lean), 0.0, sin(lean)], [0.0, 1.0, 0.0], [-sin(lean), 0.0, cos(lean)]])
        rotation = (turn @ tilt @ turn.T).astype(np.float32)
        place = np.array([0.02 * cos(away), 0.02 * sin(away), 0.0], dtype=np.float32)
        shoot = placed(_shoot(config, own, detail), rotation, place)
        fruits += [replace(f, organ_index=f.organ_index + len(organs)) for f in shoot.fruits]
        organs += [replace(o, name=f"shoot_{k}/{o.name}") for o in shoot.organs]
    return Plant(preset=config.name, seed=seed, detail=detail, organs=tuple(organs), fruits=tuple(fruits))


def generate_plant(
    preset: str | PlantConfig = "full",
    seed: int = 0,
    detail: Detail = "training",
    leaf_density: float | None = None,
) -> Plant:
    """Grows a tomato plant; one seed gives the same plant on every machine.

    Args:
        preset: Name of a preset of `kinds.PLANT_NAMES`, or a configuration.
        seed: Which plant, 0 or greater.
        detail: `training` keeps a plant of the default density under 15,000 triangles, `picture` is finer.
            Both have the same organs at the same places.
        leaf_density: Replaces the configuration's foliage, 0 (no leaves) to 4; 1 is the preset as it is.

    Returns:
        The plant in its own frame: origin at the foot of the stem, z up, the robot at -x; metres.

    Raises:
        InvalidInputError: If a name is unknown, the seed is negative or the density out of range.
    """
    if detail not in get_args(Detail):
        raise InvalidInputError.choice("detail", detail, get_args(Detail))
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise InvalidInputError(f"seed must be an integer of 0 or more, got {seed!r}")
    config = config_of(preset, int(seed)) if isinstance(preset, str) else preset
    if leaf_density is not None:
        config = replace(config, leaf_density=float(leaf_density))
    seed = int(seed)
    plant = _shoot(config, seed, detail) if config.shoots == 1 else _bush(config, seed, detail)
    if not config.clutter:
        return plant
    return replace(plant, organs=(*plant.organs, *clutter_organs(seed, config.clutter)))
