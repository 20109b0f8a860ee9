"""Solids as signed distance functions, and the triangles on their surface.

A solid is a function of points (N, 3) in [m] that returns distances (N,) in [m], negative inside. Distances
need only be right near the surface. Blends of simple solids give the cast, bulging shells of a robot arm,
which are hard to write down as surfaces.
"""

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
Solid = Callable[[FloatArray], FloatArray]

_GRADIENT_STEP = 1e-5
_CREASE_COSINE = np.cos(np.deg2rad(30.0))


def _vector(values: Sequence[float]) -> FloatArray:
    return np.asarray(values, dtype=np.float64)


def _axial(points: FloatArray, start: FloatArray, end: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Height along and distance from the line start-end, in [m], and the line's length."""
    length = float(np.linalg.norm(end - start))
    axis = (end - start) / length
    rel = points - start
    height = rel @ axis
    return height, np.linalg.norm(rel - height[:, None] * axis, axis=1), length


def cylinder(start: Sequence[float], end: Sequence[float], radius: float, rounding: float = 0.0) -> Solid:
    """A cylinder between two points whose rims are rounded with the radius `rounding`, in [m]."""
    a, b = _vector(start), _vector(end)

    def solid(points: FloatArray) -> FloatArray:
        height, radial, length = _axial(points, a, b)
        dr = radial - (radius - rounding)
        dh = np.abs(height - length / 2) - (length / 2 - rounding)
        outside = np.hypot(np.maximum(dr, 0), np.maximum(dh, 0))
        return np.asarray(outside + np.minimum(np.maximum(dr, dh), 0) - rounding)

    return solid


def leaning_tube(
    start: Sequence[float], end: Sequence[float], r_start: float, r_end: float, straight: float
) -> Solid:
    """A tube that leaves `start` along z, drifts to a round `end` and changes its radius smoothly on the way.

    Args:
        start: Centre of the first end, in [m].
        end: Centre of the other end, at another height, in [m].
        r_start: Radius at `start`, in [m].
        r_end: Radius at `end`, in [m].
        straight: Share of the height over which the tube stays as it starts.
    """
    a, b = _vector(start), _vector(end)

    def solid(points: FloatArray) -> FloatArray:
        share = (points[:, 2] - a[2]) / (b[2] - a[2])
        t = np.clip((share - straight) / (1.0 - straight), 0.0, 1.0)
        smooth = t * t * (3.0 - 2.0 * t)
        centre = a[:2] + smooth[:, None] * (b - a)[:2]
        beyond = np.maximum(np.sign(b[2] - a[2]) * (points[:, 2] - b[2]), 0.0)
        radial = np.hypot(np.linalg.norm(points[:, :2] - centre, axis=1), beyond)
        return np.asarray(radial - (r_start + smooth * (r_end - r_start)))

    return solid


def grown(solid: Solid, thickness: float) -> Solid:
    """A solid grown on all sides, in [m]."""
    return lambda points: solid(points) - thickness


def box(center: Sequence[float], size: Sequence[float], rounding: float = 0.0) -> Solid:
    """An axis-aligned box with edges rounded with the radius `rounding`, in [m]."""
    c, half = _vector(center), _vector(size) / 2 - rounding

    def solid(points: FloatArray) -> FloatArray:
        d = np.abs(points - c) - half
        outside = np.linalg.norm(np.maximum(d, 0), axis=1)
        return np.asarray(outside + np.minimum(d.max(axis=1), 0) - rounding)

    return solid


def ellipsoid(center: Sequence[float], radii: Sequence[float]) -> Solid:
    """An axis-aligned ellipsoid, in [m]."""
    c, r = _vector(center), _vector(radii)

    def solid(points: FloatArray) -> FloatArray:
        rel = points - c
        k0 = np.linalg.norm(rel / r, axis=1)
        k1 = np.linalg.norm(rel / r**2, axis=1)
        return np.asarray(k0 * (k0 - 1.0) / np.maximum(k1, 1e-9))

    return solid


def half_space(point: Sequence[float], normal: Sequence[float]) -> Solid:
    """Everything behind the plane through `point` whose outward normal is `normal`."""
    p, n = _vector(point), _vector(normal)
    n = n / np.linalg.norm(n)

    def solid(points: FloatArray) -> FloatArray:
        return np.asarray((points - p) @ n)

    return solid


def blend(*solids: Solid, radius: float) -> Solid:
    """The union of solids with fillets of about `radius`, in [m]."""

    def solid(points: FloatArray) -> FloatArray:
        result = solids[0](points)
        for other in solids[1:]:
            d = other(points)
            h = np.maximum(radius - np.abs(result - d), 0) / radius
            result = np.minimum(result, d) - h**2 * (radius / 4)
        return result

    return solid


def common(*solids: Solid) -> Solid:
    """What the solids have in common; its edges stay sharp."""

    def solid(points: FloatArray) -> FloatArray:
        return np.asarray(np.max([s(points) for s in solids], axis=0))

    return solid


def cut(body: Solid, *tools: Solid) -> Solid:
    """`body` without the `tools`; the edges stay sharp."""

    def solid(points: FloatArray) -> FloatArray:
        return np.asarray(np.max([body(points), *(-t(points) for t in tools)], axis=0))

    return solid


def _gradient(solid: Solid, points: FloatArray) -> FloatArray:
    offsets = np.eye(3) * _GRADIENT_STEP
    stacked = np.concatenate([points + o for o in offsets] + [points - o for o in offsets])
    values = solid(stacked).reshape(2, 3, len(points))
    gradient = (values[0] - values[1]).T
    return np.asarray(gradient / np.maximum(np.linalg.norm(gradient, axis=1, keepdims=True), 1e-12))


def triangulate(
    solid: Solid, lower: Sequence[float], upper: Sequence[float], step: float
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Triangles on the surface of a solid, by dual contouring of a regular grid: sharp edges stay sharp.

    Args:
        solid: The solid.
        lower: Corner of a box around the solid, in [m]. Shape (3,).
        upper: The opposite corner, in [m]. Shape (3,).
        step: Width of the grid's cells, about the length of the triangles' sides, in [m].

    Returns:
        Vertices (V, 3) in [m], unit normals (V, 3), faces (F, 3) counter-clockwise from outside. Vertices on
        sharp edges are repeated, once for each side.
    """
    low, high = _vector(lower) - step, _vector(upper) + step
    counts = np.ceil((high - low) / step).astype(np.int64) + 1
    axes = [low[k] + step * np.arange(counts[k]) for k in range(3)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    values = solid(grid.reshape(-1, 3)).reshape(tuple(counts))
    inside = values < 0

    edge_cells: list[IntArray] = []
    edge_points: list[FloatArray] = []
    quads: list[IntArray] = []
    cell_counts = counts - 1
    strides = np.array([cell_counts[1] * cell_counts[2], cell_counts[2], 1])
    for k in range(3):
        unit = np.eye(3, dtype=np.int64)[k]
        starts = np.argwhere(
            inside[tuple(slice(None, -1) if j == k else slice(None) for j in range(3))]
            != inside[tuple(slice(1, None) if j == k else slice(None) for j in range(3))]
        )
        ends = starts + unit
        a, b = grid[tuple(starts.T)], grid[tuple(ends.T)]
        edge_points.append(_crossings(solid, a, b, values[tuple(starts.T)]))
        u, v = np.eye(3, dtype=np.int64)[(k + 1) % 3], np.eye(3, dtype=np.int64)[(k + 2) % 3]
        ring = np.stack([starts - u - v, starts - v, starts, starts - u], axis=1) @ strides
        quads.append(np.where(inside[tuple(starts.T)][:, None], ring, ring[:, ::-1]))
        edge_cells.append(ring)

    cells, points = np.concatenate(edge_cells), np.concatenate(edge_points)
    used, corner_of = np.unique(cells, return_inverse=True)
    corner_of = corner_of.reshape(cells.shape)
    vertices = _place_vertices(solid, points, corner_of, len(used))
    quad_faces = np.searchsorted(used, np.concatenate(quads))
    return _with_normals(solid, vertices, _split_quads(vertices, quad_faces))


def _crossings(solid: Solid, a: FloatArray, b: FloatArray, da: FloatArray) -> FloatArray:
    """Where the segments a-b cross the surface, by bisection."""
    low, high = np.zeros(len(a)), np.ones(len(a))
    for _ in range(30):
        middle = (low + high) / 2
        d = solid(a + middle[:, None] * (b - a))
        same = (d < 0) == (da < 0)
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    return a + ((low + high) / 2)[:, None] * (b - a)


def _place_vertices(solid: Solid, points: FloatArray, corner_of: IntArray, count: int) -> FloatArray:
    """One vertex a cell, nearest to the tangent planes where the surface crosses the cell's edges."""
    normals = _gradient(solid, points)
    weight = np.zeros(count)
    mean = np.zeros((count, 3))
    for c in range(4):
        np.add.at(weight, corner_of[:, c], 1.0)
        np.add.at(mean, corner_of[:, c], points)
    mean /= weight[:, None]
    ata = np.zeros((count, 3, 3))
    atb = np.zeros((count, 3))
    outer = normals[:, :, None] * normals[:, None, :]
    for c in range(4):
        cell = corner_of[:, c]
        offset = np.einsum("ij,ij->i", normals, points - mean[cell])
        np.add.at(ata, cell, outer)
        np.add.at(atb, cell, normals * offset[:, None])
    eigenvalues, eigenvectors = np.linalg.eigh(ata / weight[:, None, None])
    inverse = np.where(eigenvalues > 0.05, 1.0 / np.maximum(eigenvalues, 1e-9), 0.0)
    projected = np.einsum("nij,ni->nj", eigenvectors, atb / weight[:, None])
    placed: FloatArray = mean + np.einsum("nij,nj->ni", eigenvectors, inverse * projected)
    # Tangent planes meet a little outside of a round surface.
    return placed - solid(placed)[:, None] * _gradient(solid, placed)


def _split_quads(vertices: FloatArray, quads: IntArray) -> IntArray:
    """Two triangles a quad, along its shorter diagonal; those without area are left out."""
    p = vertices[quads]
    first = np.linalg.norm(p[:, 0] - p[:, 2], axis=1) <= np.linalg.norm(p[:, 1] - p[:, 3], axis=1)
    split = np.where(
        first[:, None, None],
        quads[:, [[0, 1, 2], [0, 2, 3]]],
        quads[:, [[1, 2, 3], [1, 3, 0]]],
    )
    faces: IntArray = split.reshape(-1, 3)
    q = vertices[faces]
    area = np.linalg.norm(np.cross(q[:, 1] - q[:, 0], q[:, 2] - q[:, 0]), axis=1)
    return np.asarray(faces[area > 1e-9])


def _with_normals(
    solid: Solid, vertices: FloatArray, faces: IntArray
) -> tuple[FloatArray, FloatArray, IntArray]:
    """The surface's own normals; vertices where the faces disagree are split into one for each side."""
    p = vertices[faces]
    face_normals = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    face_normals /= np.linalg.norm(face_normals, axis=1, keepdims=True)
    smooth = _gradient(solid, vertices)
    agree = np.einsum("fij,fj->fi", smooth[faces], face_normals) > _CREASE_COSINE
    creased = np.zeros(len(vertices), dtype=bool)
    creased[faces[~agree]] = True

    out_vertices, out_normals = [vertices], [smooth]
    out_faces = faces.copy()
    total = len(vertices)
    inner = _gradient(solid, (0.6 * p + 0.4 * p.mean(axis=1, keepdims=True)).reshape(-1, 3)).reshape(p.shape)
    for vertex in np.flatnonzero(creased):
        rows, columns = np.nonzero(faces == vertex)
        clusters: list[tuple[FloatArray, list[int]]] = []
        for i, normal in enumerate(inner[rows, columns]):
            for total_normal, members in clusters:
                if normal @ total_normal > _CREASE_COSINE * np.linalg.norm(total_normal):
                    total_normal += normal
                    members.append(i)
                    break
            else:
                clusters.append((normal.copy(), [i]))
        for total_normal, members in clusters:
            out_vertices.append(vertices[vertex : vertex + 1])
            out_normals.append((total_normal / np.linalg.norm(total_normal))[None])
            out_faces[rows[members], columns[members]] = total
            total += 1
    all_vertices, all_normals = np.concatenate(out_vertices), np.concatenate(out_normals)
    kept, renumbered = np.unique(out_faces, return_inverse=True)
    return all_vertices[kept], all_normals[kept], renumbered.reshape(out_faces.shape)


def revolve(
    profile: Sequence[Sequence[float]], segments: int = 36, stretch: float = 0.0
) -> tuple[FloatArray, FloatArray, IntArray]:
    """The surface swept by a profile turning about the z axis; its edges above 30 degrees stay sharp.

    Args:
        profile: Radius and height of each point, in [m], such that the outside is to the right when walking
            along it. Shape (P, 2).
        segments: Number of facets around the axis, even.
        stretch: How far the two halves are moved apart, each along its own direction of x, in [m]: circles
            become stadiums.

    Returns:
        Vertices (V, 3) in [m], unit normals (V, 3), faces (F, 3) counter-clockwise from outside.
    """
    points = np.asarray(profile, dtype=np.float64)
    tangents = np.diff(points, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    outward = np.stack([tangents[:, 1], -tangents[:, 0]], axis=1)
    if stretch:
        half = np.pi * np.arange(segments // 2 + 1) / (segments // 2) - np.pi / 2
        angles = np.concatenate([half, half + np.pi])
        core = np.repeat([stretch, -stretch], len(half))
    else:
        angles = 2 * np.pi * np.arange(segments) / segments
        core = np.zeros(segments)
    around = np.stack([np.cos(angles), np.sin(angles), np.zeros(len(angles))], axis=1)
    centre = np.stack([core, np.zeros(len(angles)), np.zeros(len(angles))], axis=1)
    up = np.array([0.0, 0.0, 1.0])

    j = np.arange(len(angles))
    following = (j + 1) % len(angles)
    vertices: list[FloatArray] = []
    normals: list[FloatArray] = []
    faces: list[IntArray] = []
    for i in range(len(tangents)):
        base = 2 * i * len(angles)
        for end, neighbour in ((i, i - 1), (i + 1, i + 1)):
            normal = outward[i]
            if 0 <= neighbour < len(tangents) and outward[i] @ outward[neighbour] > _CREASE_COSINE:
                normal = (outward[i] + outward[neighbour]) / np.linalg.norm(outward[i] + outward[neighbour])
            vertices.append(centre + points[end, 0] * around + points[end, 1] * up)
            normals.append(normal[0] * around + normal[1] * up)
        a, b = base + j, base + following
        c, d = b + len(angles), a + len(angles)
        faces += [np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]
    return _compact(np.concatenate(vertices), np.concatenate(normals), np.concatenate(faces))


def _compact(
    vertices: FloatArray, normals: FloatArray, faces: IntArray
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Without the triangles that have no area and the vertices that no triangle uses."""
    p = vertices[faces]
    area = np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1)
    used, renumbered = np.unique(faces[area > 1e-12], return_inverse=True)
    return vertices[used], normals[used], renumbered.reshape(-1, 3)
