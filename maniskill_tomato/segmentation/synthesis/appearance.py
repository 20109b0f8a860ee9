"""Appearance of a rendered scene: everything that varies between scenes.

Domain randomisation after Tobin et al. 2017 (Domain randomization for transferring deep neural networks from
simulation to the real world); ranges set by comparing renders with photos from greenhouses.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.random import Generator

from maniskill_tomato.plants.kinds import draw_kind
from maniskill_tomato.plants.plant_config import (
    MAX_LEAF_DENSITY,
    FruitConfig,
    LeafConfig,
    PlantConfig,
    TrussConfig,
    make_full_config,
)

Colour = tuple[float, float, float]
Backdrop = Literal["foliage", "gutters", "bright"]


@dataclass(frozen=True, kw_only=True)
class SceneAppearance:
    """One greenhouse, one moment of the day, one crop."""

    crop: PlantConfig
    """What grows in the row in front."""
    leaf_density: float
    """Of all plants, relative to the crop's own."""
    sun_direction: tuple[float, float, float]
    """Where the sunlight goes, in the plant frame (z up, robot at -x)."""
    sun: Colour
    """Linear strength of the sunlight."""
    sky: float
    """Linear strength of the light from all sides."""
    leaf_gain: Colour
    """Factor on the leaves' colours."""
    leaf_blemish: float
    """Share of the blades with yellow or brown spots, 0 to 1."""
    fruit_gain: Colour
    """Factor on the fruits' colours."""
    fruit_bloom: float
    """Share of pale dust and wax on the fruits' colours, 0 to 1."""
    fine_leaves: bool
    """Whether the middle plant's leaves are made of many triangles; that takes longer."""
    gloss: float
    """Factor on the roughness of fruits and leaves."""
    backdrop: Backdrop
    """What stands behind the row."""
    row_distance: float
    """From this row to the next, in [m]."""
    floor: float
    """Height of the ground below the foot of the stems, in [m]; negative."""
    paint: Colour
    """Base colour of gutters and slabs."""
    floor_colour: Colour
    """Base colour of the ground cover."""
    wall: Colour
    """Light that comes from the far wall, linear."""
    greenery: bool
    """Whether that wall shows foliage instead of sky or sheeting."""
    strings: int
    """Wires and strings that hang among the plants."""
    robot: bool
    """Whether another arm works in the row."""


def _gain(rng: Generator, spread: float) -> Colour:
    red, green, blue = np.exp(spread * np.clip(rng.standard_normal(3), -1.6, 1.6))
    return float(red), float(green), float(blue)


OTHER_CROPS = 0.4
"""Share of the rows that are of any kind of plant that `varied` draws, with fruits of any shape."""

OBLATENESS = (0.75, 1.45)
"""Height over width of their fruits: from beef tomatoes to plum tomatoes and peppers, whose boxes photos show too."""


def draw_crop(rng: Generator) -> PlantConfig:
    """The plants of a row: truss, cherry, beef and plum tomatoes on a wire, or any kind of `plants.kinds`."""
    flowering = int(rng.integers(0, 3))
    if rng.random() < OTHER_CROPS:
        return replace(_any_kind(rng), flowering_trusses=flowering)
    full = make_full_config()
    base = replace(
        full,
        stem=replace(full.stem, height=full.stem.height + 0.22 * flowering),
        flowering_trusses=flowering,
        leaves_kept_below_truss=int(rng.integers(1, 4)),
        wilted_share=max(float(rng.uniform(-0.1, 0.12)), 0.0),
    )
    kind = rng.random()
    leaf = replace(
        LeafConfig(), leaflet_aspect=float(rng.uniform(0.6, 0.8)), lobe_depth=float(rng.uniform(0.1, 0.4))
    )
    truss = replace(TrussConfig(), azimuth_spread_deg=float(rng.uniform(30, 60)))
    fruit = FruitConfig()
    counts = base.fruits_per_truss
    if kind < 0.3:  # Cherry tomatoes: long trusses of small fruits.
        small = float(rng.uniform(0.013, 0.02))
        fruit = replace(
            fruit,
            radius_range=(small, small * 1.2),
            oblateness_range=(0.92, 1.12),
            ribs_range=(2, 3),
            fruit_ripening_step=float(rng.uniform(0.03, 0.08)),
            truss_ripening_step=float(rng.uniform(0.12, 0.3)),
        )
        truss = replace(
            truss, pedicel_spacing=float(rng.uniform(0.016, 0.022)), pedicel_length_range=(0.012, 0.022)
        )
        counts = (11, 11, 10, 8, 4)
    elif kind < 0.4:  # Beef tomatoes: few, large, ribbed.
        fruit = replace(fruit, radius_range=(0.036, 0.046), rib_depth_range=(0.015, 0.04))
        truss = replace(truss, pedicel_spacing=0.036)
        counts = (4, 4, 4, 3, 2)
    elif kind < 0.55:  # Plum tomatoes: longer than wide, smooth.
        narrow = float(rng.uniform(0.016, 0.025))
        fruit = replace(
            fruit,
            radius_range=(narrow, narrow * 1.15),
            oblateness_range=(1.15, 1.5),
            ribs_range=(2, 4),
            shoulder_dent=0.08,
            truss_ripening_step=float(rng.uniform(0.12, 0.3)),
        )
        truss = replace(truss, pedicel_spacing=0.022)
        counts = (8, 8, 7, 6, 3)
    else:
        fruit = replace(
            fruit,
            truss_ripening_step=float(rng.uniform(0.14, 0.34)),
            fruit_ripening_step=float(rng.uniform(0.02, 0.07)),
        )
    return replace(base, leaf=leaf, truss=truss, fruit=fruit, fruits_per_truss=counts)


