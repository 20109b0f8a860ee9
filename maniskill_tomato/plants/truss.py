"""Trusses: an arched peduncle, pedicels with a knuckle to the right and left in turn, star-shaped calyces."""

from dataclasses import dataclass
from math import cos, pi, radians, sin

import numpy as np
from numpy.random import Generator

from maniskill_tomato.plants.fruit import Berry
from maniskill_tomato.plants.meshing import (
    Float64,
    Patch,
    bezier,
    cross,
    flipped,
    grid_faces,
    hanging_curve,
    join,
    normalized,
    tube,
)
from maniskill_tomato.plants.organs import MeshPart
from maniskill_tomato.plants.plant_config import TrussConfig
from maniskill_tomato.plants.random_streams import normal, uniform

UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False)
class Hanging:
    """A fruit on its pedicel."""

    berry: Berry
    centre: Float64
    """Centre of the fruit, in the plant frame, in [m]. Shape (3,)."""
    pedicel: Float64
    """The four control points of the pedicel's curve, from peduncle to calyx, in [m]. Shape (4, 3)."""
    calyx_turn: float
    """Direction of the first sepal, in [rad]."""
    sepal_curls: Float64
    """Upward curl of each sepal, in [rad]. Shape (S,)."""


@dataclass(frozen=True, eq=False)
class Truss:
    """A truss before it is meshed."""

    base: Float64
    azimuth: float
    start_angle: float
    end_angle: float
    length: float
    fruits: tuple[Hanging, ...]

    def points(self, count: int) -> Float64:
        """Points of the peduncle from stem to tip, in [m]. Shape (count, 3)."""
        return hanging_curve(self.base, self.azimuth, self.start_angle, self.end_angle, self.length, count)


def _separated(centres: Float64, radii: Float64, base: Float64, azimuth: float) -> Float64:
    """Moves fruits apart until none sinks into another or into the stem.

    Args:
        centres: Where they would hang, in [m]. Shape (N, 3).
        radii: Their radii, in [m]. Shape (N,).
        base: Where the truss leaves the stem, in [m]. Shape (3,).
        azimuth: Direction of the truss, in [rad].
    """
    outward = np.array([cos(azimuth), sin(azimuth), 0.0])
    centres = centres.copy()
    for _ in range(24):
        for i in range(len(centres)):
            for j in range(i):
                apart = centres[i] - centres[j]
                distance = float(np.sqrt(apart @ apart)) or 1e-6
                overlap = 0.98 * (radii[i] + radii[j]) - distance
                if overlap > 0:
                    push = apart / distance * (0.5 * overlap)
                    centres[i] += push
                    centres[j] -= push
        out = (centres - base) @ outward
        short = np.maximum(radii + 0.012 - out, 0.0)
        centres += short[:, None] * outward
    return centres


def draw_truss(
    config: TrussConfig, rng: Generator, base: Float64, azimuth: float, berries: list[Berry]
) -> Truss:
    """Draws a truss that carries the given fruits.

    Args:
        config: Its numbers.
        rng: Its random numbers.
        base: Where it leaves the stem, in [m]. Shape (3,).
        azimuth: Its direction in the horizontal plane, in [rad].
        berries: Its fruits, from the stem outward.
    """
    start = radians(normal(rng, config.insertion_deg, 5.0))
    end = radians(normal(rng, config.end_angle_deg, 5.0))
    pitch = [max(config.pedicel_spacing, 0.82 * berry.radius) for berry in berries]
    lead = config.base_length * normal(rng, 1.0, 0.1)
    along = lead + np.concatenate([[0.0], np.cumsum(pitch[:-1])])
    # A cut truss ends a little after its last fruit.
    length = float(along[-1]) + 0.012
    curve = hanging_curve(base, azimuth, start, end, length, 65)
    tangents = normalized(np.gradient(curve, axis=0))
    first_side = 1.0 if rng.random() < 0.5 else -1.0
    starts, directions, lengths = [], [], []
    for i in range(len(berries)):
        at = int(round(64 * float(along[i]) / length))
        tangent = tangents[at]
        left = normalized(cross(UP, np.array([cos(azimuth), sin(azimuth), 0.0])))
        side = first_side * (-1.0) ** i
        spread = radians(normal(rng, config.pedicel_angle_deg, config.pedicel_angle_spread_deg))
        outward = np.array([cos(azimuth), sin(azimuth), 0.0]) * normal(rng, 0.30, 0.15)
        starts.append(curve[at])
        directions.append(normalized(cos(spread) * tangent + sin(spread) * side * left + outward))
        lengths.append(uniform(rng, config.pedicel_length_range))
    radii = np.array([berry.radius for berry in berries])
    if len(berries) == 1:
        # A single fruit hangs straight out, so that its place is known before it is drawn.
        directions = [normalized(tangents[-1] + 0.8 * np.array([cos(azimuth), sin(azimuth), 0.0]))]
    centres = np.stack(
        [
            p + 0.72 * n * d - np.array([0.0, 0.0, 0.30 * n]) - 0.9 * b.top * b.axis
            for p, d, n, b in zip(starts, directions, lengths, berries, strict=True)
        ]
    )
    centres = _separated(centres, radii, base, azimuth)
    fruits = []
    for p, d, n, berry, centre in zip(starts, directions, lengths, berries, centres, strict=True):
        seat = centre + (berry.top + 0.001) * berry.axis
        reach = float(np.sqrt(((seat - p) ** 2).sum()))
        handle = max(0.4 * n, 0.45 * reach)
        control = np.stack([p, p + handle * d, seat + handle * berry.axis, seat])
        curls = np.array(
            [normal(rng, config.sepal_curl, config.sepal_curl_spread) for _ in range(config.sepals)]
        )
        fruits.append(Hanging(berry, centre, control, 2 * pi * rng.random(), curls))
    return Truss(base, azimuth, start, end, length, tuple(fruits))


