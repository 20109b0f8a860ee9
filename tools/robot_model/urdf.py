"""The URDF of the arm with the camera on its flange, written from the numbers in `iiwa14` and `d435`."""

import math
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
import numpy.typing as npt

from maniskill_tomato.robot import d435, iiwa14

Vector = tuple[float, float, float]

BRACKET_MASS: Final = 0.030
"""Mass of the printed camera bracket on the flange, in [kg] (a guess: 25 cm^3 of plastic)."""


@dataclass(frozen=True, kw_only=True)
class Inertial:
    """Mass, centre of mass and inertia of a link, in its link frame."""

    mass: float
    """Mass, in [kg]."""
    com: Vector
    """Centre of mass, in [m]."""
    diagonal: Vector
    """Ixx, Iyy, Izz about the centre of mass, in [kg m^2]."""
    products: Vector = (0.0, 0.0, 0.0)
    """Ixy, Ixz, Iyz about the centre of mass, in [kg m^2]."""


LINK_INERTIALS: Final = (
    Inertial(
        mass=7.050378,
        com=(-0.012822, 0.0, 0.071507),
        diagonal=(0.031226, 0.039697, 0.043102),
        products=(0.0, 0.000871, 0.0),
    ),
    Inertial(
        mass=5.289529,
        com=(0.0, -0.033795, 0.132404),
        diagonal=(0.042462, 0.042838, 0.01587),
        products=(0.0, 0.0, 0.006341),
    ),
    Inertial(
        mass=5.688888,
        com=(0.000136, 0.047548, 0.076322),
        diagonal=(0.055182, 0.053983, 0.016523),
        products=(-0.000033, 0.000056, 0.010034),
    ),
    Inertial(
        mass=3.461245,
        com=(0.0, 0.034913, 0.123108),
        diagonal=(0.02172, 0.02073, 0.007701),
        products=(0.0, 0.0, -0.003845),
    ),
    Inertial(
        mass=4.122995,
        com=(0.0, -0.039793, 0.086944),
        diagonal=(0.03241, 0.030758, 0.009883),
        products=(0.0, 0.0, -0.006022),
    ),
    Inertial(
        mass=1.563756,
        com=(0.0, -0.029824, 0.076267),
        diagonal=(0.008677, 0.007297, 0.003935),
        products=(0.0, 0.0, 0.002869),
    ),
    Inertial(
        mass=2.457878,
        com=(0.0, 0.07102, 0.00495),
        diagonal=(0.007227, 0.006958, 0.004734),
        products=(0.0, 0.0, 0.000318),
    ),
    Inertial(mass=0.265331, com=(0.0, 0.0, 0.013782), diagonal=(0.000175, 0.000175, 0.000306)),
)
"""Links 0 to 7 as in the `lbr_description` package: from CAD, scaled to the catalogue's 29.9 kg."""


@dataclass(frozen=True, kw_only=True)
class Primitive:
    """A collision shape in a link frame."""

    kind: Literal["box", "cylinder", "sphere"]
    """Boxes are centred; cylinders are centred and stand along `axis`."""
    center: Vector
    """Centre, in [m]."""
    size: Vector = (0.0, 0.0, 0.0)
    """Extents of a box, in [m]."""
    radius: float = 0.0
    """Radius of a cylinder or sphere, in [m]."""
    length: float = 0.0
    """Length of a cylinder, in [m]."""
    axis: Literal["y", "z"] = "z"
    """Direction of a cylinder."""


def _tube(z_low: float, z_high: float, radius: float, y: float = 0.0) -> Primitive:
    return Primitive(
        kind="cylinder", center=(0.0, y, (z_low + z_high) / 2), radius=radius, length=z_high - z_low
    )


def _drum(y_low: float, y_high: float, radius: float, z: float = 0.0) -> Primitive:
    return Primitive(
        kind="cylinder", center=(0.0, (y_low + y_high) / 2, z), radius=radius, length=y_high - y_low, axis="y"
    )


def _ball(y: float, z: float, radius: float) -> Primitive:
    return Primitive(kind="sphere", center=(0.0, y, z), radius=radius)


