"""Small meshes: tubes along curves, two-sided sheets, and rounding that makes them equal everywhere."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.plants.organs import MeshPart

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Patch:
    """A mesh in double precision before it becomes a `MeshPart`."""

    vertices: Float64
    """Positions in the plant frame, in [m]. Shape (V, 3)."""
    normals: Float64
    """Vertex normals, any length. Shape (V, 3)."""
    uvs: Float64
    """Texture coordinates. Shape (V, 2)."""
    faces: Int64
    """Vertex indices, counter-clockwise from outside. Shape (F, 3)."""


def normalized(vectors: Float64) -> Float64:
    """Vectors scaled to length one along their last axis; a zero vector stays zero."""
    length = np.sqrt((vectors * vectors).sum(-1, keepdims=True))
    return np.asarray(vectors / np.maximum(length, 1e-12))


def cross(a: Float64, b: Float64) -> Float64:
    """Cross product along the last axis, with broadcasting."""
    # Small arrays, thousands of times a plant: filling one array is twice as fast as stacking three.
    result = np.empty(np.broadcast_shapes(a.shape, b.shape))
    result[..., 0] = a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1]
    result[..., 1] = a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2]
    result[..., 2] = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return result


def join(patches: Iterable[Patch], material: str) -> MeshPart:
    """Patches of one material as a single part.

    Positions are rounded to 1e-6 m, texture coordinates to 1e-5 and normals to 1e-4, so that last-bit
    differences between mathematical libraries do not show. Triangles that the rounding made flat are dropped.
    """
    patches = list(patches)
    offsets = np.cumsum([0] + [len(p.vertices) for p in patches[:-1]])
    vertices = np.round(np.concatenate([p.vertices for p in patches]), 6) + 0.0
    faces = np.concatenate([p.faces + o for p, o in zip(patches, offsets, strict=True)])
    corners = vertices[faces]
    twice_area = cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    faces = faces[(twice_area * twice_area).sum(1) > (2e-9) ** 2]
    normals = np.round(normalized(np.concatenate([p.normals for p in patches])), 4) + 0.0
    return MeshPart(
        vertices=vertices.astype(np.float32),
        normals=normals.astype(np.float32),
        uvs=np.round(np.concatenate([p.uvs for p in patches]), 5).astype(np.float32),
        faces=faces.astype(np.int32),
        material=material,
    )


def flipped(patch: Patch) -> Patch:
    """The other side of a sheet: same points, reversed triangles and normals."""
    return Patch(patch.vertices, -patch.normals, patch.uvs, patch.faces[:, ::-1])


@lru_cache(maxsize=256)
def grid_faces(rows: int, columns: int) -> Int64:
    """Triangles of a grid whose vertices are numbered row by row; read-only. Shape (2 (rows - 1) (columns - 1), 3)."""
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    a, b, c, d = corner, corner + 1, corner + columns, corner + columns + 1
    faces = np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)])
    faces.setflags(write=False)
    return faces


def curve_frames(points: Float64) -> tuple[Float64, Float64, Float64]:
    """Tangents and two cross-directions along a curve, carried along it without twist.

    Args:
        points: Points of the curve. Shape (N, 3).

    Returns:
        Tangent, first and second cross-direction; right-handed in this order. Each of shape (N, 3).
    """
    tangents = normalized(np.gradient(points, axis=0))
    first = np.empty_like(tangents)
    helper = np.array([1.0, 0.0, 0.0]) if abs(tangents[0, 0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    direction = helper
    for i, tangent in enumerate(tangents):
        direction = normalized(direction - tangent * (direction @ tangent))
        first[i] = direction
    return tangents, first, cross(tangents, first)


def tube(
    points: Float64, radii: Float64, sides: int, *, texture_length: float = 0.1, cap: bool = False
) -> Patch:
    """A round tube along a curve.

    Args:
        points: Points of its axis, in [m]. Shape (N, 3).
        radii: Radius at each point, in [m]. Shape (N,).
        sides: Corners of its cross-section.
        texture_length: Length of axis over which the texture's v runs from 0 to 1, in [m].
        cap: Close the far end with a point.
    """
    tangents, first, second = curve_frames(points)
    angles = np.linspace(0.0, 2 * np.pi, sides + 1)
    ring = np.cos(angles)[:, None] * first[:, None] + np.sin(angles)[:, None] * second[:, None]
    vertices = points[:, None] + radii[:, None, None] * ring
    steps = np.sqrt((np.diff(points, axis=0) ** 2).sum(1))
    along = np.concatenate([[0.0], np.cumsum(steps)]) / texture_length
    uvs = np.stack(np.broadcast_arrays(np.linspace(0.0, 1.0, sides + 1)[None], along[:, None]), -1)
    patch = Patch(
        vertices.reshape(-1, 3), ring.reshape(-1, 3), uvs.reshape(-1, 2), grid_faces(len(points), sides + 1)
    )
    if not cap:
        return patch
    last = (len(points) - 1) * (sides + 1) + np.arange(sides)
    apex = len(patch.vertices)
    return Patch(
        np.concatenate([patch.vertices, (points[-1] + 0.7 * radii[-1] * tangents[-1])[None]]),
        np.concatenate([patch.normals, tangents[-1:]]),
        np.concatenate([patch.uvs, [[0.5, along[-1]]]]),
        np.concatenate([patch.faces, np.stack([last, last + 1, np.full(sides, apex)], 1)]),
    )


def bezier(controls: Float64, count: int) -> Float64:
    """Points of a cubic Bezier curve with the given four control points. Shape (count, 3)."""
    p0, p1, p2, p3 = controls
    t = np.linspace(0.0, 1.0, count)[:, None]
    s = 1.0 - t
    return np.asarray(s**3 * p0 + 3 * s**2 * t * p1 + 3 * s * t**2 * p2 + t**3 * p3)


def hanging_curve(
    base: Float64,
    azimuth: float,
    start_angle: float,
    end_angle: float,
    length: float,
    count: int,
    *,
    sway: float = 0.0,
) -> Float64:
    """A stalk that leaves its base at one angle and bends to another.

    Args:
        base: Where it begins, in [m]. Shape (3,).
        azimuth: Direction in the horizontal plane, in [rad] from +x about z.
        start_angle: Angle to the upward vertical at the base, in [rad].
        end_angle: The same at the tip, in [rad].
        length: Arc length, in [m].
        count: Number of points.
        sway: Turn of the azimuth from base to tip, in [rad].

    Returns:
        Points from base to tip, in [m]. Shape (count, 3).
    """
    # Sampled on a fixed fine grid so that every level of detail has points of one and the same curve.
    fine = 64
    middle = (np.arange(fine) + 0.5) / fine
    polar = start_angle + (end_angle - start_angle) * middle**1.25
    heading = azimuth + sway * middle
    steps = np.stack([np.sin(polar) * np.cos(heading), np.sin(polar) * np.sin(heading), np.cos(polar)], 1)
    points = base + np.concatenate([np.zeros((1, 3)), np.cumsum(steps, 0)]) * (length / fine)
    at = np.linspace(0.0, fine, count)
    return np.stack([np.interp(at, np.arange(fine + 1), points[:, k]) for k in range(3)], 1)
