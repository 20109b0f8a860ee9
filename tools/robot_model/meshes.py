"""The shapes one sees of the arm and its camera, modelled from scratch in the look of the real ones.

Each shell of the arm joins two joints, one about z and one about y, so it is a tube that swells into the
housing of the joint beside it. Lengths are in [m]; the shells are modelled where they stand in the home
configuration, with the origin in the centre of the joint they swell around.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np
import numpy.typing as npt

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.robot import d435, iiwa14
from robot_model import solids

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
    "paint": Material(color=(0.70, 0.71, 0.72), roughness=0.38, metallic=0.0),
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


SEAM: Final = 0.0022
"""Half the width of the dark groove between two links, in [m]."""

_HEIGHTS: Final = np.cumsum(iiwa14.JOINT_ORIGINS[:, 2])
"""Height of each joint in the home configuration, in [m]. Shape (7,)."""

_FACES: Final = np.cumsum(iiwa14.JOINT_ORIGINS[:, 1])
"""Sideways position of each joint in the home configuration, in [m]; where two housings meet. Shape (7,)."""

_TUBE_RADII: Final = {1: 0.082, 3: 0.076, 5: 0.067, 7: 0.050}
"""Radius of the seam of the joints that turn about z, in [m]."""

_HOUSING_RADII: Final = {2: 0.094, 4: 0.087, 6: 0.064}
"""Radius of the seam of the joints that turn about y, in [m]."""

_HOUSING_REACH: Final = {1: -0.112, 2: 0.112, 3: 0.106, 4: -0.106, 5: -0.120, 6: 0.066}
"""How far each shell's housing reaches sideways (y) from the middle of the arm, in [m]."""

_GRID: Final = 0.016
"""Length of a triangle's side on the shells, in [m]."""

_TO_Y: Final = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Turns z into y."""

_TO_MINUS_Y: Final = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Turns z into -y."""


def _shell(
    solid: solids.Solid, lower: Sequence[float], upper: Sequence[float], material: str, grid: float = _GRID
) -> Part:
    vertices, normals, faces = solids.triangulate(solid, lower, upper, grid)
    return Part(material=material, vertices=vertices, normals=normals, faces=faces)


def _turned(profile: Sequence[Sequence[float]], material: str, segments: int = 40) -> Part:
    vertices, normals, faces = solids.revolve(profile, segments)
    return Part(material=material, vertices=vertices, normals=normals, faces=faces)


def _seam(radius: float) -> Part:
    """The dark ring at the bottom of a groove, about z."""
    return _turned([(radius - 0.004, -1.5 * SEAM), (radius - 0.004, 1.5 * SEAM)], "dark")


def _base() -> list[Part]:
    """Link 0: a round foot, a neck, and the block with the sockets behind."""
    neck = _TUBE_RADII[1]
    top = iiwa14.JOINT_ORIGINS[0, 2] - SEAM
    profile = [
        (0.0, 0.0),
        (0.110, 0.0),
        (0.112, 0.003),
        (0.112, 0.013),
        (0.109, 0.016),
        (0.101, 0.017),
        (0.099, 0.030),
        (0.0975, 0.050),
        (0.0945, 0.075),
        (0.0890, 0.100),
        (0.0845, 0.118),
        (neck, 0.134),
        (neck, top),
        (0.0, top),
    ]
    sockets = solids.box([-0.105, 0.0, 0.043], [0.125, 0.110, 0.070], rounding=0.012)
    panel = solids.box([-0.155, 0.0, 0.043], [0.030, 0.082, 0.044], rounding=0.003)
    return [
        _turned(profile, "paint", 44),
        _shell(sockets, [-0.168, -0.055, 0.008], [-0.042, 0.055, 0.078], "paint", 0.0115),
        _shell(panel, [-0.171, -0.042, 0.02], [-0.139, 0.042, 0.066], "dark", 0.0105),
        _seam(neck).placed(np.eye(3), [0.0, 0.0, iiwa14.JOINT_ORIGINS[0, 2]]),
    ]


