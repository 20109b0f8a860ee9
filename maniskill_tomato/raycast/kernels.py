# mypy: ignore-errors
# pyright: reportArgumentType=false, reportAssignmentType=false, reportAttributeAccessIssue=false
# pyright: reportCallIssue=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOperatorIssue=false, reportReturnType=false
# Warp's stubs describe calls from outside, not what stands inside a kernel.
"""What a ray meets: the Warp structs of a scene and its views, and the functions that all ray-casting kernels share.

A ray leaves a camera along a direction given in the optical frame: z forward, x right, y down. Its parameter counts
lengths of that direction, so it is a distance for a unit direction and a depth for one with a unit z component, both in
[m]. Where the ray meets something is worked out in the frame of the plant or the link.
"""

import warp as wp

from maniskill_tomato.raycast.mesh_rays import Tracer, any_hit, closest_hit
from maniskill_tomato.robot.d435 import CAMERA_NEAR

wp.set_module_options({"enable_backward": False})

NEAR = wp.constant(CAMERA_NEAR)
"""Depth in [m] from which on something is seen, as in the rendered images."""
SURFACE_GAP = wp.constant(2.0e-5)
"""What lies less than this in front of a fruit's surface, in [m], is taken for the fruit itself."""
TANGENT_LIMIT = wp.constant(4.0)
"""Silhouettes are cut at this tangent (76 degrees) off the optical axis, far outside any image."""

NOTHING = wp.constant(0)
PLANT = wp.constant(1)
LINK = wp.constant(2)


@wp.struct
class Scene:
    """The plants of N environments with at most F fruits, and the L links that have a mesh."""

    tracer: Tracer
    """What traces rays through the meshes."""
    plant_meshes: wp.array[wp.uint64]
    """All triangles of each plant. Shape (N,)."""
    fruit_counts: wp.array[wp.int32]
    """Number of fruits of each plant. Shape (N,)."""
    fruit_meshes: wp.array2d[wp.uint64]
    """Each fruit on its own. Shape (N, F)."""
    fruit_spheres: wp.array2d[wp.vec4]
    """Centre in the plant frame and radius, in [m]. Shape (N, F)."""
    fruit_is_ripe: wp.array2d[wp.int32]
    """Also 0 where a plant has fewer fruits. Shape (N, F)."""
    link_meshes: wp.array[wp.uint64]
    """Shape (L,)."""
    link_indices: wp.array[wp.int32]
    """Which of the given link poses belongs to the mesh. Shape (L,)."""
    link_lows: wp.array[wp.vec3]
    """Lower corner of the mesh in the link frame, in [m]. Shape (L,)."""
    link_highs: wp.array[wp.vec3]
    """Upper corner of the mesh in the link frame, in [m]. Shape (L,)."""


@wp.struct
class Views:
    """B views: what is asked, and below what `prepare` works out from it."""

    environments: wp.array[wp.int32]
    """Which environment's plant is looked at. Shape (B,)."""
    targets: wp.array[wp.int32]
    """Index of the target among its fruits. Shape (B,)."""
    camera_poses: wp.array[wp.mat44]
    """Optical frame to world. Shape (B,)."""
    plant_poses: wp.array[wp.mat44]
    """Plant frame to world. Shape (B,)."""
    link_poses: wp.array2d[wp.mat44]
    """Link frames to world. Shape (B, 9)."""
    asked: wp.array[wp.int32]
    """0 for views that nobody asks about, of which nothing is worked out. Shape (B,)."""

    plant_rotations: wp.array[wp.mat33]
    """Optical frame to plant frame. Shape (B,)."""
    plant_positions: wp.array[wp.vec3]
    """Camera in the plant frame, in [m]. Shape (B,)."""
    link_rotations: wp.array2d[wp.mat33]
    """Optical frame to link frame. Shape (B, L)."""
    link_positions: wp.array2d[wp.vec3]
    """Camera in the link frame, in [m]. Shape (B, L)."""
    links_in_front: wp.array[wp.int32]
    """Bit k is set if mesh k reaches beyond the near plane. Shape (B,)."""
    links_before_target: wp.array[wp.int32]
    """Bit k is set if mesh k can hide the target. Shape (B,)."""
    rectangles: wp.array[wp.vec4]
    """Left, top, right, bottom of the target in tangents; empty without a silhouette. Shape (B,)."""


@wp.struct
class FieldOfView:
    """An undistorted pinhole camera by what its image covers, in tangents (x / z, y / z)."""

    left: wp.float32
    top: wp.float32
    right: wp.float32
    bottom: wp.float32
    square_pixels: wp.float32
    """Pixels on a unit square of the image plane at depth 1."""


