"""The shapes one sees of the arm and its camera, modelled from scratch in the look of the real ones.

Each shell of the arm joins two joints, one about z and one about y, so it is a tube that swells into the housing of the
joint beside it. Lengths are in [m]; the shells are modelled where they stand in the home configuration, with the origin
in the centre of the joint they swell around.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from maniskill_tomato.robot import d435, iiwa14, solids

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Material:
    """How a surface looks."""

    color: tuple[float, float, float]
    """Base colour as linear red, green, blue in 0 to 1."""
    roughness: float
    """0 is a mirror, 1 is chalk."""
    metallic: float
    """0 for paint and plastic, 1 for bare metal."""


MATERIALS: Final = {
    "paint": Material(color=(0.78, 0.79, 0.80), roughness=0.38, metallic=0.0),
    "orange": Material(color=(0.95, 0.17, 0.005), roughness=0.42, metallic=0.0),
    "dark": Material(color=(0.035, 0.037, 0.04), roughness=0.55, metallic=0.0),
    "flange": Material(color=(0.16, 0.165, 0.175), roughness=0.4, metallic=0.6),
    "printed": Material(color=(0.02, 0.02, 0.022), roughness=0.8, metallic=0.0),
    "aluminium": Material(color=(0.60, 0.61, 0.63), roughness=0.35, metallic=0.7),
    "glass": Material(color=(0.006, 0.006, 0.008), roughness=0.12, metallic=0.0),
    "lens": Material(color=(0.035, 0.03, 0.06), roughness=0.08, metallic=0.2),
}


@dataclass(frozen=True, kw_only=True)
class Part:
    """A piece of a link in one material."""

    material: str
    """Key of `MATERIALS`."""
    vertices: FloatArray
    """Vertices in the link frame, in [m]. Shape (V, 3)."""
    normals: FloatArray
    """Unit normals. Shape (V, 3)."""
    faces: npt.NDArray[np.int64]
    """Vertex indices, counter-clockwise from outside. Shape (F, 3)."""

    def placed(self, rotation: npt.ArrayLike, offset: npt.ArrayLike) -> "Part":
        """The part turned by `rotation` (3, 3) and then moved by `offset` (3,) in [m]."""
        r = np.asarray(rotation, dtype=np.float64)
        return Part(
            material=self.material,
            vertices=self.vertices @ r.T + np.asarray(offset, dtype=np.float64),
            normals=self.normals @ r.T,
            faces=self.faces,
        )


TUBE_RADII: Final = {1: 0.082, 3: 0.076, 5: 0.067, 7: 0.050}
"""Radius of the seam of the joints that turn about z, in [m]."""

HOUSING_RADII: Final = {2: 0.093, 4: 0.086, 6: 0.063}
"""Radius of the seam of the joints that turn about y, in [m]."""

HOUSING_DEPTHS: Final = {1: 0.112, 2: 0.112, 3: 0.106, 4: 0.106, 5: 0.122, 6: 0.066}
"""How far each link's housing reaches sideways from the middle of the arm, in [m]."""

SEAM: Final = 0.0022
"""Half the width of the dark groove between two links, in [m]."""

_GRID: Final = 0.0145
_TO_Y: Final = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Turns z into y."""


def _shell(
    solid: solids.Solid, lower: list[float], upper: list[float], material: str = "paint", grid: float = _GRID
) -> Part:
    vertices, normals, faces = solids.triangulate(solid, lower, upper, grid)
    return Part(material=material, vertices=vertices, normals=normals, faces=faces)


def _turned(profile: list[tuple[float, float]], material: str, segments: int = 40) -> Part:
    vertices, normals, faces = solids.revolve(profile, segments)
    return Part(material=material, vertices=vertices, normals=normals, faces=faces)


def _seam(radius: float) -> Part:
    """The dark ring at the bottom of a groove, about z."""
    return _turned([(radius - 0.004, -SEAM), (radius - 0.004, SEAM)], "dark")


def _cap(radius: float, thickness: float, bulge: float, material: str = "orange") -> Part:
    """A domed cover about z with a rounded rim, its foot at z = 0."""
    rim = 0.35 * thickness
    dome = [
        (radius * np.cos(t) * 0.94, thickness + bulge * np.sin(t))
        for t in np.linspace(0.0, np.pi / 2, 6)[1:-1]
    ]
    return _turned(
        [
            (radius, -0.006),
            (radius, thickness - rim),
            (radius - 0.3 * rim, thickness - 0.2 * rim),
            (radius * 0.94, thickness),
            *dome,
            (0.0, thickness + bulge),
        ],
        material,
        36,
    )


def _housing(side: float, face: float, depth: float, radius: float) -> solids.Solid:
    """A drum about y from the joint's plane y = `face` out to `depth` on the side +1 or -1, with a domed end."""
    inner = [0.0, face - side * 0.05, 0.0]
    drum = solids.cylinder(inner, [0.0, side * (depth - 0.010), 0.0], radius, rounding=0.034)
    dome = solids.ellipsoid([0.0, side * (depth - 0.050), 0.0], [radius * 0.93, 0.050, radius * 0.93])
    return solids.blend(drum, dome, radius=0.02)


