# mypy: ignore-errors
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false
# pyright: reportGeneralTypeIssues=false, reportIndexIssue=false, reportInvalidTypeForm=false
# pyright: reportOperatorIssue=false, reportReturnType=false
# Warp's stubs describe calls from outside, not what stands inside a kernel.
"""Warp kernel of the commonest look-at move: in full, with the picture upright. `look_at_move` says what it means."""

import warp as wp

from maniskill_tomato.robot.ik_chain import ONE, ZERO, homogeneous

wp.set_module_options({"enable_backward": False})

SMALLEST = wp.constant(wp.float64(1.0e-6))


@wp.func
def right_of(forward: wp.vec3d) -> wp.vec3d:
    """The level axis to the right of a camera; -y where it looks straight up or down."""
    level = wp.vec3d(forward[1], -forward[0], ZERO)
    length = wp.length(level)
    if length > SMALLEST:
        return level / length
    return wp.vec3d(ZERO, -ONE, ZERO)


@wp.kernel
def upright_move(
    positions: wp.array[wp.vec3d],
    targets: wp.array[wp.vec3d],
    actions: wp.array[wp.vec3d],
    max_move: wp.float64,
    min_distance: wp.float64,
    T_camera_flange: wp.mat44d,
    camera_poses: wp.array[wp.mat44d],
    flange_poses: wp.array[wp.mat44d],
):
    i = wp.tid()
    target = targets[i]
    ahead = target - positions[i]
    forward = wp.vec3d(ONE, ZERO, ZERO)
    if wp.length(ahead) > SMALLEST:
        forward = wp.normalize(ahead)
    right = right_of(forward)
    up = wp.cross(right, forward)
    action = actions[i] * (max_move / wp.max(wp.length(actions[i]), ONE))
    away = positions[i] + action[0] * right + action[1] * up + action[2] * forward - target
    distance = wp.length(away)
    outward = -forward
    if distance > SMALLEST:
        outward = away / distance
    position = target + wp.max(distance, min_distance) * outward
    forward = -outward
    right = right_of(forward)
    camera = homogeneous(right, wp.cross(forward, right), forward, position)
    camera_poses[i] = camera
    flange_poses[i] = camera * T_camera_flange