@wp.struct
class Hit:
    """The first thing on a ray."""

    kind: wp.int32
    """NOTHING, PLANT or LINK."""
    distance: wp.float32
    """Parameter of the ray there; where the search ended if there is nothing."""
    face: wp.int32
    """Which triangle of the plant."""
    facing: wp.float32
    """Cosine of the angle between ray and surface, 1 where one looks straight at it."""


@wp.func
def rotation(m: wp.mat44) -> wp.mat33:
    return wp.mat33(m[0, 0], m[0, 1], m[0, 2], m[1, 0], m[1, 1], m[1, 2], m[2, 0], m[2, 1], m[2, 2])


@wp.func
def translation(m: wp.mat44) -> wp.vec3:
    return wp.vec3(m[0, 3], m[1, 3], m[2, 3])


@wp.func
def segment_meets_box(start: wp.vec3, end: wp.vec3, low: wp.vec3, high: wp.vec3) -> bool:
    enter = wp.float32(0.0)
    leave = wp.float32(1.0)
    for axis in range(3):
        step = end[axis] - start[axis]
        if wp.abs(step) < 1.0e-9:
            if start[axis] < low[axis] or start[axis] > high[axis]:
                return False
        else:
            a = (low[axis] - start[axis]) / step
            b = (high[axis] - start[axis]) / step
            enter = wp.max(enter, wp.min(a, b))
            leave = wp.min(leave, wp.max(a, b))
    return enter <= leave


@wp.func
def stands_in_front(turn: wp.mat33, position: wp.vec3, low: wp.vec3, high: wp.vec3) -> bool:
    """Whether any corner of a box lies beyond the near plane of a camera, given its pose in the box's frame."""
    forward = wp.vec3(turn[0, 2], turn[1, 2], turn[2, 2])
    depth = -wp.dot(forward, position)
    for axis in range(3):
        depth += wp.max(forward[axis] * low[axis], forward[axis] * high[axis])
    return depth > NEAR


@wp.func
def has_target(scene: Scene, views: Views, view: int) -> bool:
    target = views.targets[view]
    return target >= 0 and target < scene.fruit_counts[views.environments[view]]


@wp.func
def fruit_centre(sphere: wp.vec4, views: Views, view: int) -> wp.vec3:
    """Centre of a fruit in the optical frame, in [m]."""
    offset = wp.vec3(sphere[0], sphere[1], sphere[2]) - views.plant_positions[view]
    return wp.transpose(views.plant_rotations[view]) * offset


@wp.func
def tangent_bounds(across: float, depth: float, radius: float) -> wp.vec2:
    """The tangents between which a circle projects; (0, 0) when all of it lies beyond the limit or behind."""
    distance = wp.sqrt(across * across + depth * depth)
    # Inside the circle of this section the silhouette is open on both sides.
    low = -TANGENT_LIMIT
    high = TANGENT_LIMIT
    if distance > radius:
        middle = wp.atan2(across, depth)
        half = wp.asin(radius / distance)
        limit = wp.atan(TANGENT_LIMIT)
        low_angle = wp.clamp(middle - half, -limit, limit)
        high_angle = wp.clamp(middle + half, -limit, limit)
        if low_angle < high_angle:
            low = wp.tan(low_angle)
            high = wp.tan(high_angle)
        else:
            low = 0.0
            high = 0.0
    return wp.vec2(low, high)


@wp.func
def bounding_rectangle(centre: wp.vec3, radius: float) -> wp.vec4:
    """The rectangle (left, top, right, bottom) of tangents around a sphere; empty without a silhouette."""
    if wp.length(centre) <= radius or centre[2] + radius <= NEAR:
        return wp.vec4(0.0, 0.0, 0.0, 0.0)
    x = tangent_bounds(centre[0], centre[2], radius)
    y = tangent_bounds(centre[1], centre[2], radius)
    return wp.vec4(x[0], y[0], x[1], y[1])


@wp.func
def links_between(scene: Scene, views: Views, view: int, centre: wp.vec3, radius: float) -> int:
    """The links that a sphere, given in the optical frame, can be hidden by: one bit each."""
    mask = wp.int32(0)
    margin = wp.vec3(radius, radius, radius)
    for link in range(scene.link_lows.shape[0]):
        start = views.link_positions[view, link]
        end = start + views.link_rotations[view, link] * centre
        if segment_meets_box(start, end, scene.link_lows[link] - margin, scene.link_highs[link] + margin):
            mask = mask | (1 << link)
    return mask