def _moved(solid: solids.Solid, offset: npt.ArrayLike) -> solids.Solid:
    shift = np.asarray(offset, dtype=np.float64)
    return lambda points: solid(points - shift)


def _base() -> list[Part]:
    foot = solids.cylinder([0, 0, -0.02], [0, 0, 0.016], 0.112, rounding=0.006)
    bulge = solids.round_cone([0, 0, 0.035], [0, 0, 0.100], 0.098, 0.084)
    neck = solids.cylinder([0, 0, 0.05], [0, 0, 0.20], TUBE_RADII[1])
    sockets = solids.box([-0.100, 0, 0.040], [0.130, 0.108, 0.072], rounding=0.014)
    body = solids.blend(solids.blend(bulge, neck, radius=0.03), sockets, radius=0.03)
    body = solids.common(
        solids.blend(body, foot, radius=0.012),
        solids.half_space([0, 0, 0.1475 - SEAM], [0, 0, 1]),
        solids.half_space([0, 0, 0], [0, 0, -1]),
    )
    panel = solids.box([-0.155, 0, 0.040], [0.026, 0.080, 0.046], rounding=0.002)
    return [
        _shell(body, [-0.17, -0.115, 0.0], [0.115, 0.115, 0.15], grid=0.0165),
        _shell(panel, [-0.17, -0.05, 0.01], [-0.14, 0.05, 0.07], "dark", grid=0.012),
        _seam(TUBE_RADII[1]).placed(np.eye(3), [0, 0, 0.1475]),
    ]


def _shoulder_like(
    *, z_seam: float, r_seam: float, side: float, face: float, depth: float, radius: float
) -> solids.Solid:
    """A shell between a seam about z at the height `z_seam` and a seam about y at y = `face`, in the home pose.

    Its origin is where the two axes meet; the housing lies on the `side` (+1 or -1) of the face.
    """
    end = float(np.sign(z_seam))
    lean = [0.0, side * (abs(depth + side * face) / 2 + side * face * 0.0), end * 0.3 * radius]
    tube = solids.blend(
        solids.cylinder([0, 0, z_seam - end * 0.055], [0, 0, z_seam + end * 0.05], r_seam),
        solids.round_cone([0, 0, z_seam - end * 0.075], lean, r_seam * 0.985, radius * 0.72),
        radius=0.03,
    )
    drum = _housing(side, face, depth, radius)
    body = solids.blend(tube, drum, radius=0.07)
    inner, outer = [0.0, face, 0.0], [0.0, face - side * 0.4, 0.0]
    notch = solids.cylinder(inner, outer, radius + 0.022, rounding=0.0)
    return solids.common(
        solids.cut(body, notch, _moved(notch, [0, side * SEAM, 0])),
        solids.half_space([0, 0, z_seam - end * SEAM], [0, 0, end]),
    )


def _arm_link(index: int) -> list[Part]:
    """Links 1 to 4: two of each kind, mirrored."""
    odd = index % 2 == 1
    seam_joint = index if odd else index + 1
    housing_joint = index + 1 if odd else index
    heights = {1: 0.1475, 2: 0.360, 3: 0.588, 4: 0.780, 5: 0.9875, 6: 1.180, 7: 1.271}
    faces = {2: -0.010, 4: 0.0105, 6: -0.0707}
    z_seam = heights[seam_joint] - heights[housing_joint]
    face = faces[housing_joint]
    side = {1: -1.0, 2: 1.0, 3: 1.0, 4: -1.0}[index]
    radius = HOUSING_RADII[housing_joint]
    depth = HOUSING_DEPTHS[index]
    solid = _shoulder_like(
        z_seam=z_seam, r_seam=TUBE_RADII[seam_joint], side=side, face=face, depth=depth, radius=radius
    )
    low = [-radius - 0.01, -depth - 0.02, min(z_seam, -radius) - 0.01]
    high = [radius + 0.01, depth + 0.02, max(z_seam, radius) + 0.01]
    parts = [_shell(solid, low, high)]
    origin = np.array([0.0, 0.0, 0.0 if not odd else -z_seam])
    shift = -np.array([0.0, 0.0 if odd else face, 0.0]) + origin
    parts = [p.placed(np.eye(3), shift) for p in parts]
    return parts


def link_parts(name: str) -> list[Part]:
    """The pieces of a link, in its link frame."""
    if name == "link_0":
        return _base()
    if name in ("link_1", "link_2", "link_3", "link_4"):
        return _arm_link(int(name[-1]))
    return [_seam(0.03)]
