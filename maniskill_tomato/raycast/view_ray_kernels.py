# mypy: ignore-errors
# pyright: reportArgumentType=false, reportAssignmentType=false, reportAttributeAccessIssue=false
# pyright: reportCallIssue=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOperatorIssue=false, reportReturnType=false
# Warp's stubs describe calls from outside, not what stands inside a kernel.
"""Warp kernel that says what each ray of a target-centred pattern meets."""

import warp as wp

from maniskill_tomato.raycast.kernels import (
    LINK,
    NEAR,
    NOTHING,
    FieldOfView,
    Scene,
    Views,
    first_hit,
    has_target,
    is_target,
    rotation,
    translation,
)
from maniskill_tomato.raycast.view_rays import PATTERN_HALF_WIDTH

wp.set_module_options({"enable_backward": False})

OUTSIDE = wp.constant(wp.int8(0))
FREE = wp.constant(wp.int8(1))
TARGET = wp.constant(wp.int8(2))
OTHER = wp.constant(wp.int8(3))

SMALLEST = wp.constant(1.0e-6)
PATTERN_REACH = wp.constant(2.0**0.5 * PATTERN_HALF_WIDTH)
"""How far from the target the pattern's rays cross its plane at most, in [m]."""
MARGIN = wp.constant(1.0e-4)
"""Room for rounding, in [m]."""


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


@wp.kernel
def narrow_links(scene: Scene, views: Views, target_positions: wp.array[wp.vec3]):
    """Leaves of the links in front of a camera those that a ray of the pattern can meet: the balls round their boxes
    reach into the cone round the pattern."""
    view = wp.tid()
    if views.asked[view] == 0:
        return
    camera_pose = views.camera_poses[view]
    ahead_c = wp.transpose(rotation(camera_pose)) * (target_positions[view] - translation(camera_pose))
    distance = wp.length(ahead_c)
    slant = wp.sqrt(distance * distance + PATTERN_REACH * PATTERN_REACH)
    remaining = views.links_in_front[view]
    for link in range(scene.link_lows.shape[0]):
        low = scene.link_lows[link]
        high = scene.link_highs[link]
        middle = 0.5 * (low + high) - views.link_positions[view, link]
        along = wp.dot(middle, views.link_rotations[view, link] * ahead_c) / wp.max(distance, SMALLEST)
        aside = wp.sqrt(wp.max(wp.dot(middle, middle) - along * along, 0.0))
        if aside * distance - along * PATTERN_REACH > (0.5 * wp.length(high - low) + MARGIN) * slant:
            remaining = remaining & ~(1 << link)
    views.links_in_front[view] = remaining


@wp.kernel
def trace_view_rays(
    scene: Scene,
    views: Views,
    camera: FieldOfView,
    limits: Limits,
    pattern: wp.array[wp.vec2],
    target_positions: wp.array[wp.vec3],
    directions: wp.array2d[wp.vec3],
    distances: wp.array2d[wp.float32],
    labels: wp.array2d[wp.int8],
):
    """One ray of the pattern: its direction in the optical frame, what it meets and how far away."""
    view, ray = wp.tid()
    if views.asked[view] == 0:
        return
    camera_pose = views.camera_poses[view]
    camera_position = translation(camera_pose)
    target_position = target_positions[view]
    axes = look_axes(camera_position, target_position)
    point = target_position + axes * wp.vec3(pattern[ray][0], pattern[ray][1], 0.0)
    direction_c = wp.transpose(rotation(camera_pose)) * wp.normalize(point - camera_position)
    directions[view, ray] = direction_c
    distances[view, ray] = 0.0
    labels[view, ray] = OUTSIDE
    depth = direction_c[2]
    if depth <= 0.0 or not has_target(scene, views, view):
        return
    x = direction_c[0] / depth
    y = direction_c[1] / depth
    if x < camera.left or x > camera.right or y < camera.top or y > camera.bottom:
        return

    start = NEAR / depth
    hit = first_hit(scene, views, view, direction_c, start, limits.farthest)
    label = FREE
    if hit.kind != NOTHING:
        if hit.kind == LINK or hit.distance * depth < limits.nearest:
            return
        label = OTHER
        if is_target(scene, views, view, direction_c, start, hit.distance):
            label = TARGET
    labels[view, ray] = label
    distances[view, ray] = hit.distance