COLLISION_SHAPES: Final[dict[str, tuple[Primitive, ...]]] = {
    "link_0": (
        _tube(0.0, 0.018, 0.112),
        _tube(0.0, 0.1455, 0.099),
        Primitive(kind="box", center=(-0.110, 0.0, 0.0405), size=(0.120, 0.112, 0.075)),
    ),
    "link_1": (_tube(0.0, 0.120, 0.083), _ball(-0.045, 0.125, 0.088), _drum(-0.128, -0.010, 0.096, 0.2125)),
    "link_2": (_drum(0.0, 0.140, 0.096), _ball(0.055, 0.080, 0.088), _tube(0.100, 0.226, 0.077, y=0.010)),
    "link_3": (_tube(0.0, 0.100, 0.077), _ball(0.045, 0.115, 0.083), _drum(0.0105, 0.123, 0.090, 0.192)),
    "link_4": (
        _drum(-0.136, 0.0, 0.090),
        _ball(-0.050, 0.080, 0.081),
        _tube(0.090, 0.2055, 0.068, y=-0.0105),
    ),
    "link_5": (_tube(0.0, 0.074, 0.068), _ball(-0.062, 0.105, 0.064), _drum(-0.138, -0.0707, 0.068, 0.1925)),
    "link_6": (_drum(0.0, 0.138, 0.067), _ball(0.0707, 0.025, 0.066), _tube(0.030, 0.089, 0.051, y=0.0707)),
    "link_7": (_tube(0.0, 0.035, 0.050),),
    "link_ee": (
        _tube(0.0, 0.007, 0.034),
        Primitive(kind="box", center=(0.0, 0.0, 0.0145), size=(0.024, 0.068, 0.021)),
    ),
    d435.CAMERA_LINK_NAME: (Primitive(kind="box", center=d435.BODY_CENTER, size=d435.BODY_SIZE),),
}
"""Collision shapes of each link. Neighbours overlap, which no simulator checks; they hold the visible shells
to 17 mm."""


def _numbers(values: npt.ArrayLike) -> str:
    return " ".join(repr(float(v) + 0.0) for v in np.asarray(values, dtype=np.float64).ravel())


def _rpy(rotation: npt.NDArray[np.float64]) -> Vector:
    """Fixed-axis roll, pitch, yaw of a rotation matrix, yaw 0 where roll and yaw turn about the same axis."""
    pitch = math.atan2(-rotation[2, 0], math.hypot(rotation[0, 0], rotation[1, 0]))
    if abs(abs(pitch) - math.pi / 2) < 1e-9:
        return math.atan2(-rotation[1, 2], rotation[1, 1]), pitch, 0.0
    return math.atan2(rotation[2, 1], rotation[2, 2]), pitch, math.atan2(rotation[1, 0], rotation[0, 0])


def _origin(xyz: npt.ArrayLike, rpy: npt.ArrayLike = (0.0, 0.0, 0.0)) -> str:
    return f'<origin xyz="{_numbers(xyz)}" rpy="{_numbers(rpy)}"/>'


def _inertial(inertial: Inertial) -> list[str]:
    ixx, iyy, izz = inertial.diagonal
    ixy, ixz, iyz = inertial.products
    return [
        "    <inertial>",
        f"      {_origin(inertial.com)}",
        f'      <mass value="{inertial.mass!r}"/>',
        f'      <inertia ixx="{ixx!r}" ixy="{ixy!r}" ixz="{ixz!r}" iyy="{iyy!r}" iyz="{iyz!r}" '
        f'izz="{izz!r}"/>',
        "    </inertial>",
    ]


def _collision(shape: Primitive) -> list[str]:
    if shape.kind == "box":
        geometry = f'<box size="{_numbers(shape.size)}"/>'
    elif shape.kind == "cylinder":
        geometry = f'<cylinder radius="{shape.radius!r}" length="{shape.length!r}"/>'
    else:
        geometry = f'<sphere radius="{shape.radius!r}"/>'
    rpy = (math.pi / 2, 0.0, 0.0) if shape.axis == "y" else (0.0, 0.0, 0.0)
    return [
        "    <collision>",
        f"      {_origin(shape.center, rpy)}",
        f"      <geometry>{geometry}</geometry>",
        "    </collision>",
    ]


def _link(name: str, inertial: Inertial | None = None, mesh: str | None = None) -> list[str]:
    body: list[str] = []
    if inertial is not None:
        body += _inertial(inertial)
    if mesh is not None:
        body += [
            "    <visual>",
            f"      {_origin((0.0, 0.0, 0.0))}",
            f'      <geometry><mesh filename="{mesh}"/></geometry>',
            "    </visual>",
        ]
    for shape in COLLISION_SHAPES.get(name, ()):
        body += _collision(shape)
    if not body:
        return [f'  <link name="{name}"/>']
    return [f'  <link name="{name}">', *body, "  </link>"]


