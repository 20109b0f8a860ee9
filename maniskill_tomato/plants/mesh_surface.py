"""Surfaces of triangles: joined, welded, decimated, told into pieces, sides and sheets."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.plants.decimation import decimated
from maniskill_tomato.plants.mesh_colours import Paint
from maniskill_tomato.plants.mesh_files import MeshObject, joined_corners
from maniskill_tomato.plants.meshing import Float64, Int64, cross

OPPOSED: Final = 0.2
"""Where normals cancel out to less than this share, the triangles about a vertex are two sides of a sheet."""

WELD: Final = 5e-6
"""Vertices of one object that are nearer to each other are one where it is decimated, in [m]; single precision moves
them by less."""


@dataclass(frozen=True, eq=False)
class Surface:
    """The triangles of an object, in the plant frame, and what its file paints them with."""

    vertices: Float64
    """In [m]. Shape (V, 3)."""
    faces: Int64
    """Shape (F, 3)."""
    paints: tuple[Paint | None, ...]
    """Those of the object's parts; the places of a part's triangles stand in `uvs`."""
    paint_of_face: Int64
    """Which of them each triangle has. Shape (F,)."""
    uvs: Float64
    """Where the corners of each triangle are in its image. Shape (F, 3, 2)."""

    def of(self, rows: NDArray[np.int64] | NDArray[np.bool_]) -> "Surface":
        """Some of the triangles, and the vertices that they need."""
        used, inverse = np.unique(self.faces[rows], return_inverse=True)
        return replace(
            self,
            vertices=self.vertices[used],
            faces=inverse.reshape(-1, 3),
            paint_of_face=self.paint_of_face[rows],
            uvs=self.uvs[rows],
        )


def joined(parts: Sequence[MeshObject]) -> Surface:
    """Parts as one object: what two of them have in the same place, such as both sides of a leaf, is one vertex."""
    vertices, faces = parts[0].vertices, parts[0].faces
    if len(parts) > 1:
        vertices, faces = joined_corners(np.concatenate([part.vertices[part.faces] for part in parts]))
    plain = [np.zeros((len(part.faces), 3, 2)) for part in parts]
    return Surface(
        vertices=vertices,
        faces=faces,
        paints=tuple(part.paint for part in parts),
        paint_of_face=np.repeat(np.arange(len(parts)), [len(part.faces) for part in parts]),
        uvs=np.concatenate(
            [p.paint.uvs if p.paint else zeros for p, zeros in zip(parts, plain, strict=True)]
        ),
    )


def placed(surface: Surface, T: Float64) -> Surface:
    """In the plant frame, rounded to a micrometre."""
    return replace(surface, vertices=np.round(surface.vertices @ T[:3, :3].T + T[:3, 3], 6) + 0.0)


def within_budget(
    path: Path | str, surfaces: Sequence[Surface], names: Sequence[str], triangles: int
) -> list[Surface]:
    """The surfaces with no more than so many triangles in all; what matters least to their shapes goes first.

    Of the smallest, such as buds, nothing would be left: they keep all that they have.

    Args:
        path: The file, for the message.
        surfaces: Those of its objects.
        names: Of the objects.
        triangles: The budget.

    Raises:
        InvalidInputError: The shapes need more triangles; the message says how many.
    """
    whole = [_welded(surface) for surface in surfaces]
    sizes = np.array([len(surface.faces) for surface in whole])
    firsts, starts = (np.cumsum([0, *counts]) for counts in ([len(s.vertices) for s in whole], sizes))
    owner = np.repeat(np.arange(len(whole)), sizes)
    vertices = np.concatenate([surface.vertices for surface in whole])
    faces = np.concatenate([surface.faces for surface in whole]) + firsts[owner, None]
    is_whole = np.zeros(len(whole), np.bool_)
    while True:
        rest = np.flatnonzero(~is_whole[owner])
        moved, left, kept = decimated(vertices, faces[rest], triangles - int(sizes[is_whole].sum()))
        gone = (np.bincount(owner[rest[kept]], minlength=len(whole)) == 0) & ~is_whole & (sizes > 0)
        fewest = int(sizes[is_whole | gone].sum()) + len(kept)
        if not gone.any() or sizes[is_whole | gone].sum() >= triangles:
            break
        is_whole |= gone
    if fewest > triangles:
        named = (
            f", among them all of {names[int(np.argmax(is_whole | gone))]!r}"
            if (is_whole | gone).any()
            else ""
        )
        raise InvalidInputError(
            f"{path} has {len(faces)} triangles and cannot be decimated to triangles={triangles}: its shapes need "
            f"{fewest}{named}; allow more, or leave triangles out"
        )
    is_kept = is_whole[owner]
    is_kept[rest[kept]] = True
    faces[rest[kept]] = left
    found = []
    for k, surface in enumerate(whole):
        own = slice(starts[k], starts[k + 1])
        points = np.round(moved[firsts[k] : firsts[k + 1]], 6) + 0.0
        organ = replace(surface, vertices=points, faces=faces[own] - firsts[k])
        found.append(organ.of(np.flatnonzero(is_kept[own])))
    return found


def _welded(surface: Surface) -> Surface:
    """The triangles that have an area, with vertices that are nearer to each other than `WELD` as one."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    count = len(surface.vertices)
    pairs = KDTree(surface.vertices).query_pairs(WELD, output_type="ndarray")
    graph = coo_array((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    labels = connected_components(graph, directed=False)[1]
    _, first = np.unique(labels, return_index=True)
    faces = first[labels][surface.faces]
    return replace(surface, faces=faces).of(np.flatnonzero(across_faces(surface.vertices, faces).any(1)))


def is_below(count: int, faces: Int64, across: Float64) -> NDArray[np.bool_]:
    """Which corners are on the lower side of a vertex whose triangles face opposite ways, as on a sheet of two sides.

    Args:
        count: Number of vertices.
        faces: Shape (F, 3).
        across: Their normals, of any length above 0. Shape (F, 3).

    Returns:
        Shape (F, 3).
    """
    length = np.linalg.norm(across, axis=1)
    total, size, upward = np.zeros((count, 3)), np.zeros(count), np.zeros((count, 3))
    for k in range(3):
        np.add.at(total, faces[:, k], across)
        np.add.at(size, faces[:, k], length)
        upward[faces[:, k]] = across
    opposed = np.linalg.norm(total, axis=1) < OPPOSED * size
    return np.asarray(opposed[faces] & (np.einsum("fi,fki->fk", across, upward[faces]) < 0.0))


def split_at_seams(faces: Int64, uvs: Float64) -> tuple[Int64, Float64, Int64]:
    """Vertices of which each has one place in an image.

    Args:
        faces: Shape (F, 3).
        uvs: Places of their corners. Shape (F, 3, 2).

    Returns:
        Which of the old vertices each is, its place, and the faces. Shapes (V,), (V, 2), (F, 3).
    """
    from trimesh.grouping import unique_rows

    corners, places = faces.reshape(-1), uvs.reshape(-1, 2)
    first, inverse = unique_rows(np.column_stack([corners, np.round(places * 1e5).astype(np.int64)]))
    return corners[first], places[first], inverse.reshape(-1, 3).astype(np.int64)


def across_faces(vertices: Float64, faces: Int64) -> Float64:
    """Normals of triangles, twice as long as their areas are large. Shape (F, 3)."""
    corners = vertices[faces]
    return cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def is_open(count: int, faces: Int64) -> NDArray[np.bool_]:
    """Whether the connected piece of each triangle has an edge that is not met as often in the other direction.

    A solid body has none, and neither has a sheet that is modelled from both sides.

    Args:
        count: Number of vertices.
        faces: Shape (F, 3).

    Returns:
        Shape (F,).
    """
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    there, back = edges[:, 0] * count + edges[:, 1], edges[:, 1] * count + edges[:, 0]
    found, times = np.unique(there, return_counts=True)
    places = np.searchsorted(found, np.stack([there, back]))
    places = np.minimum(places, len(found) - 1)
    met = np.where(found[places] == np.stack([there, back]), times[places], 0) if len(found) else places
    pieces = pieces_of(count, faces)
    has_outline = np.zeros(count, np.bool_)
    has_outline[pieces[edges[met[0] != met[1], 0]]] = True
    return has_outline[pieces[faces[:, 0]]]


def pieces_of(vertices: int, faces: Int64) -> Int64:
    """Which connected piece each vertex belongs to. Shape (V,)."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    start = np.concatenate([faces[:, 0], faces[:, 1]])
    end = np.concatenate([faces[:, 1], faces[:, 2]])
    graph = coo_array((np.ones(len(start), np.int8), (start, end)), shape=(vertices, vertices))
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)
