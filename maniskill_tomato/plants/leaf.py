"""Leaves: a drooping stalk (rachis) with uneven pairs of leaflets and small ones between them."""

from dataclasses import dataclass, replace
from math import atan2, cos, pi, radians, sin, sqrt

import numpy as np
from numpy.random import Generator

from maniskill_tomato.plants.leaflet import Leaflet, both_sides, coarse_triangles
from maniskill_tomato.plants.meshing import Float64, Patch, cross, hanging_curve, join, normalized, tube
from maniskill_tomato.plants.organs import MeshPart
from maniskill_tomato.plants.plant_config import LeafConfig
from maniskill_tomato.plants.random_streams import normal, uniform

DOWN = np.array([0.0, 0.0, -1.0])
LEAF_VARIANTS = 4
"""Number of leaf textures among which a leaf draws its own."""


@dataclass(frozen=True, eq=False)
class Rachis:
    """Petiole and rachis as one curve."""

    base: Float64
    """Where it leaves the stem, in the plant frame, in [m]. Shape (3,)."""
    azimuth: float
    """Direction at the base, in [rad] from +x about z."""
    start_angle: float
    """Angle to the upward vertical at the base, in [rad]."""
    end_angle: float
    """Angle to the upward vertical at the tip, in [rad]."""
    length: float
    """Arc length, in [m]."""
    sway: float
    """Turn of the azimuth from base to tip, in [rad]."""

    def points(self, count: int) -> Float64:
        """Points from base to tip, in [m]. Shape (count, 3)."""
        return hanging_curve(
            self.base, self.azimuth, self.start_angle, self.end_angle, self.length, count, sway=self.sway
        )


@dataclass(frozen=True, eq=False)
class Leaf:
    """A leaf before it is meshed."""

    rachis: Rachis
    radius: float
    """Radius of the petiole at the stem, in [m]."""
    leaflets: tuple[Leaflet, ...]
    stalks: tuple[tuple[Float64, Float64], ...]
    """Start and end of each leaflet's own stalk, in [m]; as many as leaflets."""
    variant: int
    """Which leaf texture it has."""
    is_wilted: bool = False
    """Whether it is dying."""

    def keeping(self, keep: list[bool]) -> "Leaf":
        """The leaf with some of its leaflets left out."""
        return replace(
            self,
            leaflets=tuple(x for x, k in zip(self.leaflets, keep, strict=True) if k),
            stalks=tuple(x for x, k in zip(self.stalks, keep, strict=True) if k),
        )


def _droop(direction: Float64, weight: float) -> Float64:
    return normalized(direction + weight * DOWN)


def draw_rachis(config: LeafConfig, rng: Generator, base: Float64, azimuth: float, vigour: float) -> Rachis:
    """Draws a leaf's stalk.

    Args:
        config: Ranges of its numbers.
        rng: Its random numbers.
        base: Where it leaves the stem, in [m]. Shape (3,).
        azimuth: Direction of its node, in [rad].
        vigour: Size relative to a grown leaf, 0 to 1; young leaves are short and upright.
    """
    start = radians(normal(rng, config.insertion_deg, config.insertion_spread_deg))
    end = radians(uniform(rng, config.end_angle_range_deg))
    length = uniform(rng, config.length_range) * vigour
    sway = radians(normal(rng, 0.0, 2 * config.sway_spread_deg))
    turned = azimuth + radians(normal(rng, 0.0, config.sway_spread_deg))
    young = 1.0 - vigour
    return Rachis(base, turned, start * (1 - 0.35 * young), end + (radians(62) - end) * young, length, sway)


