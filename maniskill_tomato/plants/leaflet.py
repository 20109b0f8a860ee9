"""The blade of a leaflet: a lobed, folded and curled surface, meshed from both sides."""

from dataclasses import dataclass
from functools import lru_cache
from math import pi

import numpy as np

from maniskill_tomato.plants.meshing import Float64, Int64, Patch, cross, flipped, grid_faces, normalized


@dataclass(frozen=True, eq=False)
class Leaflet:
    """Shape and place of one leaflet."""

    base: Float64
    """Where the blade begins, in the plant frame, in [m]. Shape (3,)."""
    direction: Float64
    """Unit vector along the midrib at the base. Shape (3,)."""
    up: Float64
    """Unit vector out of the upper side at the base, across `direction`. Shape (3,)."""
    length: float
    """Length of the midrib, in [m]."""
    width: float
    """Greatest width without lobes, in [m]."""
    lobes: float
    """Lobes per side."""
    depth: float
    """Depth of the notches between lobes over the half width."""
    curl: float
    """Downward turn of the midrib over its length, in [rad]."""
    fold: float
    """Rise of the halves over their width."""
    curve: float
    """Fall of the margin over the half width."""
    waviness: float
    """Amplitude of the margin's wave over the half width."""
    phases: Float64
    """Phases of the lobes of the left and right side, of the margin's wave and its frequency, in [rad]. Shape
    (4,)."""
    asymmetry: float
    """Width of the left half less that of the right half, over the width."""

    @property
    def small(self) -> bool:
        """Whether this is one of the little leaflets between the large ones, meshed with few triangles."""
        return self.length < 0.045


def _half_width(leaflet: Leaflet, t: Float64, side: Float64, *, serrate: bool) -> Float64:
    """Half width along the midrib on one side (+1 left, -1 right), in [m]."""
    # Ovate, broadest at 0.28 of its length, drawn out into a point.
    t = np.minimum(np.maximum(t, 0.0), 1.0)
    envelope = 2.585 * t**0.45 * (1.0 - t) ** 1.15
    lobe_phase = 2 * pi * leaflet.lobes * t**0.9 + np.where(side > 0, leaflet.phases[0], leaflet.phases[1])
    # A raised cosine to a power: round lobes and narrow notches.
    sinus = (0.5 + 0.5 * np.cos(lobe_phase)) ** 1.7
    depth = leaflet.depth * (1.0 - 0.75 * t)
    outline = envelope * (1.0 - depth * sinus)
    if serrate:
        outline = outline * (1.0 + 0.016 * np.sin(4.0 * lobe_phase + 1.0) * np.sin(pi * t))
    return np.asarray(0.5 * leaflet.width * (1.0 + side * leaflet.asymmetry) * outline)


def _surface(leaflet: Leaflet, t: Float64, s: Float64, *, serrate: bool) -> Float64:
    """Points of the blade.

    Args:
        leaflet: Its shape.
        t: Parameter along the midrib, 0 at the base and 1 at the tip. Shape (...).
        s: Parameter across, -1 at the right margin, 0 on the midrib, 1 at the left margin. Shape (...).
        serrate: Whether the margin has its fine teeth.
    """
    side = np.where(s >= 0, 1.0, -1.0)
    half = _half_width(leaflet, t, side, serrate=serrate)
    across = s * half
    a = np.abs(s)
    # Side veins run forward, and the lobes with them.
    along = t + 0.16 * a * np.sin(pi * t) * (1.0 - 0.5 * t)
    rise = half * (leaflet.fold * a - leaflet.curve * a * a)
    wave = np.sin(2 * pi * (1.6 + 0.8 * np.sin(leaflet.phases[3])) * t + leaflet.phases[2] + 1.3 * side)
    rise = rise + half * leaflet.waviness * wave * a * a
    # The blade between the side veins bulges upward a little.
    veins = 2 * pi * leaflet.lobes * 2.0 * (t - 0.25 * a)
    rise = rise + 0.022 * leaflet.width * np.sin(veins) * a * (1.0 - a) * 4.0
    angle = leaflet.curl * along
    safe = leaflet.curl if abs(leaflet.curl) > 1e-6 else 1e-6
    x = np.sin(angle) / safe * leaflet.length
    z = -(1.0 - np.cos(angle)) / safe * leaflet.length
    # The rise is measured across the curled midrib.
    x, z = x + rise * np.sin(angle), z + rise * np.cos(angle)
    left = cross(leaflet.up, leaflet.direction)
    return np.asarray(
        leaflet.base + x[..., None] * leaflet.direction + across[..., None] * left + z[..., None] * leaflet.up
    )