def _bent(
    *, seam_height: float, seam_radius: float, face: float, reach: float, radius: float
) -> solids.Solid:
    """The shell between a seam about z and a seam about y, where the two axes meet in the origin.

    Args:
        seam_height: Height of the seam about z, in [m]; its sign says whether the shell hangs or stands.
        seam_radius: Radius of that seam, in [m].
        face: Plane y = `face` of the other seam, in [m].
        reach: Where the housing of that joint ends, in [m].
        radius: Radius of the housing, in [m].
    """
    up = float(np.sign(seam_height))
    side = float(np.sign(reach - face))
    tube = solids.leaning_tube(
        [0.0, 0.0, seam_height + up * 0.05],
        [0.0, 0.55 * face + 0.45 * reach, up * 0.1 * radius],
        seam_radius,
        0.70 * radius,
        straight=(0.05 + 0.018) / (0.05 + abs(seam_height) - 0.1 * radius),
    )
    drum = solids.cylinder(
        [0.0, face - side * 0.05, 0.0], [0.0, reach - side * 0.012, 0.0], radius, rounding=0.036
    )
    dome = solids.ellipsoid([0.0, reach - side * 0.050, 0.0], [0.90 * radius, 0.050, 0.90 * radius])
    body = solids.blend(
        tube, solids.blend(drum, dome, radius=0.02), radius=min(0.05, 0.36 * abs(seam_height))
    )
    # The neighbour swings here; the wrist's is short and wide, so it needs more room.
    clearance = 0.020 if abs(face) < 0.05 else 0.032
    notch = solids.cylinder([0.0, face + side * SEAM, 0.0], [0.0, face - side * 0.4, 0.0], radius + clearance)
    return solids.common(
        solids.cut(body, notch), solids.half_space([0.0, 0.0, seam_height - up * SEAM], [0.0, 0.0, up])
    )


def _shell_link(index: int) -> list[Part]:
    """Links 1 to 6. Odd ones have their housing at the upper end, even ones at the lower end, with a cap."""
    odd = index % 2 == 1
    tube_joint, housing_joint = (index, index + 1) if odd else (index + 1, index)
    seam_height = float(_HEIGHTS[tube_joint - 1] - _HEIGHTS[housing_joint - 1])
    face, reach = float(_FACES[housing_joint - 1]), _HOUSING_REACH[index]
    radius, seam_radius = _HOUSING_RADII[housing_joint], _TUBE_RADII[tube_joint]
    solid = _bent(seam_height=seam_height, seam_radius=seam_radius, face=face, reach=reach, radius=radius)
    margin = 0.02
    low = [-radius - margin, min(face, reach, -seam_radius) - margin, min(seam_height, -radius) - margin]
    high = [radius + margin, max(face, reach, seam_radius) + margin, max(seam_height, radius) + margin]
    parts = [_shell(solid, low, high, "paint", _GRID if index < 5 else 0.0132)]
    if odd:
        parts.append(_seam(seam_radius).placed(np.eye(3), [0.0, 0.0, seam_height]))
    else:
        parts.append(_seam(radius).placed(_TO_Y, [0.0, face, 0.0]))
        side = float(np.sign(reach - face))
        bore = solids.cylinder(
            [0.0, reach - side * 0.045, 0.0], [0.0, reach + side * 0.1, 0.0], 0.72 * radius
        )
        parts.append(_shell(solids.common(solids.grown(solid, 0.0022), bore), low, high, "orange", 0.0155))
    frame = np.array([0.0, _FACES[index - 1], _HEIGHTS[index - 1] - _HEIGHTS[housing_joint - 1]])
    return [part.placed(np.eye(3), -frame) for part in parts]