def _any_kind(rng: Generator) -> PlantConfig:
    crop = draw_kind(int(rng.integers(2**31)))
    tall, deep = float(rng.uniform(*OBLATENESS)), float(rng.uniform(0.004, 0.08))
    return replace(
        crop,
        fruit=replace(
            crop.fruit,
            oblateness_range=(0.96 * tall, 1.04 * tall),
            ribs_range=(3, 6),
            rib_depth_range=(0.5 * deep, deep),
        ),
    )


ROBOT_SHARE = 0.12
"""Share of the scenes in which another arm works, where nothing else is asked for."""


def draw_appearance(
    rng: Generator, *, vary_crop: bool = True, robot_share: float = ROBOT_SHARE
) -> SceneAppearance:
    """Draws the appearance of a scene.

    Args:
        rng: Its random numbers.
        vary_crop: Whether the crop is drawn too; otherwise it is the tasks' own `full` plant.
        robot_share: How often another arm works in the row, 0 to 1.
    """
    crop = draw_crop(rng) if vary_crop else make_full_config()
    azimuth, height = rng.uniform(0, 2 * np.pi), np.deg2rad(rng.uniform(25, 75))
    overcast = rng.random()
    strength = 2.6 * (1 - overcast) ** 1.5
    warm = float(np.clip(rng.normal(0.0, 0.06), -0.1, 0.12))
    paint = float(rng.uniform(0.45, 0.95))
    ground = float(rng.uniform(0.25, 0.9))
    backdrop: Backdrop = "gutters"
    if (kind := rng.random()) < 0.55:
        backdrop = "foliage"
    elif kind < 0.7:
        backdrop = "bright"
    wall = float(np.exp(rng.uniform(np.log(0.2), np.log(3.0))))
    return SceneAppearance(
        crop=crop,
        leaf_density=min(crop.leaf_density * float(rng.uniform(0.6, 1.9)), MAX_LEAF_DENSITY)
        if vary_crop
        else 1.0,
        sun_direction=(
            float(np.cos(azimuth) * np.cos(height)),
            float(np.sin(azimuth) * np.cos(height)),
            -float(np.sin(height)),
        ),
        sun=(strength * (1 + warm), strength, strength * (1 - 1.5 * warm)),
        sky=float(rng.uniform(0.5, 1.2)),
        leaf_gain=_leaf_gain(rng),
        leaf_blemish=float(rng.beta(1, 4)),
        fruit_gain=_gain(rng, 0.06),
        fruit_bloom=float(rng.uniform(0.1, 0.42)),
        fine_leaves=bool(rng.random() < 0.4),
        gloss=float(rng.uniform(0.7, 1.6)),
        backdrop=backdrop,
        row_distance=float(rng.uniform(1.0, 1.7)),
        floor=-float(rng.uniform(0.15, 0.8)),
        paint=(paint, paint * float(rng.uniform(0.96, 1.02)), paint * float(rng.uniform(0.9, 1.04))),
        floor_colour=(ground, ground * float(rng.uniform(0.94, 1.0)), ground * float(rng.uniform(0.82, 1.0))),
        wall=(wall, wall * float(rng.uniform(0.95, 1.08)), wall * float(rng.uniform(0.9, 1.1))),
        greenery=bool(rng.random() < 0.6),
        strings=int(rng.integers(0, 9)),
        robot=bool(rng.random() < robot_share),
    )


def _leaf_gain(rng: Generator) -> Colour:
    light = float(np.exp(rng.normal(0.0, 0.18)))
    red, green, blue = _gain(rng, 0.08)
    return light * red, light * green, light * blue
