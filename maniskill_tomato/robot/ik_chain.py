# mypy: ignore-errors
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false
# pyright: reportGeneralTypeIssues=false, reportIndexIssue=false, reportInvalidTypeForm=false
# pyright: reportOperatorIssue=false, reportReturnType=false
# The type checkers are silent here: Warp's stubs describe calls from outside, not the inside of a kernel.
"""The iiwa 14's chain inside Warp kernels: double-precision types, constants, poses."""

import math

import warp as wp

from maniskill_tomato.robot import iiwa14

wp.set_module_options({"enable_backward": False})

vec7d = wp.types.vector(length=7, dtype=wp.float64)
mat73d = wp.types.matrix(shape=(7, 3), dtype=wp.float64)

ORIGINS = wp.constant(mat73d(*iiwa14.JOINT_ORIGINS.ravel()))
AXIS_SIGNS = wp.constant(vec7d(*iiwa14.JOINT_AXES.sum(axis=1)))
"""Joints 1, 3, 5 and 7 turn about z, joints 2, 4 and 6 about y, joint 4 backwards."""
EE_HEIGHT = wp.constant(wp.float64(iiwa14.EE_ORIGIN[2]))

LIMITS = wp.constant(vec7d(*iiwa14.JOINT_UPPER))
"""The joint limits are symmetric about zero, in [rad]."""

SHOULDER_HEIGHT = wp.constant(wp.float64(iiwa14.BASE_TO_SHOULDER))
UPPER_ARM = wp.constant(wp.float64(iiwa14.SHOULDER_TO_ELBOW))
FOREARM = wp.constant(wp.float64(iiwa14.ELBOW_TO_WRIST))
HAND = wp.constant(wp.float64(iiwa14.WRIST_TO_EE))

ZERO = wp.constant(wp.float64(0.0))
HALF = wp.constant(wp.float64(0.5))
ONE = wp.constant(wp.float64(1.0))
TWO = wp.constant(wp.float64(2.0))
PI = wp.constant(wp.float64(math.pi))
TWO_PI = wp.constant(wp.float64(2.0 * math.pi))


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
def link_transforms_kernel(qpos: wp.array2d[wp.float64], transforms: wp.array2d[wp.mat44d]):
    i = wp.tid()
    x = wp.vec3d(ONE, ZERO, ZERO)
    y = wp.vec3d(ZERO, ONE, ZERO)
    z = wp.vec3d(ZERO, ZERO, ONE)
    p = wp.vec3d(ZERO, ZERO, ZERO)
    transforms[i, 0] = homogeneous(x, y, z, p)
    for j in range(7):
        p += ORIGINS[j, 0] * x + ORIGINS[j, 1] * y + ORIGINS[j, 2] * z
        angle = AXIS_SIGNS[j] * qpos[i, j]
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
    p += EE_HEIGHT * z
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
