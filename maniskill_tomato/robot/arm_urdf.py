"""Arm models from URDFs: geometry, limits and names are the file's; what it cannot say is given."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Final
from xml.etree import ElementTree

import numpy as np
from scipy.spatial.transform import Rotation

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.robot.arm_model import CENTRE_TOLERANCE, NUM_JOINTS, ArmModel, Float64, Sphere

MOVING: Final = ("revolute", "continuous", "prismatic", "planar", "floating")

LARGEST_URDF_BYTES: Final = 5_000_000

DIGITS: Final = 9
"""Lengths are rounded to nanometres, so that sums of the file's decimals are those decimals' sums."""


def read_arm_model(
    urdf: Path,
    *,
    name: str,
    flange_link: str,
    acceleration_limits: Float64 | tuple[float, ...],
    spheres: Mapping[str, tuple[Sphere, ...]],
    ready_qpos: Float64 | tuple[float, ...],
) -> ArmModel:
    """The model of the arm that a URDF describes.

    Args:
        urdf: Its joints need limits with `lower`, `upper`, `velocity` and `effort`.
        name: By which profiles and recordings name it.
        flange_link: The link that carries the camera, z out of the flange, fixed to what the last joint turns.
        acceleration_limits: Largest joint accelerations, in [rad/s^2]. Shape (7,).
        spheres: Spheres that cover the last links, as for `ArmModel`.
        ready_qpos: A posture in front of the plant, in [rad]. Shape (7,).

    Raises:
        InvalidInputError: The file cannot be read, or the arm cannot be served; with the reason.
    """
    where = f"the arm model {name!r} cannot be served: {urdf}"
    joints = _chain(_root(urdf, where), flange_link, where)
    moving = [joint for joint in joints if joint.attrib["type"] in MOVING]
    for joint in moving:
        if joint.attrib["type"] not in ("revolute", "continuous"):
            raise InvalidInputError(
                f"{where}: {joint.attrib['name']} is {joint.attrib['type']}; only joints that turn are served"
            )
    if len(moving) != NUM_JOINTS:
        raise InvalidInputError(
            f"{where}: {len(moving)} joints turn between the base and {flange_link}; it must be {NUM_JOINTS}"
        )
    if moving[0] is not joints[0]:
        raise InvalidInputError(
            f"{where}: {joints[0].attrib['name']} is fixed; the base must be the URDF's first link"
        )
    T, origins, axes, turns = np.eye(4), [], [], [np.eye(3)]
    for joint in joints:
        T = T @ _origin(joint, where)
        if joint in moving:
            axis = T[:3, :3] @ _numbers(joint.find("axis"), "xyz", (1.0, 0.0, 0.0), where)
            origins.append(T[:3, 3].copy())
            axes.append(axis / max(float(np.linalg.norm(axis)), 1e-12))
            turns.append(T[:3, :3].copy())
    turns.append(T[:3, :3])
    to_flange = T[:3, 3] - origins[-1]
    off = float(np.linalg.norm(np.cross(axes[-1], to_flange)))
    if off > CENTRE_TOLERANCE:
        raise InvalidInputError(
            f"{where}: {flange_link} must lie on the axis of the last joint, it is {off * 1e3:.3f} mm off"
        )
    limits = {
        key: np.array([_limit(joint, key, where) for joint in moving])
        for key in ("lower", "upper", "velocity", "effort")
    }
    links = [joints[0].find("parent"), *(joint.find("child") for joint in moving)]
    return ArmModel(
        name=name,
        urdf=Path(urdf),
        joint_names=tuple(joint.attrib["name"] for joint in moving),
        link_names=(*(link.attrib["link"] for link in links if link is not None), flange_link),
        joint_lower=limits["lower"],
        joint_upper=limits["upper"],
        velocity_limits=limits["velocity"],
        acceleration_limits=np.array(acceleration_limits, dtype=np.float64),
        torque_limits=limits["effort"],
        joint_origins=np.diff(np.stack([np.zeros(3), *origins]), axis=0).round(DIGITS),
        joint_axes=np.stack(axes).round(DIGITS),
        flange_height=round(float(to_flange[2]), DIGITS),
        link_turns=None if all(np.allclose(R, np.eye(3), atol=1e-12) for R in turns) else np.stack(turns),
        spheres=spheres,
        ready_qpos=np.array(ready_qpos, dtype=np.float64),
    )


def _root(urdf: Path, where: str) -> ElementTree.Element:
    try:
        if urdf.stat().st_size > LARGEST_URDF_BYTES:
            raise InvalidInputError(f"{where} is larger than {LARGEST_URDF_BYTES} bytes")
        root = ElementTree.parse(urdf).getroot()
    except (OSError, ElementTree.ParseError, ValueError) as error:
        raise InvalidInputError(f"{where} cannot be read: {error}") from error
    if root.tag != "robot":
        raise InvalidInputError(f"{where} is no URDF: it begins with <{root.tag}>, not <robot>")
    return root


def _chain(root: ElementTree.Element, flange_link: str, where: str) -> list[ElementTree.Element]:
    """The joints from the base to the flange."""
    by_child: dict[str, tuple[str, ElementTree.Element]] = {}
    for joint in root.findall("joint"):
        parent, child = joint.find("parent"), joint.find("child")
        if parent is None or child is None or not {"name", "type"} <= joint.attrib.keys():
            raise InvalidInputError(f"{where}: a joint has no name, type, parent or child")
        by_child[child.attrib.get("link", "")] = (parent.attrib.get("link", ""), joint)
    chain: list[ElementTree.Element] = []
    link = flange_link
    while link in by_child and len(chain) <= len(by_child):
        link, joint = by_child[link]
        chain.append(joint)
    if not chain:
        raise InvalidInputError(
            f"{where}: no joint leads to a link {flange_link!r}, which shall be the flange"
        )
    extra = [
        joint.attrib["name"]
        for _, joint in by_child.values()
        if joint.attrib["type"] in MOVING and joint not in chain
    ]
    if extra:
        raise InvalidInputError(
            f"{where}: {', '.join(extra)} can move and lies not between the base and {flange_link}; make it fixed"
        )
    return chain[::-1]


def _origin(joint: ElementTree.Element, where: str) -> Float64:
    origin = joint.find("origin")
    T = np.eye(4)
    T[:3, 3] = _numbers(origin, "xyz", (0.0, 0.0, 0.0), where)
    rpy = _numbers(origin, "rpy", (0.0, 0.0, 0.0), where)
    T[:3, :3] = Rotation.from_euler("xyz", rpy).as_matrix()
    return T


def _numbers(
    element: ElementTree.Element | None, key: str, default: tuple[float, float, float], where: str
) -> Float64:
    text = None if element is None else element.attrib.get(key)
    if text is None:
        return np.array(default)
    try:
        values = np.array([float(v) for v in text.split()])
    except ValueError:
        values = np.zeros(0)
    if values.shape != (3,) or not np.isfinite(values).all():
        raise InvalidInputError(f"{where}: {key} must be three finite numbers, got {text!r}")
    return values


def _limit(joint: ElementTree.Element, key: str, where: str) -> float:
    limit = joint.find("limit")
    text = None if limit is None else limit.attrib.get(key)
    try:
        value = math.nan if text is None else float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InvalidInputError(
            f"{where}: {joint.attrib['name']} must have a limit with a finite {key}, got {text!r}"
        )
    return value