def _calyx(config: TrussConfig, hanging: Hanging, *, picture: bool) -> list[Patch]:
    """Sepals that lie on the shoulder at first and curl up towards their tips; both sides."""
    berry = hanging.berry
    frame = berry.frame()
    count = 9 if picture else 3
    part = np.linspace(0.0, 1.0, count)
    width = (
        config.sepal_width
        * (berry.radius / 0.030)
        * np.sin(pi * (0.16 + 0.84 * part)) ** 0.9
        * (1 - 0.35 * part)
    )
    width[-1] = 0.0
    sheets = []
    for k in range(config.sepals):
        angle = hanging.calyx_turn + 2 * pi * k / config.sepals
        length = config.sepal_length * berry.radius
        steps = length / 32
        fine = (np.arange(32) + 0.5) / 32
        # It leaves the dent upward, bends over the shoulder and curls up again at the tip.
        slope = 0.55 - 1.25 * fine + float(hanging.sepal_curls[k]) * 1.7 * fine**2
        out = np.concatenate([[0.0], np.cumsum(np.cos(slope))]) * steps + 0.0015
        up = np.concatenate([[0.0], np.cumsum(np.sin(slope))]) * steps + berry.top + 0.0015
        r = np.interp(part * 32, np.arange(33), out)
        h = np.interp(part * 32, np.arange(33), up)
        radial = np.array([cos(angle), sin(angle), 0.0])
        lateral = np.array([-sin(angle), cos(angle), 0.0])
        middle = r[:, None] * radial + h[:, None] * np.array([0.0, 0.0, 1.0])
        columns = (-0.5, 0.0, 0.5) if picture else (-0.5, 0.5)
        rows = [
            middle + c * width[:, None] * lateral + np.array([0, 0, 1.0]) * (abs(c) * 0.35 * width[:, None])
            for c in columns
        ]
        local = np.stack(rows, 1)
        tangent = np.gradient(middle, axis=0)
        normal_local = cross(normalized(tangent), np.broadcast_to(lateral, tangent.shape))
        bend = np.array(columns)[None, :, None] * -0.9
        normals = normal_local[:, None] + bend * lateral
        world = local.reshape(-1, 3) @ frame.T + hanging.centre
        uvs = np.stack(np.broadcast_arrays(part[:, None], np.linspace(0, 1, len(columns))[None]), -1)
        sheet = Patch(
            world,
            normalized(normals.reshape(-1, 3) @ frame.T),
            uvs.reshape(-1, 2),
            grid_faces(count, len(columns))[:, ::-1],
        )
        sheets += [sheet, flipped(sheet)]
    return sheets


def truss_parts(config: TrussConfig, truss: Truss, *, picture: bool) -> tuple[MeshPart, ...]:
    """The triangles of a truss without its fruits: peduncle and pedicels, calyces."""
    count = 28 if picture else 10
    radii = config.base_radius * np.linspace(1.0, config.tip_radius_ratio, count)
    radii[0] *= 1.35
    stalks = [tube(truss.points(count), radii, 10 if picture else 5, texture_length=0.12, cap=True)]
    sheets: list[Patch] = []
    knuckle = config.knuckle_fraction
    for hanging in truss.fruits:
        points = 15 if picture else 5
        part = np.linspace(0.0, 1.0, points)
        # The knuckle is a ring; towards the calyx the stalk widens into a small disc.
        thick = (
            1.0
            + config.knuckle_swelling * np.exp(-(((part - knuckle) / 0.07) ** 2))
            + 1.1 * np.exp(-((1 - part) / 0.09))
        )
        stalks.append(
            tube(
                bezier(hanging.pedicel, points),
                config.pedicel_radius * thick,
                7 if picture else 3,
                cap=False,
            )
        )
        sheets += _calyx(config, hanging, picture=picture)
    parts = [join(stalks, "truss")]
    if sheets:
        parts.append(join(sheets, "calyx"))
    return tuple(parts)
