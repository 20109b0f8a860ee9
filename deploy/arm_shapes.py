"""An arm model's URDF in MuJoCo, with the camera's housing on its flange: for collisions and for the twin."""

from typing import Any

import mujoco
import numpy as np

from maniskill_tomato.deploy.interface import Float64
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.robot.arm_model import ArmModel
from maniskill_tomato.robot.d435 import CAMERA_LINK_NAME, camera_link_pose
from maniskill_tomato.robot.iiwa14 import IIWA14

mj: Any = mujoco


def arm_shapes(model: ArmModel, T_flange_camera: Float64) -> Any:
    """The arm with its collision shapes and the camera, as a `MjSpec` that is not compiled yet.

    Args:
        model: Of the arm.
        T_flange_camera: The camera's optical frame in the flange link, which its housing goes with. Shape (4, 4).

    Raises:
        InvalidInputError: MuJoCo cannot read the URDF, its joints are others, or a link has no collision shape.
    """
    spec = _read(model)
    pose = camera_link_pose(T_flange_camera)
    camera = spec.body(CAMERA_LINK_NAME) or _add_camera(spec, model)
    camera.pos = pose[:3, 3]
    mj.mju_mat2Quat(camera.quat, np.ascontiguousarray(pose[:3, :3]).ravel())
    return spec


def check_arm_shapes(model: ArmModel) -> None:
    """Accepts a model whose URDF has the joints and links that it names, and a collision shape on every link.

    Raises:
        InvalidInputError: It has not; with the reason.
    """
    spec = _read(model)
    try:
        compiled = spec.compile()
    except ValueError as error:
        raise _refusal(model, f"MuJoCo cannot use {model.urdf}: {error}") from error
    joints = tuple(compiled.joint(j).name for j in range(compiled.njnt))
    if joints != model.joint_names or compiled.nq != len(joints):
        raise _refusal(model, f"the joints of {model.urdf} are {', '.join(joints)}")
    # Without shapes a link would pass through everything.
    bare = [
        name
        for name in model.link_names[:-1]
        if not any(geom.contype or geom.conaffinity for geom in spec.body(name).geoms)
    ]
    if bare:
        raise _refusal(model, f"{model.urdf} has no collision shapes on {', '.join(bare)}")


def _read(model: ArmModel) -> Any:
    try:
        spec = mj.MjSpec.from_file(str(model.urdf))
    except ValueError as error:
        raise _refusal(model, f"MuJoCo cannot read {model.urdf}: {error}") from error
    spec.compiler.fusestatic = False
    missing = [name for name in model.link_names if spec.body(name) is None]
    if missing:
        raise _refusal(model, f"{model.urdf} has no link {', '.join(missing)}")
    return spec


def _add_camera(spec: Any, model: ArmModel) -> Any:
    """The camera's body with its shape and mass, from this package's URDF."""
    ours = mj.MjSpec.from_file(str(IIWA14.urdf)).body(CAMERA_LINK_NAME)
    body = spec.body(model.flange_link).add_body(
        name=CAMERA_LINK_NAME, mass=ours.mass, ipos=ours.ipos, fullinertia=ours.fullinertia
    )
    body.explicitinertial = True
    for geom in ours.geoms:
        body.add_geom(type=geom.type, size=geom.size, pos=geom.pos, quat=geom.quat)
    return body


def _refusal(model: ArmModel, what: str) -> InvalidInputError:
    return InvalidInputError(f"the arm model {model.name!r} cannot be served: {what}")
