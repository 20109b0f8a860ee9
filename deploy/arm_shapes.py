"""An arm model's URDF in MuJoCo, with the camera's housing on its flange: for collisions and for the twin."""

import itertools
from collections.abc import Iterator
from typing import Any, Final

import mujoco
import numpy as np
import torch

from maniskill_tomato.deploy.interface import Float64
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.robot.arm_model import NUM_JOINTS, ArmModel
from maniskill_tomato.robot.d435 import CAMERA_LINK_NAME, camera_link_pose
from maniskill_tomato.robot.iiwa14 import IIWA14
from maniskill_tomato.robot.kinematics import link_transforms

mj: Any = mujoco

LARGEST_BARE: Final = 0.03
"""A corner of a collision shape may be this far outside the spheres of its link, in [m]; the iiwa 14's, whose cylinders
have corners that its links have not, are up to 0.023 outside."""

AGREES: Final = 1e-6
"""So well a model's kinematics and limits agree with its URDF, in [m] and [rad]; the iiwa 14's do to 1e-15."""

POSTURES: Final = 8
"""In so many both are looked at."""


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
    """Accepts a model whose URDF has the joints and links that it names, where its kinematics have them, with collision
    shapes that its spheres cover.

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
    for what in _disagreements(model, compiled):
        raise _refusal(model, what)
    # Without shapes a link would pass through everything.
    bare = [
        name
        for name in model.link_names[:-1]
        if not any(geom.contype or geom.conaffinity for geom in spec.body(name).geoms)
    ]
    if bare:
        raise _refusal(model, f"{model.urdf} has no collision shapes on {', '.join(bare)}")
    for link, spheres in model.spheres.items():
        rows = np.array(spheres)
        for geom in np.flatnonzero(compiled.geom_bodyid == compiled.body(link).id):
            away = np.linalg.norm(_corners(compiled, int(geom))[:, None] - rows[:, :3], axis=-1) - rows[:, 3]
            outside = float(away.min(axis=1).max())
            if outside > LARGEST_BARE:
                raise _refusal(
                    model,
                    f"the spheres of {link} leave a corner of its collision shapes {outside * 1e3:.0f} mm bare, "
                    f"allowed are {LARGEST_BARE * 1e3:.0f} mm",
                )


def _disagreements(model: ArmModel, compiled: Any) -> Iterator[str]:
    """Where numbers of the model are not those of its URDF: the kinematics, which tell where flange and camera are,
    and the collision checks would have different arms in mind."""
    low, high = compiled.jnt_range.T
    beyond = np.maximum(low - model.joint_lower, model.joint_upper - high)
    beyond[compiled.jnt_limited == 0] = 0.0
    if (beyond > AGREES).any():
        k = int(beyond.argmax())
        yield f"{model.joint_names[k]} may turn {beyond[k]:.3g} rad beyond its limits in {model.urdf}"
    data = mj.MjData(compiled)
    postures = np.random.default_rng(0).uniform(model.joint_lower, model.joint_upper, (POSTURES, NUM_JOINTS))
    poses = link_transforms(torch.from_numpy(postures), model).numpy()
    for joints, ours in zip(postures, poses, strict=True):
        data.qpos[:] = joints
        mj.mj_kinematics(compiled, data)
        for link, T in zip(model.link_names[1:], ours[1:], strict=True):
            body = compiled.body(link).id
            off = float(np.linalg.norm(T[:3, 3] - data.xpos[body]))
            turned = float(np.abs(T[:3, :3] - data.xmat[body].reshape(3, 3)).max())
            if off > AGREES or turned > AGREES:
                yield (
                    f"its kinematics have {link} {off * 1e3:.3g} mm from where {model.urdf} has it, and turned by "
                    f"{turned:.3g} in its rotation; make the model by read_arm_model"
                )


def _corners(compiled: Any, geom: int) -> Float64:
    """Points of a collision shape that nothing of it lies far beyond, in its link's frame, in [m]. Shape (N, 3)."""
    kind, size = int(compiled.geom_type[geom]), compiled.geom_size[geom]
    if kind == mj.mjtGeom.mjGEOM_MESH:
        mesh = int(compiled.geom_dataid[geom])
        first = int(compiled.mesh_vertadr[mesh])
        points = np.array(
            compiled.mesh_vert[first : first + int(compiled.mesh_vertnum[mesh])], dtype=np.float64
        )
    else:
        half = {
            mj.mjtGeom.mjGEOM_SPHERE: size[[0, 0, 0]],
            mj.mjtGeom.mjGEOM_CAPSULE: size[[0, 0, 1]] + [0.0, 0.0, size[0]],
            mj.mjtGeom.mjGEOM_CYLINDER: size[[0, 0, 1]],
        }.get(kind, size)
        points = np.array(list(itertools.product((-1.0, 0.0, 1.0), repeat=3)))
        length = np.linalg.norm(points[:, :2], axis=1)
        if kind in (mj.mjtGeom.mjGEOM_CYLINDER, mj.mjtGeom.mjGEOM_CAPSULE):
            points[length > 0.0, :2] /= length[length > 0.0, None]
        elif kind in (mj.mjtGeom.mjGEOM_SPHERE, mj.mjtGeom.mjGEOM_ELLIPSOID):
            points /= np.maximum(np.linalg.norm(points, axis=1, keepdims=True), 1.0)
        points = points * half
    rotation = np.zeros(9)
    mj.mju_quat2Mat(rotation, compiled.geom_quat[geom])
    placed: Float64 = points @ rotation.reshape(3, 3).T + compiled.geom_pos[geom]
    return placed


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