def aim_rachis(rachis: Rachis, target: Float64, leaflet_length: float, droop: float) -> Rachis:
    """Bends a leaf's stalk so that the middle of its terminal leaflet hangs at a point.

    Searches length and end angle on a fixed grid; a leaf bends to the light of the aisle in the same way.

    Args:
        rachis: The stalk as drawn; base and start angle stay.
        target: The point, in the plant frame, in [m]. Shape (3,).
        leaflet_length: Length of the terminal leaflet, in [m].
        droop: Pull of gravity on it.
    """
    away = target - rachis.base
    azimuth = atan2(float(away[1]), float(away[0]))
    reach, rise = sqrt(float(away[0]) ** 2 + float(away[1]) ** 2), float(away[2])
    end = np.radians(np.arange(95.0, 176.0, 3.0))[:, None]
    length = (0.10 + 0.015 * np.arange(20))[None]
    part = ((np.arange(24) + 0.5) / 24) ** 1.25
    polar = rachis.start_angle + (end - rachis.start_angle) * part
    out, up = np.sin(polar).mean(1, keepdims=True), np.cos(polar).mean(1, keepdims=True)
    hang_out, hang_up = np.sin(end), np.cos(end) - droop
    half = 0.48 * leaflet_length / np.sqrt(hang_out**2 + hang_up**2)
    miss = np.sqrt((length * out + half * hang_out - reach) ** 2 + (length * up + half * hang_up - rise) ** 2)
    # A small preference for long, well bent leaves among those that hit.
    miss = np.round(miss + 0.01 * np.abs(length - 0.26), 9)
    row, column = divmod(int(np.argmin(miss)), miss.shape[1])
    end_angle, arc = float(end[row, 0]), float(length[0, column])
    return replace(rachis, azimuth=azimuth, end_angle=end_angle, length=arc, sway=0.0)


def draw_leaf(
    config: LeafConfig, rng: Generator, rachis: Rachis, vigour: float, *, target: Float64 | None = None
) -> Leaf:
    """Draws the leaflets of a leaf.

    Args:
        config: Ranges of their numbers.
        rng: The leaf's random numbers.
        rachis: Its stalk as drawn.
        vigour: Size relative to a grown leaf.
        target: Where the terminal leaflet shall hang, in [m], for a leaf that hides a fruit. Shape (3,).
    """
    size = 0.35 + 0.65 * vigour
    terminal_length = uniform(rng, config.leaflet_length_range) * size
    droop = uniform(rng, config.leaflet_droop_range)
    if target is not None:
        rachis = aim_rachis(rachis, target, terminal_length, droop)
    low, high = config.pairs_range
    pairs = low + int(rng.random() * (high - low + 1))
    variant = int(rng.random() * LEAF_VARIANTS)
    fine = rachis.points(65)
    tangents = normalized(np.gradient(fine, axis=0))
    leaflets: list[Leaflet] = []
    stalks: list[tuple[Float64, Float64]] = []

    def add(
        fraction: float, side: float, length: float, spread_deg: float, stalk: float, pull: float
    ) -> None:
        at = min(int(round(fraction * 64)), 64)
        point, tangent = fine[at], tangents[at]
        left = normalized(cross(np.array([0.0, 0.0, 1.0]), tangent))
        spread = radians(spread_deg) * side
        direction = _droop(cos(spread) * tangent + sin(spread) * left, pull)
        # The upper side turns to the sky and outward from the stem.
        sky = cross(tangent, left) + np.array([0.0, 0.0, 0.35])
        roll = radians(normal(rng, 0.0, config.leaflet_roll_spread_deg))
        up = normalized(sky - direction * float(sky @ direction))
        up = cos(roll) * up + sin(roll) * cross(direction, up)
        base = point + stalk * direction
        small = length < 0.045
        leaflets.append(
            Leaflet(
                base=base,
                direction=direction,
                up=up,
                length=length,
                width=length * config.leaflet_aspect * normal(rng, 1.0, 0.09) * (1.1 if small else 1.0),
                lobes=config.lobes_per_side - (0.5 if side else 0.0),
                depth=0.0 if small else config.lobe_depth * normal(rng, 1.0, 0.2),
                curl=radians(uniform(rng, config.leaflet_curl_range_deg)),
                fold=config.fold * normal(rng, 1.0, 0.3),
                curve=config.lateral_curve * normal(rng, 1.0, 0.3),
                waviness=config.waviness * normal(rng, 1.0, 0.3),
                phases=np.array(
                    [0.9 * (rng.random() - 0.5), 0.9 * (rng.random() - 0.5), *(2 * pi * rng.random(2))]
                ),
                asymmetry=-0.14 * side * rng.random() if side else 0.0,
            )
        )
        stalks.append((point, base + 0.02 * length * direction))

    add(1.0, 0.0, terminal_length, 0.0, 0.75 * config.leaflet_stalk * size, droop)
    bare = config.petiole_fraction
    for pair in range(pairs):
        fraction = bare + (0.90 - bare) * ((pair + 0.35) / max(pairs - 0.4, 1))
        # The largest pair is the second from the tip, the lowest the smallest.
        shape = 1.0 - 0.16 * abs((pairs - 1 - pair) - 0.6)
        for side in (1.0, -1.0):
            length = terminal_length * config.lateral_scale * shape * normal(rng, 1.0, 0.09)
            offset = normal(rng, 0.0, 0.018)
            pull = uniform(rng, config.leaflet_droop_range)
            angle = normal(rng, config.leaflet_angle_deg, config.leaflet_angle_spread_deg)
            add(min(fraction + offset, 0.97), side, length, angle, config.leaflet_stalk * size, pull)
        if pair + 1 < pairs:
            gap = (0.90 - bare) / max(pairs - 0.4, 1)
            for k in range(config.intercalary_per_gap):
                for side in (1.0, -1.0):
                    at = fraction + gap * (k + 1) / (config.intercalary_per_gap + 1) + normal(rng, 0.0, 0.012)
                    length = terminal_length * config.intercalary_scale * normal(rng, 1.0, 0.25)
                    add(at, side, length, normal(rng, config.leaflet_angle_deg + 6.0, 9.0), 0.004, 0.3)
    return Leaf(
        rachis, config.petiole_radius * (0.55 + 0.45 * vigour), tuple(leaflets), tuple(stalks), variant
    )