@wp.kernel
def prepare(scene: Scene, views: Views):
    """Relative poses, the links to be considered and the target's rectangle of one view."""
    view = wp.tid()
    if views.asked[view] == 0:
        return
    camera = rotation(views.camera_poses[view])
    position = translation(views.camera_poses[view])
    plant_pose = views.plant_poses[view]
    to_plant = wp.transpose(rotation(plant_pose))
    views.plant_rotations[view] = to_plant * camera
    views.plant_positions[view] = to_plant * (position - translation(plant_pose))
    in_front = wp.int32(0)
    for link in range(scene.link_lows.shape[0]):
        pose = views.link_poses[view, scene.link_indices[link]]
        to_link = wp.transpose(rotation(pose))
        turn = to_link * camera
        place = to_link * (position - translation(pose))
        views.link_rotations[view, link] = turn
        views.link_positions[view, link] = place
        if stands_in_front(turn, place, scene.link_lows[link], scene.link_highs[link]):
            in_front = in_front | (1 << link)
    views.links_in_front[view] = in_front
    views.links_before_target[view] = 0
    views.rectangles[view] = wp.vec4(0.0, 0.0, 0.0, 0.0)
    if has_target(scene, views, view):
        sphere = scene.fruit_spheres[views.environments[view], views.targets[view]]
        centre = fruit_centre(sphere, views, view)
        views.links_before_target[view] = links_between(scene, views, view, centre, sphere[3])
        views.rectangles[view] = bounding_rectangle(centre, sphere[3])


@wp.func
def first_hit(
    scene: Scene, views: Views, view: int, direction_c: wp.vec3, start: float, farthest: float
) -> Hit:
    """What a ray meets first, plant or robot, between two values of its parameter."""
    hit = Hit()
    hit.kind = NOTHING
    hit.distance = farthest
    direction = views.plant_rotations[view] * direction_c
    origin = views.plant_positions[view] + start * direction
    mesh = scene.plant_meshes[views.environments[view]]
    met = closest_hit(scene.tracer, mesh, origin, direction, farthest - start)
    if met.found:
        hit.kind = PLANT
        hit.distance = met.distance + start
        hit.face = met.face
        hit.facing = wp.abs(wp.dot(wp.normalize(met.normal), wp.normalize(direction)))
    remaining = views.links_in_front[view]
    link = wp.int32(0)
    while remaining != 0:
        if remaining & 1:
            ray = views.link_rotations[view, link] * direction_c
            first = views.link_positions[view, link] + start * ray
            last = views.link_positions[view, link] + hit.distance * ray
            if segment_meets_box(first, last, scene.link_lows[link], scene.link_highs[link]):
                length = hit.distance - start
                touched = closest_hit(scene.tracer, scene.link_meshes[link], first, ray, length)
                if touched.found:
                    hit.kind = LINK
                    hit.distance = touched.distance + start
                    hit.facing = wp.abs(wp.dot(wp.normalize(touched.normal), wp.normalize(ray)))
        remaining = remaining >> 1
        link += 1
    return hit


@wp.func
def is_hidden(
    scene: Scene, views: Views, view: int, links: int, direction_c: wp.vec3, start: float, length: float
) -> bool:
    """Whether anything stands on a piece of a ray: the plant, or one of the links of a mask."""
    remaining = links
    link = wp.int32(0)
    while remaining != 0:
        if remaining & 1:
            ray = views.link_rotations[view, link] * direction_c
            first = views.link_positions[view, link] + start * ray
            if any_hit(scene.tracer, scene.link_meshes[link], first, ray, length):
                return True
        remaining = remaining >> 1
        link += 1
    direction = views.plant_rotations[view] * direction_c
    origin = views.plant_positions[view] + start * direction
    mesh = scene.plant_meshes[views.environments[view]]
    return any_hit(scene.tracer, mesh, origin, direction, length)


@wp.func
def fruit_distance(
    scene: Scene, views: Views, view: int, fruit: int, direction_c: wp.vec3, start: float, farthest: float
) -> float:
    """Parameter at which a ray enters a fruit, whatever stands before it; negative if it passes the fruit by."""
    direction = views.plant_rotations[view] * direction_c
    origin = views.plant_positions[view] + start * direction
    mesh = scene.fruit_meshes[views.environments[view], fruit]
    met = closest_hit(scene.tracer, mesh, origin, direction, farthest)
    if met.found:
        return met.distance + start
    return -1.0


@wp.func
def is_target(
    scene: Scene, views: Views, view: int, direction_c: wp.vec3, start: float, distance: float
) -> bool:
    """Whether what a ray meets at a value of its parameter is the target."""
    if not has_target(scene, views, view):
        return False
    env = views.environments[view]
    sphere = scene.fruit_spheres[env, views.targets[view]]
    direction = views.plant_rotations[view] * direction_c
    origin = views.plant_positions[view] + start * direction
    offset = wp.vec3(sphere[0], sphere[1], sphere[2]) - origin
    if wp.length(wp.cross(offset, wp.normalize(direction))) > sphere[3]:
        return False
    mesh = scene.fruit_meshes[env, views.targets[view]]
    return any_hit(scene.tracer, mesh, origin, direction, distance - start + SURFACE_GAP)
