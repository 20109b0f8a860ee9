"""Things about a plant that are no plant: boards, boxes, strings, loose triangles.

They stand for what real rows hold and no model of a plant knows, and keep a policy from taking every surface for a leaf
[Tobin et al. 2017].
"""

from math import cos, pi, sin

import numpy as np
from numpy.random import Generator

from maniskill_tomato.plants.meshing import Float64, Patch, cross, join, normalized, tube
from maniskill_tomato.plants.organs import Organ, SemanticClass
from maniskill_tomato.plants.random_streams import Stream, stream, uniform

SHAPES = ("board", "box", "string", "triangles")

DISTANCE_RANGE = (0.06, 0.32)
"""From the stem's axis, in [m]."""

HEIGHT_RANGE = (0.2, 1.0)
"""Over the ground, in [m]."""

BEHIND_SHARE = 0.35
"""Share that stands on the far side of the plant, where it hides less."""


def clutter_organs(seed: int, count: int) -> list[Organ]:
    """The things about the plant `seed`, in its frame."""
    return [_organ(k, stream(seed, Stream.CLUTTER, k)) for k in range(count)]


def _organ(number: int, rng: Generator) -> Organ:
    shape = SHAPES[int(len(SHAPES) * rng.random())]
    away = pi if rng.random() >= BEHIND_SHARE else 0.0
    azimuth = away + uniform(rng, (-0.45 * pi, 0.45 * pi))
    distance = uniform(rng, DISTANCE_RANGE)
    place = np.array([distance * cos(azimuth), distance * sin(azimuth), uniform(rng, HEIGHT_RANGE)])
    if shape == "string":
        lean = np.array([uniform(rng, (-0.3, 0.3)), uniform(rng, (-0.3, 0.3)), 1.0])
        ends = place + np.outer([-0.4, 0.5], lean)
        ends[:, 2] = np.maximum(ends[:, 2], 0.0)
        patch = tube(ends, np.full(2, uniform(rng, (0.001, 0.004))), 4)
    elif shape == "triangles":
        patch = _triangles(rng, place)
    else:
        thin = shape == "board"
        sizes = np.array([uniform(rng, (0.03, 0.12)) for _ in range(3)])
        if thin:
            sizes = np.array([uniform(rng, (0.06, 0.25)), uniform(rng, (0.03, 0.12)), 0.004])
        patch = _box(place, sizes, _turn(rng))
    return Organ(f"clutter_{number:02d}", SemanticClass.OBJECT, (join([patch], f"object_{number % 3}"),))


def _turn(rng: Generator) -> Float64:
    """A rotation, uniform over all."""
    quaternion = normalized(rng.standard_normal(4))
    w, x, y, z = quaternion.tolist()
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _box(centre: Float64, sizes: Float64, turn: Float64) -> Patch:
    vertices: list[Float64] = []
    normals: list[Float64] = []
    uvs: list[Float64] = []
    faces: list[list[list[int]]] = []
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], dtype=np.float64)
    for axis in range(3):
        for side in (-1.0, 1.0):
            first, second = (axis + 1) % 3, (axis + 2) % 3
            face = np.zeros((4, 3))
            face[:, axis] = side
            face[:, first], face[:, second] = corners[:, 0] * side, corners[:, 1]
            normal = np.zeros(3)
            normal[axis] = side
            start = 4 * len(vertices)
            vertices.append(0.5 * sizes * face)
            normals.append(np.tile(normal, (4, 1)))
            uvs.append(0.5 + 0.5 * corners)
            faces.append([[start, start + 1, start + 2], [start, start + 2, start + 3]])
    return Patch(
        np.concatenate(vertices) @ turn.T + centre,
        np.concatenate(normals) @ turn.T,
        np.concatenate(uvs),
        np.concatenate([np.array(pair) for pair in faces]),
    )


def _triangles(rng: Generator, centre: Float64) -> Patch:
    """Loose ones, seen from both sides."""
    count = 3 + int(10 * rng.random())
    middles = centre + 0.08 * rng.standard_normal((count, 1, 3))
    corners = middles + uniform(rng, (0.015, 0.06)) * rng.standard_normal((count, 3, 3))
    corners[..., 2] = np.maximum(corners[..., 2], 0.0)
    both = np.concatenate([corners, corners[:, ::-1]])
    normals = normalized(cross(both[:, 1] - both[:, 0], both[:, 2] - both[:, 0]))
    return Patch(
        both.reshape(-1, 3),
        np.repeat(normals, 3, 0),
        np.tile(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]), (2 * count, 1)),
        np.arange(6 * count).reshape(-1, 3),
    )
