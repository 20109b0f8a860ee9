"""Leaves before a fruit: hang them so that the robot's side is covered, and keep one way of looking clear."""

from dataclasses import dataclass
from math import cos, pi, radians, sin, tan

import numpy as np

from maniskill_tomato.plants.leaf import Leaf, draw_leaf, draw_rachis, leaflet_points
from maniskill_tomato.plants.leaflet import Leaflet, coarse_triangles
from maniskill_tomato.plants.meshing import Float64, cross, normalized
from maniskill_tomato.plants.plant_config import HidingConfig, LeafConfig
from maniskill_tomato.plants.random_streams import Stream, stream, uniform
from maniskill_tomato.plants.truss import Hanging

DISC_POINTS = 32


@dataclass(frozen=True, eq=False)
class HiddenFruit:
    """A fruit that leaves shall cover, and the direction that they shall leave open."""

    fruit: Hanging
    clear: Float64
    """Unit vector from the fruit towards the viewpoint that sees all of it. Shape (3,)."""


def view_direction(azimuth_deg: float, elevation_deg: float) -> Float64:
    """Unit vector from a fruit towards a camera; azimuth 0 is the robot's side (-x), positive towards +y."""
    azimuth, elevation = radians(azimuth_deg), radians(elevation_deg)
    return np.array(
        [-cos(elevation) * cos(azimuth), cos(elevation) * sin(azimuth), sin(elevation)],
    )


def choose_clear_directions(config: HidingConfig, fruits: list[Hanging], seed: int) -> list[HiddenFruit]:
    """Draws for each fruit the direction from which it can be seen."""
    hidden = []
    for i, fruit in enumerate(fruits):
        rng = stream(seed, Stream.VIEW, i)
        side = -1.0 if rng.random() < config.clear_right_share else 1.0
        azimuth = side * uniform(rng, config.clear_azimuth_range_deg)
        hidden.append(
            HiddenFruit(fruit, view_direction(azimuth, uniform(rng, config.clear_elevation_range_deg)))
        )
    return hidden


def _disc(radius: float, direction: Float64) -> tuple[Float64, Float64, Float64]:
    """Two axes across a direction and points spread over a disc in them. Shapes (3,), (3,), (N, 2)."""
    right = normalized(cross(direction, np.array([0.0, 0.0, 1.0])))
    up = cross(right, direction)
    index = np.arange(DISC_POINTS) + 0.5
    r, turn = radius * np.sqrt(index / DISC_POINTS), index * (pi * (3.0 - 5.0**0.5))
    return right, up, np.stack([r * np.cos(turn), r * np.sin(turn)], 1)


def uncovered_share(fruit: Hanging, triangles: Float64, direction: Float64) -> float:
    """Share of a fruit's disc that triangles leave open in a parallel view along a direction.

    Args:
        fruit: The fruit.
        triangles: Corners, in [m]. Shape (T, 3, 3).
        direction: Unit vector from the fruit towards the viewer. Shape (3,).
    """
    right, up, disc = _disc(fruit.berry.radius, direction)
    away = triangles - fruit.centre
    before = (away @ direction).mean(1) > 0
    x, y = away[before] @ right, away[before] @ up
    near = (np.abs(x).min(1) < 0.08) & (np.abs(y).min(1) < 0.08)
    x, y = x[near], y[near]
    if not len(x):
        return 1.0
    px, py = disc[:, 0, None], disc[:, 1, None]

    def edge(i: int, j: int) -> Float64:
        return np.asarray((x[:, j] - x[:, i]) * (py - y[:, i]) - (y[:, j] - y[:, i]) * (px - x[:, i]))

    a, b, c = edge(0, 1), edge(1, 2), edge(2, 0)
    inside = ((a >= 0) & (b >= 0) & (c >= 0)) | ((a <= 0) & (b <= 0) & (c <= 0))
    return 1.0 - float(inside.any(1).mean())


def blade_triangles(leaflets: tuple[Leaflet, ...]) -> Float64:
    """The coarse triangles of some leaflets, in [m]. Shape (T, 3, 3)."""
    return np.concatenate([coarse_triangles(leaflet) for leaflet in leaflets if not leaflet.small])


def in_corridor(points: Float64, hidden: HiddenFruit, *, share: float, half_angle_deg: float) -> bool:
    """Whether any point stands in the corridor from a fruit along its clear direction.

    Args:
        points: Points, in [m]. Shape (N, 3).
        hidden: The fruit and its clear direction.
        share: Radius of the corridor at the fruit over the fruit's radius.
        half_angle_deg: Half angle by which it widens away from the fruit, in [deg].
    """
    away = points - hidden.fruit.centre
    ahead = away @ hidden.clear
    across = np.sqrt(np.maximum((away * away).sum(1) - ahead * ahead, 0.0))
    width = share * hidden.fruit.berry.radius + ahead * tan(radians(half_angle_deg))
    return bool(((ahead > 0) & (across < width)).any())


def clear_view(config: HidingConfig, leaf: Leaf, hidden: list[HiddenFruit]) -> list[bool]:
    """For each leaflet whether it may stay, since it blocks no fruit's clear direction."""
    stalk = leaf.rachis.points(24)
    if any(in_corridor(stalk, target, share=1.0, half_angle_deg=0.0) for target in hidden):
        return [False] * len(leaf.leaflets)
    angle = config.clear_half_angle_deg
    points = [leaflet_points(leaflet) for leaflet in leaf.leaflets]
    return [
        not any(in_corridor(p, target, share=1.04, half_angle_deg=angle) for target in hidden) for p in points
    ]


def hang_curtain(
    config: HidingConfig,
    leaf_config: LeafConfig,
    seed: int,
    node: int,
    base: Float64,
    hidden: list[HiddenFruit],
    which: int,
) -> Leaf:
    """A leaf that covers a fruit from the robot's side: the best of a few that are aimed at it.

    Args:
        config: How fruits are hidden.
        leaf_config: Ranges of the leaf's numbers.
        seed: The plant's seed.
        node: Its node on the main shoot.
        base: Where the leaf leaves the stem, in [m]. Shape (3,).
        hidden: All fruits that are hidden, with their clear directions.
        which: Index of the one to cover.
    """
    own = hidden[which]
    fruit = own.fruit
    across = own.clear - np.array([own.clear[0], 0.0, 0.0])
    covered = [view_direction(*view) for view in config.covered_views_deg]
    candidates: list[tuple[float, int, Leaf]] = []
    for attempt in range(config.attempts):
        rng = stream(seed, Stream.CURTAIN, 64 * node + attempt)
        gap = fruit.berry.radius + uniform(rng, config.gap_range)
        # The leaflet hangs off to the side that need not stay clear.
        offset = -uniform(rng, config.offset_range) * across
        target = fruit.centre + np.array([-gap, 0.0, 0.0]) + offset
        rachis = draw_rachis(leaf_config, rng, base, pi, 1.0)
        leaf = draw_leaf(leaf_config, rng, rachis, 1.0, target=target)
        blocked = [
            in_corridor(leaflet_points(x), own, share=config.curtain_clear_share, half_angle_deg=0.0)
            for x in leaf.leaflets[1:]
        ]
        leaf = leaf.keeping([True] + [not b for b in blocked])
        triangles = blade_triangles(leaf.leaflets)
        score = float(np.mean([uncovered_share(fruit, triangles, view) for view in covered]))
        for other in hidden:
            side = uncovered_share(other.fruit, triangles, other.clear)
            score += 4.0 * max(0.0, config.clear_share - side)
        candidates.append((round(score, 6), attempt, leaf))
    return min(candidates, key=lambda candidate: candidate[:2])[2]
