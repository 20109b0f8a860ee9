"""From a seed to a tomato plant: draws the organs, hides fruits if the preset asks for it, meshes."""

from dataclasses import replace
from math import cos, pi, radians, sin, sqrt
from typing import Literal, get_args

import numpy as np

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.plants.fruit import berry_patch, draw_berry
from maniskill_tomato.plants.hiding import choose_clear_directions, clear_view, hang_curtain
from maniskill_tomato.plants.leaf import Leaf, draw_leaf, draw_rachis, leaf_parts
from maniskill_tomato.plants.meshing import Float64, join
from maniskill_tomato.plants.organs import Fruit, Organ, Plant, Ripeness, SemanticClass
from maniskill_tomato.plants.plant_config import PlantConfig, make_config
from maniskill_tomato.plants.random_streams import Stream, normal, stream
from maniskill_tomato.plants.stem import Shoot, grow_shoot, stem_patch
from maniskill_tomato.plants.truss import Hanging, Truss, draw_truss, truss_parts

Detail = Literal["training", "picture"]

FRUIT_CLASS: dict[Ripeness, SemanticClass] = {
    "ripe": SemanticClass.FRUIT_RIPE,
    "turning": SemanticClass.FRUIT_TURNING,
    "green": SemanticClass.FRUIT_GREEN,
}


def _on_stem(shoot: Shoot, height: float, azimuth: float) -> Float64:
    """A point just under the skin of the stem on one of its sides, in [m]. Shape (3,)."""
    z = np.array(height)
    side = np.array([cos(azimuth), sin(azimuth), 0.0])
    return np.asarray(shoot.axis(z) + 0.6 * float(shoot.radius(z)) * side)


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
        truss = draw_truss(config.truss, rng, _on_stem(shoot, height, azimuth), azimuth, berries)
        trusses.append(truss)
    return trusses


def _grow_leaves(config: PlantConfig, shoot: Shoot, seed: int, fruits: list[Hanging]) -> list[Leaf]:
    hiding = config.hiding
    hidden = choose_clear_directions(hiding, fruits, seed) if hiding else []
    lowest = max(shoot.truss_nodes[0] + 1 - config.leaves_kept_below_truss, 0)
    last = len(shoot.heights) - 1
    curtains = {shoot.truss_nodes[i] + 1: i for i in range(len(hidden))}
    density = config.leaf_density
    leaves = []
    for kind in (Stream.LEAF, Stream.SIDE_LEAF):
        side_shoot = kind is Stream.SIDE_LEAF
        share = density - 1.0 if side_shoot else sqrt(density)
        for node in range(lowest, last + 1):
            rng = stream(seed, kind, node)
            # Drawn first, so that the foliage of a lower density is part of that of a higher one.
            if rng.random() >= share:
                continue
            youngest = config.leaf.youngest_size
            vigour = min(1.0, youngest + (1.0 - youngest) * (last - node) / max(config.leaf.young_leaves, 1))
            azimuth = float(shoot.azimuths[node])
            if side_shoot:
                azimuth += radians(40.0) * (1.0 if rng.random() < 0.5 else -1.0)
                vigour *= 0.75
            base = _on_stem(shoot, float(shoot.heights[node]), azimuth)
            if hiding and node in curtains and not side_shoot:
                leaf = hang_curtain(hiding, config.leaf, seed, node, base, hidden, curtains[node])
            else:
                rachis = draw_rachis(config.leaf, rng, base, azimuth, vigour)
                leaf = draw_leaf(config.leaf, rng, rachis, vigour)
                if hiding:
                    leaf = leaf.keeping(clear_view(hiding, leaf, hidden))
            keep = [
                side_shoot or rank < sqrt(density) for rank in rng.random(16).tolist()[: len(leaf.leaflets)]
            ]
            leaf = leaf.keeping(keep)
            if leaf.leaflets:
                leaves.append(leaf)
    return leaves


def generate_plant(
    preset: str | PlantConfig = "full",
    seed: int = 0,
    detail: Detail = "training",
    leaf_density: float | None = None,
) -> Plant:
    """Grows a tomato plant; one seed gives the same plant on every machine.

    Args:
        preset: Name of a preset of `config.PRESETS`, or a configuration.
        seed: Which plant, 0 or greater.
        detail: `training` keeps a plant of the default density under 15,000 triangles, `picture` is finer.
            Both have the same organs at the same places.
        leaf_density: Replaces the configuration's foliage, 0 (no leaves) to 2; 1 is the preset as it is.

    Returns:
        The plant in its own frame: origin at the foot of the stem, z up, the robot at -x; metres.

    Raises:
        InvalidInputError: If a name is unknown, the seed is negative or the density out of range.
    """
    config = make_config(preset) if isinstance(preset, str) else preset
    if detail not in get_args(Detail):
        raise InvalidInputError.choice("detail", detail, get_args(Detail))
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise InvalidInputError(f"seed must be an integer of 0 or more, got {seed!r}")
    if leaf_density is not None:
        config = replace(config, leaf_density=float(leaf_density))
    seed, picture = int(seed), detail == "picture"

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
    return Plant(preset=config.name, seed=seed, detail=detail, organs=tuple(organs), fruits=tuple(described))
