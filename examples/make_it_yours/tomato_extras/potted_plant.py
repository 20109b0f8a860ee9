"""A generator of plants: a straight stem, leaves like cards and round fruits."""

import numpy as np
import trimesh
from numpy.typing import NDArray

Triangles = NDArray[np.float64]


def potted_plant(seed: int) -> dict[str, Triangles]:
    """The same plant for the same seed.

    Returns:
        Triangles of each part in [m], with the foot of the stem at the origin and z up. Shapes (F, 3, 3).
    """
    rng = np.random.default_rng(seed)
    stem = trimesh.creation.cylinder(radius=0.008, height=1.3, sections=8)
    stem.apply_translation((0.0, 0.0, 0.65))
    parts = {"stem": np.asarray(stem.triangles)}
    for k in range(40):
        parts[f"leaf_{k:02d}"] = leaf(rng)
    for k in range(5):
        fruit = trimesh.creation.icosphere(subdivisions=2, radius=float(rng.uniform(0.022, 0.032)))
        fruit.apply_translation((-0.05 * rng.random(), 0.12 * (k - 2), rng.uniform(0.75, 1.1)))
        parts[f"fruit_{k}"] = np.asarray(fruit.triangles)
    return parts


def leaf(rng: np.random.Generator) -> Triangles:
    """A pointed leaf of two triangles, somewhere on the stem. Shape (2, 3, 3)."""
    turn, height, length = rng.uniform(-np.pi, np.pi), rng.uniform(0.4, 1.3), rng.uniform(0.12, 0.28)
    out = np.array([np.cos(turn), np.sin(turn), 0.3])
    side = 0.3 * length * np.array([-np.sin(turn), np.cos(turn), 0.2])
    foot, tip = np.array([0.0, 0.0, height]), np.array([0.0, 0.0, height]) + length * out
    middle = 0.5 * (foot + tip)
    return np.array([[foot, middle + side, tip], [foot, tip, middle - side]])