def _wrist_flange() -> list[Part]:
    """Link 7: the turning flange."""
    length = iiwa14.EE_ORIGIN[2]
    profile = [
        (0.0, SEAM),
        (0.050, SEAM),
        (0.050, 0.012),
        (0.0475, 0.015),
        (0.0475, length - 0.004),
        (0.0455, length),
        (0.0325, length),
        (0.0315, length - 0.002),
        (0.0, length - 0.002),
    ]
    bolts = []
    for angle in np.arange(8) * np.pi / 4 + np.pi / 8:
        bolt = _turned([(0.0035, 0.0), (0.0035, 0.0008), (0.0, 0.0008)], "dark", 8)
        bolts.append(bolt.placed(np.eye(3), [0.0395 * np.cos(angle), 0.0395 * np.sin(angle), length]))
    return [_turned(profile, "flange"), *bolts]


def _stadium(profile: Sequence[Sequence[float]], material: str, stretch: float) -> Part:
    """A profile turned about z and stretched along y."""
    vertices, normals, faces = solids.revolve(profile, 36, stretch)
    part = Part(material=material, vertices=vertices, normals=normals, faces=faces)
    return part.placed([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], np.zeros(3))


def _bracket() -> list[Part]:
    """The printed part between the flange and the back of the camera."""
    back = d435.GLASS_TO_FLANGE - d435.BODY_SIZE[0]
    disc = [
        (0.0, -0.0015),
        (0.0310, -0.0015),
        (0.0340, 0.0005),
        (0.0340, 0.006),
        (0.0330, 0.007),
        (0.0, 0.007),
    ]
    post = [
        (0.0130, 0.006),
        (0.0105, 0.010),
        (0.0100, 0.014),
        (0.0100, back - 0.007),
        (0.0118, back - 0.005),
        (0.0118, back),
        (0.0, back),
    ]
    return [_turned(disc, "printed"), _stadium(post, "printed", 0.022)]


def _camera() -> list[Part]:
    """The D435: a rounded aluminium bar, dark glass, four round windows; in the frame of `camera_link`."""
    depth, width, height = d435.BODY_SIZE
    round_, stretch = height / 2, (width - height) / 2
    glass = round_ - 0.0021
    housing = [
        (0.0, 0.0),
        (round_ - 0.0035, 0.0),
        (round_ - 0.0010, 0.0008),
        (round_, 0.0030),
        (round_, depth - 0.0016),
        (round_ - 0.0005, depth - 0.0006),
        (round_ - 0.0014, depth - 0.0002),
        (glass, depth - 0.0006),
    ]
    turn = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    back = [d435.GLASS_X - depth, d435.BODY_CENTER[1], 0.0]
    front = _stadium([(glass, depth - 0.0008), (glass, depth), (0.0, depth)], "glass", stretch)
    parts = [_stadium(housing, "aluminium", stretch).placed(turn, back), front.placed(turn, back)]
    windows = ((0.0, 0.0042), (-0.050, 0.0042), (0.015, 0.0036), (-0.0285, 0.0048))
    for y, radius in windows:
        ring = _turned([(radius + 0.0012, 0.0), (radius + 0.0012, 0.0003), (radius, 0.0003)], "dark", 20)
        lens = _turned([(radius, 0.0003), (0.6 * radius, 0.0007), (0.0, 0.0009)], "lens", 20)
        parts += [part.placed(turn, [d435.GLASS_X, y, 0.0]) for part in (ring, lens)]
    return parts


def link_parts(name: str) -> list[Part]:
    """The pieces of the link `name` that one sees, in its link frame.

    Raises:
        InvalidInputError: The link is unknown or has nothing to see.
    """
    makers: dict[str, Callable[[], list[Part]]] = {
        "link_0": _base,
        **{f"link_{i}": partial(_shell_link, i) for i in range(1, 7)},
        "link_7": _wrist_flange,
        "link_ee": _bracket,
        "camera_link": _camera,
    }
    if name not in makers:
        raise InvalidInputError.choice("link", name, makers)
    return makers[name]()
