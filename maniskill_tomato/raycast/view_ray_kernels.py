# mypy: ignore-errors
# pyright: reportArgumentType=false, reportAssignmentType=false, reportAttributeAccessIssue=false
# pyright: reportCallIssue=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOperatorIssue=false, reportReturnType=false
# Warp's stubs describe calls from outside, not what stands inside a kernel.
"""Warp kernels that say what each ray of a target-centred pattern meets."""

import warp as wp

from maniskill_tomato.raycast.kernels import (
    NEAR,
    SURFACE_GAP,
    Camera,
    Scene,
    View,
    rotation,
    segment_meets_box,
    translation,
)

wp.set_module_options({"enable_backward": False})

OUTSIDE = wp.constant(wp.int8(0))
FREE = wp.constant(wp.int8(1))
TARGET = wp.constant(wp.int8(2))
OTHER = wp.constant(wp.int8(3))

SMALLEST = wp.constant(1.0e-6)


@wp.struct
class Limits:
    """What the depth camera measures."""

    nearest: wp.float32
    """Smallest depth, in [m]."""
    farthest: wp.float32
    """Largest distance along a ray, in [m]."""


@wp.func
def look_axes(position: wp.vec3, target: wp.vec3) -> wp.mat33:
    """The axes right, up, forward as columns, as `robot.look_at.look_frame`."""
    ahead = target - position
    forward = wp.vec3(1.0, 0.0, 0.0)
    distance = wp.length(ahead)
    if distance > SMALLEST:
        forward = ahead / distance
    right = wp.vec3(0.0, -1.0, 0.0)
    level = wp.vec3(forward[1], -forward[0], 0.0)
    length = wp.length(level)
    if length > SMALLEST:
        right = level / length
    return wp.matrix_from_cols(right, wp.cross(right, forward), forward)


@wp.func
def stands_in_front(turn: wp.mat33, position: wp.vec3, low: wp.vec3, high: wp.vec3) -> bool:
    """Whether any corner of a box lies beyond the near plane of a camera, given its pose in the box's frame."""
    forward = wp.vec3(turn[0, 2], turn[1, 2], turn[2, 2])
    depth = -wp.dot(forward, position)
    for axis in range(3):
        depth += wp.max(forward[axis] * low[axis], forward[axis] * high[axis])
    return depth > NEAR


@wp.kernel
def prepare_rays(
    scene: Scene,
    view: View,
    camera_poses: wp.array[wp.mat44],
    plant_poses: wp.array[wp.mat44],
    link_poses: wp.array2d[wp.mat44],
):
    """Relative poses, and the links that reach in front of the camera, for one environment."""
    env = wp.tid()
    camera_rotation = rotation(camera_poses[env])
    camera_position = translation(camera_poses[env])
    to_plant = wp.transpose(rotation(plant_poses[env]))
    view.plant_rotations[env] = to_plant * camera_rotation
    view.plant_positions[env] = to_plant * (camera_position - translation(plant_poses[env]))
    mask = wp.int32(0)
    for link in range(scene.link_lows.shape[0]):
        pose = link_poses[env, scene.link_indices[link]]
        to_link = wp.transpose(rotation(pose))
        turn = to_link * camera_rotation
        position = to_link * (camera_position - translation(pose))
        view.link_rotations[env, link] = turn
        view.link_positions[env, link] = position
        if stands_in_front(turn, position, scene.link_lows[link], scene.link_highs[link]):
            mask = mask | (1 << link)
    view.links_in_the_way[env] = mask


@wp.func
def meets_link(scene: Scene, view: View, env: int, direction_c: wp.vec3, start: float, end: float) -> bool:
    remaining = view.links_in_the_way[env]
    link = wp.int32(0)
    while remaining != 0:
        if remaining & 1:
            direction = view.link_rotations[env, link] * direction_c
            position = view.link_positions[env, link]
            first = position + start * direction
            last = position + end * direction
            if segment_meets_box(first, last, scene.link_lows[link], scene.link_highs[link]):
                if wp.mesh_query_ray_anyhit(scene.link_meshes[link], first, direction, end - start):
                    return True
        remaining = remaining >> 1
        link += 1
    return False


@wp.kernel
def trace_view_rays(
    scene: Scene,
    view: View,
    camera: Camera,
    limits: Limits,
    pattern: wp.array[wp.vec2],
    camera_poses: wp.array[wp.mat44],
    target_positions: wp.array[wp.vec3],
    targets: wp.array[wp.int32],
    directions: wp.array2d[wp.vec3],
    distances: wp.array2d[wp.float32],
    labels: wp.array2d[wp.int8],
):
    """One ray of the pattern: its direction in the optical frame, what it meets and how far away."""
    env, ray = wp.tid()
    camera_position = translation(camera_poses[env])
    target_position = target_positions[env]
    axes = look_axes(camera_position, target_position)
    point = target_position + axes * wp.vec3(pattern[ray][0], pattern[ray][1], 0.0)
    direction_c = wp.transpose(rotation(camera_poses[env])) * wp.normalize(point - camera_position)
    directions[env, ray] = direction_c
    distances[env, ray] = 0.0
    labels[env, ray] = OUTSIDE
    depth = direction_c[2]
    if depth <= 0.0 or targets[env] < 0 or targets[env] >= scene.fruit_counts[env]:
        return
    x = direction_c[0] / depth
    y = direction_c[1] / depth
    if x < camera.left or x > camera.right or y < camera.top or y > camera.bottom:
        return

    direction = view.plant_rotations[env] * direction_c
    skipped = NEAR / depth
    start = view.plant_positions[env] + skipped * direction
    label = FREE
    distance = limits.farthest
    hit = wp.mesh_query_ray(scene.plant_meshes[env], start, direction, limits.farthest - skipped)
    if hit.result:
        label = OTHER
        distance = hit.t + skipped
        sphere = scene.fruit_spheres[env, targets[env]]
        offset = wp.vec3(sphere[0], sphere[1], sphere[2]) - start
        if wp.length(wp.cross(offset, direction)) <= sphere[3]:
            mesh = scene.fruit_meshes[env, targets[env]]
            if wp.mesh_query_ray_anyhit(mesh, start, direction, hit.t + SURFACE_GAP):
                label = TARGET
    if label != FREE and distance * depth < limits.nearest:
        return
    if meets_link(scene, view, env, direction_c, skipped, distance):
        return
    labels[env, ray] = label
    distances[env, ray] = distance