def _fixed_joint(parent: str, child: str, transform: npt.NDArray[np.float64]) -> list[str]:
    return [
        f'  <joint name="{child}_joint" type="fixed">',
        f'    <parent link="{parent}"/>',
        f'    <child link="{child}"/>',
        f"    {_origin(transform[:3, 3], _rpy(transform[:3, :3]))}",
        "  </joint>",
    ]


def _revolute_joint(index: int) -> list[str]:
    return [
        f'  <joint name="{iiwa14.JOINT_NAMES[index]}" type="revolute">',
        f'    <parent link="{iiwa14.LINK_NAMES[index]}"/>',
        f'    <child link="{iiwa14.LINK_NAMES[index + 1]}"/>',
        f"    {_origin(iiwa14.JOINT_ORIGINS[index])}",
        f'    <axis xyz="{_numbers(iiwa14.JOINT_AXES[index])}"/>',
        f'    <limit lower="{_numbers(iiwa14.JOINT_LOWER[index])}" '
        f'upper="{_numbers(iiwa14.JOINT_UPPER[index])}" '
        f'effort="{_numbers(iiwa14.TORQUE_LIMITS[index])}" '
        f'velocity="{_numbers(iiwa14.VELOCITY_LIMITS[index])}"/>',
        "  </joint>",
    ]


def _box_inertial(mass: float, center: Vector, size: Vector) -> Inertial:
    x, y, z = (mass / 12 * s**2 for s in size)
    return Inertial(mass=mass, com=center, diagonal=(y + z, x + z, x + y))


def _camera() -> list[str]:
    lines = _link(
        d435.CAMERA_LINK_NAME,
        _box_inertial(d435.BODY_MASS, d435.BODY_CENTER, d435.BODY_SIZE),
        f"meshes/{d435.CAMERA_LINK_NAME}.glb",
    )
    lines += _fixed_joint(iiwa14.EE_LINK_NAME, d435.CAMERA_LINK_NAME, d435.T_flange_camera)
    # RealSense's URDF roots the camera in its tripod thread; ours hangs on the flange, so that is a leaf.
    lines += _link("camera_bottom_screw_frame")
    lines += _fixed_joint(d435.CAMERA_LINK_NAME, "camera_bottom_screw_frame", d435.T_camera_screw)
    for name, transform in (
        ("depth", d435.T_camera_infra1),
        ("infra1", d435.T_camera_infra1),
        ("infra2", d435.T_camera_infra2),
        ("color", d435.T_camera_color),
    ):
        frame, optical = f"camera_{name}_frame", f"camera_{name}_optical_frame"
        lines += _link(frame)
        lines += _fixed_joint(d435.CAMERA_LINK_NAME, frame, transform)
        lines += _link(optical)
        lines += _fixed_joint(frame, optical, d435.T_frame_optical)
    return lines


def urdf_text() -> str:
    """The URDF; mesh files are named relative to it, in `meshes/`, one for each link that one sees."""
    lines = [
        '<?xml version="1.0"?>',
        "<!-- Written by tools/build_robot.py. -->",
        '<robot name="iiwa14_d435">',
        "  <mujoco>",
        '    <compiler fusestatic="false" discardvisual="true" strippath="false"/>',
        "  </mujoco>",
    ]
    for index, inertial in enumerate(LINK_INERTIALS):
        name = iiwa14.LINK_NAMES[index]
        lines += _link(name, inertial, f"meshes/{name}.glb")
    for index in range(iiwa14.NUM_JOINTS):
        lines += _revolute_joint(index)
    bracket = _box_inertial(BRACKET_MASS, (0.0, 0.0, 0.0125), (0.030, 0.060, 0.025))
    lines += _link(iiwa14.EE_LINK_NAME, bracket, f"meshes/{iiwa14.EE_LINK_NAME}.glb")
    ee = np.eye(4)
    ee[:3, 3] = iiwa14.EE_ORIGIN
    lines += _fixed_joint(iiwa14.LINK_NAMES[iiwa14.NUM_JOINTS], iiwa14.EE_LINK_NAME, ee)
    lines += _camera()
    lines.append("</robot>")
    return "\n".join(lines) + "\n"
