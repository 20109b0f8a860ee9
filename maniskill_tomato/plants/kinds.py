"""Plants of many kinds: each plant draws the numbers of its own kind before it grows.

`varied` draws them from the ranges that policies learn on. `other_kind` draws at least three of them from beyond these
ranges, so that a plant of it is of no kind that was learnt. The ranges hold what is grown as tomato, from cherry
bushes to beef tomatoes on a wire, and a little more, for domain randomisation [Tobin et al. 2017]: things that are no
plant stand about, too.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np
from numpy.random import Generator

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.plants.plant_config import (
    PRESETS,
    FruitConfig,
    LeafConfig,
    PlantConfig,
    StemConfig,
    TrussConfig,
)
from maniskill_tomato.plants.random_streams import Stream, stream, uniform

Range = tuple[float, float]

BEYOND_SHARE: Final = 0.35
"""Share of the traits of a plant of `other_kind` that lie beyond what is learnt, in the mean."""

LEAST_BEYOND: Final = 3
"""At least so many of them do."""

GREENHOUSE_SHARE: Final = 0.3
"""Share of the plants of `varied` that are the pruned vines of the preset `full`."""

GREENHOUSE_DENSITY: Final = (0.8, 1.8)
"""Their foliage, that of the general task."""

BUSH_SHARE: Final = 0.35
"""Share of the plants that are bushes of several shoots instead of one vine."""


@dataclass(frozen=True, kw_only=True)
class Trait:
    """A number in which kinds of plants differ."""

    name: str
    """What it is."""
    learnt: Range
    """Where `varied` draws it from."""
    beyond: tuple[Range, ...]
    """Where `other_kind` may draw it from instead."""


TRAITS: Final[tuple[Trait, ...]] = (
    Trait(name="internode", learnt=(0.045, 0.085), beyond=((0.035, 0.045), (0.085, 0.11))),
    Trait(name="height", learnt=(1.1, 1.6), beyond=((0.9, 1.1), (1.6, 1.9))),
    Trait(name="leaves_per_truss", learnt=(2.0, 4.0), beyond=((1.0, 1.99),)),
    Trait(name="leaf_length", learnt=(0.18, 0.38), beyond=((0.12, 0.18), (0.38, 0.48))),
    Trait(name="leaf_insertion_deg", learnt=(45.0, 75.0), beyond=((35.0, 45.0), (75.0, 90.0))),
    Trait(name="leaf_end_angle_deg", learnt=(105.0, 150.0), beyond=((75.0, 105.0), (150.0, 165.0))),
    Trait(name="leaflet_length", learnt=(0.08, 0.16), beyond=((0.055, 0.08), (0.16, 0.21))),
    Trait(name="leaflet_aspect", learnt=(0.45, 0.9), beyond=((0.3, 0.45), (0.9, 1.1))),
    Trait(name="lobe_depth", learnt=(0.05, 0.45), beyond=((0.0, 0.05), (0.45, 0.6))),
    Trait(name="leaflet_curl_deg", learnt=(15.0, 75.0), beyond=((75.0, 110.0),)),
    Trait(name="leaflet_droop", learnt=(0.15, 1.0), beyond=((1.0, 2.0),)),
    Trait(name="leaf_density", learnt=(0.6, 2.6), beyond=((0.3, 0.6), (2.6, 4.0))),
    Trait(name="lower_leaves", learnt=(0.0, 5.0), beyond=((5.0, 8.0),)),
    Trait(name="wilted_share", learnt=(0.0, 0.15), beyond=((0.15, 0.4),)),
    Trait(name="truss_spread_deg", learnt=(20.0, 90.0), beyond=((90.0, 180.0),)),
    Trait(name="truss_end_angle_deg", learnt=(125.0, 175.0), beyond=((80.0, 125.0),)),
    Trait(name="fruits", learnt=(2.0, 9.0), beyond=((1.0, 1.99), (9.0, 14.0))),
    Trait(name="fruit_radius", learnt=(0.014, 0.036), beyond=((0.010, 0.014), (0.036, 0.048))),
    Trait(name="oblateness", learnt=(0.8, 1.15), beyond=((0.65, 0.8), (1.15, 1.5))),
    Trait(name="ripening_step", learnt=(0.1, 0.32), beyond=((0.0, 0.1),)),
    Trait(name="clutter", learnt=(0.0, 5.0), beyond=((5.0, 12.0),)),
)
"""Units as in `plant_config`; `docs/plants.md` says what each does."""


def draw_traits(seed: int, *, is_other: bool = False) -> dict[str, float]:
    """The traits of a plant by their names; see `draw_kind`."""
    return _traits(stream(seed, Stream.KIND), is_other)


def _traits(rng: Generator, is_other: bool) -> dict[str, float]:
    chance = np.array([rng.random() for _ in TRAITS])
    is_beyond = chance < BEYOND_SHARE
    is_beyond[np.argsort(chance, kind="stable")[:LEAST_BEYOND]] = True
    values = {}
    for trait, beyond in zip(TRAITS, is_beyond.tolist(), strict=True):
        part, turn = float(rng.random()), float(rng.random())
        low, high = trait.learnt
        if is_other and beyond:
            low, high = trait.beyond[int(turn * len(trait.beyond))]
        values[trait.name] = low + (high - low) * part
    return values


def draw_kind(seed: int, *, is_other: bool = False) -> PlantConfig:
    """The configuration of a plant of a kind of its own.

    Args:
        seed: The plant's.
        is_other: Whether some of its traits lie beyond those that are learnt.
    """
    rng = stream(seed, Stream.KIND)
    v = _traits(rng, is_other)
    is_bush = bool(rng.random() < BUSH_SHARE)
    if not is_other and rng.random() < GREENHOUSE_SHARE:
        return replace(PRESETS["full"](), name="varied", leaf_density=uniform(rng, GREENHOUSE_DENSITY))
    shoots = 2 + int(3 * rng.random()) if is_bush else 1
    radius, around, leaf = v["fruit_radius"], 0.08, v["leaf_length"]
    fruits = max(round(v["fruits"]), 1)
    counts = tuple(max(fruits - k, 1) for k in range(3 if is_bush else 5))
    return PlantConfig(
        name="other_kind" if is_other else "varied",
        stem=replace(
            StemConfig(),
            height=v["height"] * (0.75 if is_bush else 1.0),
            internode_length=v["internode"],
            lower_internode_length=0.75 * v["internode"],
            nodes_below_first_truss=max(round(uniform(rng, (0.30, 0.48)) / (0.75 * v["internode"])), 3),
            leaves_per_truss=round(v["leaves_per_truss"]),
        ),
        leaf=replace(
            LeafConfig(),
            length_range=(leaf * (1.0 - 2.0 * around), leaf * (1.0 + 2.0 * around)),
            insertion_deg=v["leaf_insertion_deg"],
            end_angle_range_deg=(v["leaf_end_angle_deg"] - 12.0, v["leaf_end_angle_deg"] + 12.0),
            pairs_range=(1, 2) if rng.random() < 0.3 else (2, 4),
            leaflet_length_range=(0.87 * v["leaflet_length"], 1.13 * v["leaflet_length"]),
            leaflet_aspect=v["leaflet_aspect"],
            lobe_depth=v["lobe_depth"],
            lobes_per_side=uniform(rng, (2.0, 5.0)),
            leaflet_curl_range_deg=(max(v["leaflet_curl_deg"] - 15.0, 0.0), v["leaflet_curl_deg"] + 15.0),
            leaflet_droop_range=(0.6 * v["leaflet_droop"], 1.4 * v["leaflet_droop"]),
            intercalary_per_gap=int(3 * rng.random()),
        ),
        truss=replace(
            TrussConfig(),
            azimuth_spread_deg=v["truss_spread_deg"],
            end_angle_deg=v["truss_end_angle_deg"],
            # Fruits of a truss touch rather than stand apart.
            pedicel_spacing=radius * uniform(rng, (0.7, 1.1)),
            pedicel_length_range=(0.6 * radius + 0.008, 0.8 * radius + 0.012),
        ),
        fruit=replace(
            FruitConfig(),
            radius_range=((1.0 - around) * radius, (1.0 + around) * radius),
            oblateness_range=(v["oblateness"] - 0.04, v["oblateness"] + 0.04),
            truss_ripening_step=v["ripening_step"],
            fruit_ripening_step=uniform(rng, (0.0, 0.06)),
        ),
        fruits_per_truss=counts,
        leaves_kept_below_truss=round(v["lower_leaves"]),
        leaf_density=v["leaf_density"] * (0.7 if is_bush else 1.0),
        shoots=shoots,
        wilted_share=v["wilted_share"],
        clutter=round(v["clutter"]),
    )


KINDS: dict[str, Callable[[int], PlantConfig]] = {
    "varied": draw_kind,
    "other_kind": partial(draw_kind, is_other=True),
}
"""Presets whose plants are each of a kind of its own, drawn by their seed."""

PLANT_NAMES: Final = (*PRESETS, *KINDS)
"""All presets."""


def config_of(preset: str, seed: int) -> PlantConfig:
    """The configuration of a plant by its preset and seed.

    Raises:
        InvalidInputError: If there is no such preset.
    """
    if preset in KINDS:
        return KINDS[preset](seed)
    if preset not in PRESETS:
        raise InvalidInputError.choice("preset", preset, PLANT_NAMES)
    return PRESETS[preset]()