def wilted(config: LeafConfig) -> LeafConfig:
    """The numbers of leaves that are dying: they hang, and their leaflets fold and roll up; [looks]."""
    return replace(
        config,
        end_angle_range_deg=(158.0, 176.0),
        leaflet_curl_range_deg=(70.0, 120.0),
        leaflet_droop_range=(1.5, 3.0),
        leaflet_aspect=0.6 * config.leaflet_aspect,
        fold=0.5,
    )


def leaflet_points(leaflet: Leaflet) -> Float64:
    """Points spread over a leaflet's blade, the same for every level of detail. Shape (N, 3)."""
    triangles = coarse_triangles(leaflet)
    return np.concatenate([triangles.reshape(-1, 3), triangles.mean(1)])


def leaf_parts(leaf: Leaf, *, picture: bool) -> tuple[MeshPart, ...]:
    """The triangles of a leaf: upper sides, lower sides, stalks."""
    count = 24 if picture else 8
    part = np.linspace(0.0, 1.0, count)
    radii = leaf.radius * (1.0 - 0.62 * part + 0.5 * np.exp(-part / 0.03))
    stalks: list[Patch] = [tube(leaf.rachis.points(count), radii, 8 if picture else 4, texture_length=0.12)]
    for (start, end), leaflet in zip(leaf.stalks, leaf.leaflets, strict=True):
        if leaflet.small and not picture:
            # These sit on the rachis; their stalks are too short to show.
            continue
        thin = leaf.radius * (0.28 if leaflet.small else 0.42)
        points = np.stack([start, 0.5 * (start + end), end]) if picture else np.stack([start, end])
        stalks.append(tube(points, np.linspace(thin, 0.55 * thin, len(points)), 6 if picture else 3))
    sides = [both_sides(leaflet, picture=picture) for leaflet in leaf.leaflets]
    parts = [join(stalks, "petiole")]
    if sides:
        state = "wilted_" if leaf.is_wilted else ""
        parts.append(join([upper for upper, _ in sides], f"leaf_{state}upper_{leaf.variant}"))
        parts.append(join([under for _, under in sides], f"leaf_{state}under_{leaf.variant}"))
    return tuple(parts)