def _rows(leaflet: Leaflet, *, picture: bool) -> Float64:
    """Parameters along the midrib at which the blade is cut. Shape (N,)."""
    if picture:
        return np.linspace(0.0, 1.0, 9 if leaflet.small else 33)
    if leaflet.small:
        return np.array([0.0, 0.3, 0.68, 1.0])
    # Cuts at the tips of lobes and in notches keep the outline with few triangles.
    phase = 0.5 * (leaflet.phases[0] + leaflet.phases[1])
    turns = (np.arange(-2, 2 * leaflet.lobes + 2) * pi - phase) / (2 * pi * leaflet.lobes)
    inner = turns[(turns > 0.06) & (turns < 0.90)] ** (1 / 0.9)
    if inner[0] > 0.13:
        inner = np.concatenate([[0.06], inner])
    return np.concatenate([[0.0], inner, [1.0]])


def _cuts(leaflet: Leaflet, *, picture: bool) -> tuple[Float64, Float64, Int64]:
    """Blade parameters t and s of the mesh's vertices, and its triangles. Shapes (V,), (V,), (F, 3)."""
    rows = _rows(leaflet, picture=picture)
    half_columns = 1 if not picture else (2 if leaflet.small else 4)
    columns = np.linspace(-1.0, 1.0, 2 * half_columns + 1)
    t = np.concatenate([[0.0], np.repeat(rows[1:-1], len(columns)), [1.0]])
    s = np.concatenate([[0.0], np.tile(columns, len(rows) - 2), [0.0]])
    return t, s, _blade_faces(len(rows), len(columns))


@lru_cache(maxsize=64)
def _blade_faces(rows: int, columns: int) -> Int64:
    """Triangles of a blade whose first and last row are one point each; read-only. Shape (F, 3)."""
    last = 1 + (rows - 3) * columns
    tip = 1 + (rows - 2) * columns
    fan = np.arange(columns - 1)
    faces = [
        np.stack([np.zeros(columns - 1, np.int64), 1 + fan, 2 + fan], 1),
        1 + grid_faces(rows - 2, columns)[:, ::-1],
        np.stack([last + fan, np.full(columns - 1, tip), last + fan + 1], 1),
    ]
    result = np.concatenate(faces).astype(np.int64)
    result.setflags(write=False)
    return result


def coarse_triangles(leaflet: Leaflet) -> Float64:
    """Corners of the blade's triangles at training detail, in [m]; no normals, so fast. Shape (F, 3, 3)."""
    t, s, faces = _cuts(leaflet, picture=False)
    return np.asarray(_surface(leaflet, t, s, serrate=False)[faces])


def blade(leaflet: Leaflet, *, picture: bool) -> Patch:
    """The upper side of a leaflet's blade."""
    t, s, faces = _cuts(leaflet, picture=picture)
    vertices = _surface(leaflet, t, s, serrate=picture)
    # Normals of the smooth blade: taken a little inside the margin, and to the side on which the point lies.
    step = 1e-3
    ti, si = np.clip(t, 0.04, 0.96), 0.85 * s
    around = _surface(
        leaflet,
        np.concatenate([ti + step, ti - step, ti, ti]),
        np.concatenate([si, si, si + step, si - step]),
        serrate=False,
    )
    ahead, behind, left, right = np.split(around, 4)
    across = np.where((s == 0)[:, None], cross(leaflet.up, leaflet.direction), left - right)
    normals = normalized(cross(ahead - behind, across))
    uvs = np.stack([0.02 + 0.96 * t, 0.5 + 0.48 * s], 1)
    return Patch(vertices, normals, uvs, faces)


def both_sides(leaflet: Leaflet, *, picture: bool) -> tuple[Patch, Patch]:
    """Upper and lower side of a leaflet; SAPIEN draws only the side whose triangles face the camera."""
    upper = blade(leaflet, picture=picture)
    return upper, flipped(upper)
