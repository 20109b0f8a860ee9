"""Random viewpoints around a row, with as many hard ones as easy ones."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.random import Generator
from numpy.typing import NDArray

from maniskill_tomato.plants.organs import Plant
from maniskill_tomato.raycast.scene import RayScene
from maniskill_tomato.robot.d435 import CameraIntrinsics

Float64 = NDArray[np.float64]

BANDS = ((0.0, 0.3), (0.3, 0.7), (0.7, 1.01))
"""Visible fractions of hard, middling and easy views of the target."""

TRIES = 24
"""Viewpoints drawn for one that falls into the wanted band."""


@dataclass(frozen=True, kw_only=True)
class View:
    """Where a picture is taken from and which fruit it is aimed at."""

    target_fruit: int
    """Index in the plant's fruits."""
    T_plant_optical: Float64
    """Pose of the optical frame in the plant's frame, in [m]. Shape (4, 4)."""


def draw_view(plant: Plant, targets: list[int], rng: Generator) -> View:
    """A viewpoint on the aisle's side, 0.2 to 1 m from a fruit, roughly aimed at it and roughly upright."""
    target = targets[int(rng.integers(len(targets)))]
    azimuth = np.deg2rad(np.clip(rng.normal(0, 38), -100, 100))
    elevation = np.deg2rad(np.clip(rng.normal(10, 20), -50, 60))
    cosine = np.cos(elevation)
    forward = np.array([cosine * np.cos(azimuth), cosine * np.sin(azimuth), -np.sin(elevation)])
    right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    rotation = np.stack([right, np.cross(forward, right), forward], axis=1)
    roll = rng.normal(0, 8) if rng.random() < 0.8 else rng.uniform(-180, 180)
    rotation = rotation @ _turn(2, np.deg2rad(roll))
    pose = np.eye(4)
    distance = np.exp(rng.uniform(np.log(0.2), np.log(1.0)))
    pose[:3, 3] = plant.fruits[target].centre - distance * forward
    aside = np.deg2rad(rng.normal(0, 8, 2))
    pose[:3, :3] = rotation @ _turn(0, aside[0]) @ _turn(1, aside[1])
    return View(target_fruit=target, T_plant_optical=pose)


def draw_views(plant: Plant, count: int, intrinsics: CameraIntrinsics, rng: Generator) -> list[View]:
    """Viewpoints whose targets' visible fractions fall into `BANDS` in turn, as far as some tries allow."""
    ripe = [k for k, fruit in enumerate(plant.fruits) if fruit.ripeness != "green"]
    targets = ripe or list(range(len(plant.fruits)))
    scene = RayScene([plant], intrinsics)
    views = []
    for number in range(count):
        low, high = BANDS[number % len(BANDS)]
        pool = targets if number % 5 else list(range(len(plant.fruits)))
        view = draw_view(plant, pool, rng)
        for _ in range(TRIES):
            seen = scene.visibility(
                torch.from_numpy(view.T_plant_optical.astype(np.float32))[None],
                torch.tensor([view.target_fruit]),
                torch.eye(4)[None],
            )
            if low <= float(seen.visible_fraction[0]) < high:
                break
            view = draw_view(plant, pool, rng)
        views.append(view)
    return views


def _turn(axis: int, angle: float) -> Float64:
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[i, i] = matrix[j, j] = np.cos(angle)
    matrix[i, j], matrix[j, i] = -np.sin(angle), np.sin(angle)
    return matrix
