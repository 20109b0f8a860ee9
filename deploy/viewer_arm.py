"""The arm as viewers of a recording show it: where every link is, and a URDF of simple shapes."""

from dataclasses import dataclass
from functools import cache
from xml.etree import ElementTree

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from maniskill_tomato.deploy.interface import Float64
from maniskill_tomato.robot.arm_model import ArmModel
from maniskill_tomato.robot.d435 import CAMERA_LINK_NAME, camera_link_pose
from maniskill_tomato.robot.iiwa14 import IIWA14
from maniskill_tomato.robot.kinematics import link_transforms


@dataclass(frozen=True, eq=False, kw_only=True)
class LinkFrame:
    """Where a link is in the link that carries it."""

    parent: str
    child: str
    T_parent_child: Float64
    """Shape (4, 4)."""


def link_frames(
    joint_positions: Float64, T_flange_camera: Float64, model: ArmModel = IIWA14
) -> tuple[LinkFrame, ...]:
    """Every link of the arm but the base, and the camera's, each in its parent.

    Args:
        joint_positions: In [rad]. Shape (7,).
        T_flange_camera: The colour camera's optical frame in `link_ee`, as calibrated. Shape (4, 4).
        model: Of the arm.
    """
    joints = torch.as_tensor(np.array(joint_positions, dtype=np.float64))[None]
    poses, names = link_transforms(joints, model)[0].numpy(), model.link_names
    arm = (
        LinkFrame(parent=parent, child=child, T_parent_child=np.linalg.inv(poses[k]) @ poses[k + 1])
        for k, (parent, child) in enumerate(zip(names, names[1:], strict=False))
    )
    housing = LinkFrame(
        parent=model.flange_link, child=CAMERA_LINK_NAME, T_parent_child=camera_link_pose(T_flange_camera)
    )
    return (*arm, housing, *_camera_frames())


@cache
def simple_urdf(model: ArmModel = IIWA14) -> str:
    """The URDF with the boxes, cylinders and spheres that stand for its meshes, so that it needs no other file."""
    root = _urdf(model)
    for link in root.iter("link"):
        for meshes in link.findall("visual"):
            link.remove(meshes)
        for shape in link.findall("collision"):
            shape.tag = "visual"
    return ElementTree.tostring(root, encoding="unicode")


def _urdf(model: ArmModel) -> ElementTree.Element:
    return ElementTree.parse(model.urdf).getroot()


@cache
def _camera_frames() -> tuple[LinkFrame, ...]:
    """What is fixed to the camera's housing."""
    frames = []
    for joint in _urdf(IIWA14).iter("joint"):
        parent, child = joint.find("parent"), joint.find("child")
        assert parent is not None and child is not None
        if child.attrib["link"] in (*IIWA14.link_names, CAMERA_LINK_NAME):
            continue
        origin = joint.find("origin")
        assert joint.attrib["type"] == "fixed" and origin is not None
        T = np.eye(4)
        T[:3, :3] = Rotation.from_euler("xyz", [float(v) for v in origin.attrib["rpy"].split()]).as_matrix()
        T[:3, 3] = [float(v) for v in origin.attrib["xyz"].split()]
        frames.append(LinkFrame(parent=parent.attrib["link"], child=child.attrib["link"], T_parent_child=T))
    return tuple(frames)
