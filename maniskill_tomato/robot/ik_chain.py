# mypy: ignore-errors
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false
# pyright: reportGeneralTypeIssues=false, reportIndexIssue=false, reportInvalidTypeForm=false
# pyright: reportOperatorIssue=false, reportReturnType=false
# The type checkers are silent here: Warp's stubs describe calls from outside, not the inside of a kernel.
"""An arm's chain inside Warp kernels: double-precision types, its lengths and limits, poses.

The kernels turn joints 1, 3, 5 and 7 about z, 2, 4 and 6 about y, joint 4 backwards (`CHAIN_SIGNS`).
"""

import math
from functools import cache
from typing import Any

import warp as wp

from maniskill_tomato.robot.arm_model import CHAIN_SIGNS, ArmModel

wp.set_module_options({"enable_backward": False})

vec7d = wp.types.vector(length=7, dtype=wp.float64)
mat73d = wp.types.matrix(shape=(7, 3), dtype=wp.float64)

AXIS_SIGNS = wp.constant(vec7d(*CHAIN_SIGNS))

ZERO = wp.constant(wp.float64(0.0))
HALF = wp.constant(wp.float64(0.5))
ONE = wp.constant(wp.float64(1.0))
TWO = wp.constant(wp.float64(2.0))
PI = wp.constant(wp.float64(math.pi))
TWO_PI = wp.constant(wp.float64(2.0 * math.pi))


@wp.struct
class Chain:
    origins: mat73d
    """Origin of each joint in the link before it, all links as the base stands when the joints are 0, in [m]."""
    axis_signs: vec7d
    """Which way each joint turns."""
    ee_height: wp.float64
    """From joint 7 to the flange, in [m]; likewise below."""
    limits: vec7d
    """Joints turn so far to either side, in [rad]."""
    shoulder_height: wp.float64
    upper_arm: wp.float64
    forearm: wp.float64
    hand: wp.float64
    smallest_reach: wp.float64
    """Distance of the wrist from the shoulder with the elbow at its limit, in [m]; for the iiwa 14 0.4104."""
    largest_reach: wp.float64
    """Distance of the wrist from the shoulder with the arm stretched, in [m]."""
    cos_limit_2: wp.float64
    cos_limit_6: wp.float64


@cache
def chain_of(model: ArmModel) -> Any:
    """The chain of a model, for launching kernels."""
    chain: Any = Chain()
    chain.origins = mat73d(*model.joint_origins.ravel())
    chain.axis_signs = vec7d(*model.axis_signs)
    chain.ee_height = model.flange_height
    chain.limits = vec7d(*model.symmetric_limits)
    upper, lower = model.shoulder_to_elbow, model.elbow_to_wrist
    chain.shoulder_height, chain.upper_arm, chain.forearm = model.base_to_shoulder, upper, lower
    chain.hand = model.wrist_to_flange
    cos_limit_4 = math.cos(model.symmetric_limits[3])
    chain.smallest_reach = math.sqrt(upper**2 + lower**2 + 2.0 * upper * lower * cos_limit_4)
    chain.largest_reach = upper + lower
    chain.cos_limit_2, chain.cos_limit_6 = (math.cos(model.symmetric_limits[j]) for j in (1, 5))
    return chain


@wp.func
def homogeneous(x: wp.vec3d, y: wp.vec3d, z: wp.vec3d, p: wp.vec3d) -> wp.mat44d:
    """The transform with these axes and this origin."""
    return wp.mat44d(
        x[0], y[0], z[0], p[0], x[1], y[1], z[1], p[1], x[2], y[2], z[2], p[2], ZERO, ZERO, ZERO, ONE
    )  # fmt: skip


@wp.func
def column(m: wp.mat33d, k: int) -> wp.vec3d:
    return wp.vec3d(m[0, k], m[1, k], m[2, k])


@wp.kernel
def link_transforms_kernel(qpos: wp.array2d[wp.float64], chain: Chain, transforms: wp.array2d[wp.mat44d]):
    i = wp.tid()
    x = wp.vec3d(ONE, ZERO, ZERO)
    y = wp.vec3d(ZERO, ONE, ZERO)
    z = wp.vec3d(ZERO, ZERO, ONE)
    p = wp.vec3d(ZERO, ZERO, ZERO)
    transforms[i, 0] = homogeneous(x, y, z, p)
    for j in range(7):
        p += chain.origins[j, 0] * x + chain.origins[j, 1] * y + chain.origins[j, 2] * z
        angle = chain.axis_signs[j] * qpos[i, j]
        c = wp.cos(angle)
        s = wp.sin(angle)
        if j % 2 == 1:
            turned = c * x - s * z
            z = s * x + c * z
            x = turned
        else:
            turned = c * x + s * y
            y = c * y - s * x
            x = turned
        transforms[i, j + 1] = homogeneous(x, y, z, p)
    p += chain.ee_height * z
    transforms[i, 8] = homogeneous(x, y, z, p)


@wp.kernel
def viewpoint_transform_kernel(viewpoints: wp.array2d[wp.float64], transforms: wp.array[wp.mat44d]):
    i = wp.tid()
    cr = wp.cos(viewpoints[i, 3])
    sr = wp.sin(viewpoints[i, 3])
    cp = wp.cos(viewpoints[i, 4])
    sp = wp.sin(viewpoints[i, 4])
    cy = wp.cos(viewpoints[i, 5])
    sy = wp.sin(viewpoints[i, 5])
    x = wp.vec3d(cy * cp, sy * cp, -sp)
    y = wp.vec3d(cy * sp * sr - sy * cr, sy * sp * sr + cy * cr, cp * sr)
    z = wp.vec3d(cy * sp * cr + sy * sr, sy * sp * cr - cy * sr, cp * cr)
    p = wp.vec3d(viewpoints[i, 0], viewpoints[i, 1], viewpoints[i, 2])
    transforms[i] = homogeneous(x, y, z, p)
