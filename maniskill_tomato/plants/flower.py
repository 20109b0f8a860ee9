"""Flowering trusses above the fruits: nodding yellow flowers with bent-back petals around a cone of anthers."""

from dataclasses import replace
from math import cos, pi, radians, sin

import numpy as np
from numpy.random import Generator

from maniskill_tomato.plants.fruit import Berry
from maniskill_tomato.plants.meshing import Float64, Patch, cross, flipped, grid_faces, join, normalized, tube
from maniskill_tomato.plants.organs import MeshPart
from maniskill_tomato.plants.plant_config import FlowerConfig, PlantConfig
from maniskill_tomato.plants.random_streams import Stream, normal, stream, uniform
from maniskill_tomato.plants.stem import Shoot
from maniskill_tomato.plants.truss import Hanging, Truss, draw_truss, truss_parts


def grow_flowers(config: PlantConfig, shoot: Shoot, seed: int) -> list[tuple[MeshPart, ...]]:
    """The flowering trusses of a shoot, those that its height leaves room for.

    Args:
        config: The plant's.
        shoot: What they stand on.
        seed: The plant's.

    Returns:
        The parts of each truss.
    """
    flower = config.flower
    trusses = []
    for k in range(config.flowering_trusses):
        node = shoot.truss_nodes[-1] + config.stem.leaves_per_truss * (k + 1)
        if node >= len(shoot.heights):
            break
        rng = stream(seed, Stream.FLOWER, k)
        azimuth = pi + radians(normal(rng, 0.0, config.truss.azimuth_spread_deg, 2.0))
        height = float(shoot.heights[node]) + 0.012
        low, high = flower.count_range
        buds = [_bud(flower, rng) for _ in range(low + int((high + 1 - low) * rng.random()))]
        stalk = replace(
            config.truss,
            pedicel_spacing=flower.spacing,
            pedicel_length_range=flower.pedicel_length_range,
            base_radius=0.5 * config.truss.base_radius,
            pedicel_radius=0.6 * config.truss.pedicel_radius,
            end_angle_deg=flower.end_angle_deg,
            sepal_length=flower.sepal_length / flower.bud_radius,
            sepal_width=0.0025 * 0.030 / flower.bud_radius,
        )
        truss = draw_truss(stalk, rng, shoot.on_skin(height, azimuth), azimuth, buds)
        parts = list(truss_parts(stalk, truss, picture=True))
        parts.append(join(_corollas(flower, truss, rng), "petal"))
        trusses.append(tuple(parts))
    return trusses


def _bud(config: FlowerConfig, rng: Generator) -> Berry:
    """What the flower's stalk ends at; flowers nod, so that its axis points up."""
    tilt, around = radians(abs(normal(rng, 0.0, 25.0))), 2 * pi * rng.random()
    return Berry(
        radius=config.bud_radius,
        oblateness=1.0,
        ribs=0,
        rib_depth=0.0,
        rib_phase=0.0,
        dent=0.0,
        axis=np.array([sin(tilt) * cos(around), sin(tilt) * sin(around), cos(tilt)]),
        ripeness="green",
        variant=0,
    )


def _corollas(config: FlowerConfig, truss: Truss, rng: Generator) -> list[Patch]:
    return [patch for hanging in truss.fruits for patch in _corolla(config, hanging, rng)]


def _corolla(config: FlowerConfig, hanging: Hanging, rng: Generator) -> list[Patch]:
    """Five petals, both sides, and the anthers."""
    frame = hanging.berry.frame()
    down = np.array([0.0, 0.0, -1.0])
    count = 7
    part = np.linspace(0.0, 1.0, count)
    length, first = uniform(rng, config.petal_length_range), 2 * pi * rng.random()
    bend = normal(rng, config.petal_bend_deg, config.petal_bend_spread_deg)
    width = config.petal_width * np.sin(pi * (0.12 + 0.88 * part)) ** 0.8
    width[-1] = 0.0
    fine = (np.arange(32) + 0.5) / 32
    slope = radians(20.0) - radians(bend) * fine
    out = np.concatenate([[0.0], np.cumsum(np.cos(slope))]) * length / 32 + 0.001
    below = np.concatenate([[0.0], np.cumsum(np.sin(slope))]) * length / 32 + 0.5 * config.bud_radius
    r = np.interp(part * 32, np.arange(33), out)
    h = np.interp(part * 32, np.arange(33), below)
    sheets = []
    for k in range(5):
        angle = first + 2 * pi * k / 5
        radial, lateral = np.array([cos(angle), sin(angle), 0.0]), np.array([-sin(angle), cos(angle), 0.0])
        middle = r[:, None] * radial + h[:, None] * down
        local = np.stack(
            [middle - 0.5 * width[:, None] * lateral, middle + 0.5 * width[:, None] * lateral], 1
        )
        across = cross(normalized(np.gradient(middle, axis=0)), np.broadcast_to(lateral, middle.shape))
        normals = np.repeat(across[:, None], 2, 1)
        uvs = np.stack(np.broadcast_arrays(part[:, None], np.array([[0.0, 1.0]])), -1)
        sheet = Patch(
            local.reshape(-1, 3) @ frame.T + hanging.centre,
            normalized(normals.reshape(-1, 3) @ frame.T),
            uvs.reshape(-1, 2),
            grid_faces(count, 2)[:, ::-1],
        )
        sheets += [sheet, flipped(sheet)]
    return [*sheets, _anthers(config, hanging, frame)]


def _anthers(config: FlowerConfig, hanging: Hanging, frame: Float64) -> Patch:
    along = np.linspace(0.0, config.anther_length, 4)
    points = hanging.centre - along[:, None] * frame[:, 2]
    return tube(points, 0.0016 * np.array([1.0, 1.1, 0.8, 0.25]), 5, texture_length=0.05, cap=True)
