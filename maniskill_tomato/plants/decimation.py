"""Fewer triangles for a surface: edges collapse by quadric error (Garland and Heckbert 1997), outlines stay."""

from typing import Any, Final

import numpy as np

from maniskill_tomato.plants.meshing import Float64, Int64, cross, normalized

TRIES: Final = 6
"""Runs until the budget is met: how many of the triangles that a run leaves are walls is known afterwards only."""

CLOSE: Final = 0.92
"""Share of the budget that is near enough to it."""

_UNITS_PER_METRE: Final = 1e4
"""Tenths of a millimetre. The library collapses in passes of growing error, whose steps are fine in this unit."""

_FOLD_COSINE: Final = -0.5
"""Two triangles that turn away from each other more than this are the two sides of a sheet that meet at its outline."""


def decimated(vertices: Float64, faces: Int64, triangles: int) -> tuple[Float64, Int64, Int64]:
    """The surface with no more than a number of triangles, or with as few as can be if that is more.

    What is flat goes first. The outline of a sheet, whether it is modelled from one side or from both, counts as an
    edge between two planes: straight pieces of it become longer, corners stay.

    Args:
        vertices: In [m]. Shape (V, 3).
        faces: None of them without an area. Shape (F, 3).
        triangles: The budget.

    Returns:
        Vertices, at the numbers that they had; those that are left may have moved. Shape (V, 3).
        The faces that are left. Shape (K, 3).
        Which of the given faces they were, in order. Shape (K,).
    """
    if len(faces) <= triangles:
        return vertices, faces, np.arange(len(faces))
    outer, walls = _walls(vertices, faces)
    # A pass that meets the budget stops where it is: mixed, it has been everywhere alike.
    order = np.random.default_rng(0).permutation(len(faces))
    points = np.concatenate([vertices, outer]) * _UNITS_PER_METRE
    mixed = np.concatenate([faces[order], walls])
    low, high = 0, len(mixed)
    target = triangles * len(mixed) // len(faces)
    best = vertices, faces, np.arange(len(faces))
    for _ in range(TRIES):
        moved, left, numbers = _collapsed(points, mixed, target)
        own = numbers < len(faces)
        kept, numbers = left[own], order[numbers[own]]
        rank = np.argsort(numbers)
        fits = len(kept) <= triangles
        if max(triangles, len(kept)) < len(best[1]) or len(best[1]) < len(kept) <= triangles:
            best = moved[: len(vertices)] / _UNITS_PER_METRE, kept[rank], numbers[rank]
        low, high = (target, high) if fits else (low, target)
        if (fits and len(kept) >= CLOSE * triangles) or high - low <= 1:
            break
        guess = int(target * 0.5 * (1.0 + CLOSE) * triangles / max(len(kept), 1))
        target = guess if low < guess < high else (low + high) // 2
    return best


def _walls(vertices: Float64, faces: Int64) -> tuple[Float64, Int64]:
    """Strips that stand on the outlines of sheets: their vertices beyond the given ones, and their triangles."""
    normals = normalized(
        cross(
            vertices[faces[:, 1]] - vertices[faces[:, 0]],
            vertices[faces[:, 2]] - vertices[faces[:, 0]],
        )
    )
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    owner = np.tile(np.arange(len(faces)), 3)
    keys = edges.min(1) * len(vertices) + edges.max(1)
    _, first, inverse, counts = np.unique(keys, return_index=True, return_inverse=True, return_counts=True)
    total = np.zeros((len(first), 3))
    np.add.at(total, inverse, normals[owner])
    # |a + b|^2 = 2 + 2 cos of the angle between two normals.
    folded = (counts == 2) & ((total * total).sum(1) < 2.0 + 2.0 * _FOLD_COSINE)
    # An even number of edges that bound an odd number of triangles meet at each vertex. Folds may end somewhere: there
    # a wall would have a free edge on the sheet, which the library would take for its outline.
    stands = (counts % 2 == 1) | folded
    while True:
        degree = np.bincount(edges[first[stands]].reshape(-1), minlength=len(vertices))
        ends = stands & folded & (degree[edges[first]] == 1).any(1)
        if not ends.any():
            break
        stands &= ~ends
    outline = first[stands]
    a, b = edges[outline].T
    length = np.linalg.norm(vertices[a] - vertices[b], axis=1)
    up, reach, count = np.zeros_like(vertices), np.zeros(len(vertices)), np.zeros(len(vertices))
    for end in (a, b):
        np.add.at(up, end, normals[owner[outline]])
        np.add.at(reach, end, length)
        np.add.at(count, end, 1.0)
    used = np.flatnonzero(count)
    above = np.zeros(len(vertices), dtype=np.int64)
    above[used] = len(vertices) + np.arange(len(used))
    outer = vertices[used] + normalized(up[used]) * (reach[used] / count[used])[:, None]
    walls = np.concatenate([np.stack([b, a, above[a]], 1), np.stack([b, above[a], above[b]], 1)])
    return outer, walls


def _collapsed(points: Float64, faces: Int64, target: int) -> tuple[Float64, Int64, Int64]:
    """Points at their old numbers, faces that are left, and which they were."""
    from fast_simplification import simplify

    found: Any = simplify(points, faces.astype(np.int32), target_count=max(target, 1), return_collapses=True)
    moved, _, collapses = found
    into = np.arange(len(points))
    into[collapses[:, 1]] = collapses[:, 0]
    while not np.array_equal(into, further := into[into]):
        into = further
    left = into[faces]
    whole = (left[:, 0] != left[:, 1]) & (left[:, 1] != left[:, 2]) & (left[:, 2] != left[:, 0])
    left = left[whole]
    # The library puts what is still used one after another, in the old order.
    result = points.copy()
    result[np.unique(left)] = moved
    return result, left, np.flatnonzero(whole)
