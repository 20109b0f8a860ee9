# mypy: ignore-errors
# pyright: reportArgumentType=false, reportAssignmentType=false, reportAttributeAccessIssue=false
# pyright: reportCallIssue=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOperatorIssue=false, reportReturnType=false
# Warp's stubs describe calls from outside, not what stands inside a kernel.
"""Warp kernels that count which part of a fruit's silhouette a camera sees.

Rays live in the plant frame and have a unit component along the optical axis, so a ray parameter is a depth
in metres. A point of the image plane is named by its tangents (x / z, y / z) in the optical frame: z forward,
x right, y down.
"""

import warp as wp

from maniskill_tomato.robot.d435 import CAMERA_NEAR

wp.set_module_options({"enable_backward": False})

NEAR = wp.constant(CAMERA_NEAR)
"""Depth in [m] from which on something is seen, as in the rendered images."""
FAR = wp.constant(100.0)
"""Depth in [m] beyond which a target is not looked for."""
SURFACE_GAP = wp.constant(2.0e-5)
"""What lies less than this in front of the target's surface, in [m], is taken for the target itself."""
TANGENT_LIMIT = wp.constant(4.0)
"""Silhouettes are cut at this tangent (76 degrees) off the optical axis, far outside any image."""

HIDDEN_BY_EDGE = wp.constant(0)
HIDDEN_BY_PLANT = wp.constant(1)
HIDDEN_BY_FRUIT = wp.constant(2)
HIDDEN_BY_ROBOT = wp.constant(3)
VISIBLE = wp.constant(4)
OUTCOMES = wp.constant(5)

RESULTS = 8
"""Rows of the results: visible fraction, visible and total pixels, any fruit seen, four hidden fractions."""


@wp.struct
class Camera:
    """An undistorted pinhole camera by what its image covers."""

    left: wp.float32
    top: wp.float32
    right: wp.float32
    bottom: wp.float32
    square_pixels: wp.float32


@wp.func
def rotation(m: wp.mat44) -> wp.mat33:
    return wp.mat33(m[0, 0], m[0, 1], m[0, 2], m[1, 0], m[1, 1], m[1, 2], m[2, 0], m[2, 1], m[2, 2])


@wp.func
def translation(m: wp.mat44) -> wp.vec3:
    return wp.vec3(m[0, 3], m[1, 3], m[2, 3])


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


@wp.struct
class Scene:
    """The plants and links of B environments with at most F fruits and L links with a mesh."""

    plant_meshes: wp.array[wp.uint64]
    """All triangles of each plant, those of fruits last. Shape (B,)."""
    first_fruit_faces: wp.array[wp.int32]
    """Index of the first triangle that belongs to a fruit. Shape (B,)."""
    fruit_counts: wp.array[wp.int32]
    """Number of fruits of each plant. Shape (B,)."""
    fruit_meshes: wp.array2d[wp.uint64]
    """Each fruit on its own. Shape (B, F)."""
    fruit_spheres: wp.array2d[wp.vec4]
    """Centre in the plant frame and radius, in [m]. Shape (B, F)."""
    fruit_is_ripe: wp.array2d[wp.int32]
    """Also 0 where a plant has fewer fruits. Shape (B, F)."""
    link_meshes: wp.array[wp.uint64]
    """Shape (L,)."""
    link_indices: wp.array[wp.int32]
    """Which of the given link poses belongs to the mesh. Shape (L,)."""
    link_lows: wp.array[wp.vec3]
    """Lower corner of the mesh in the link frame, in [m]. Shape (L,)."""
    link_highs: wp.array[wp.vec3]
    """Upper corner of the mesh in the link frame, in [m]. Shape (L,)."""


@wp.struct
class View:
    """What is worked out once per environment and call."""

    plant_rotations: wp.array[wp.mat33]
    """Optical frame to plant frame. Shape (B,)."""
    plant_positions: wp.array[wp.vec3]
    """Camera in the plant frame, in [m]. Shape (B,)."""
    rectangles: wp.array[wp.vec4]
    """Left, top, right, bottom of the target in tangents; empty without a silhouette. Shape (B,)."""
    link_rotations: wp.array2d[wp.mat33]
    """Optical frame to link frame. Shape (B, L)."""
    link_positions: wp.array2d[wp.vec3]
    """Camera in the link frame, in [m]. Shape (B, L)."""
    links_in_the_way: wp.array[wp.int32]
    """Bit k is set if mesh k can hide the target. Shape (B,)."""
    counters: wp.array2d[wp.int32]
    """Rays by what they met. Shape (B, 5)."""
    any_seen: wp.array[wp.int32]
    """Whether another ripe fruit is seen. Shape (B,)."""


@wp.func
def links_between(scene: Scene, view: View, env: int, centre: wp.vec3, radius: float) -> int:
    """The links that a sphere, given in the optical frame, can be hidden by: one bit each."""
    mask = wp.int32(0)
    margin = wp.vec3(radius, radius, radius)
    for link in range(scene.link_lows.shape[0]):
        start = view.link_positions[env, link]
        end = start + view.link_rotations[env, link] * centre
        if segment_meets_box(start, end, scene.link_lows[link] - margin, scene.link_highs[link] + margin):
            mask = mask | (1 << link)
    return mask


@wp.func
def hidden_by_robot(scene: Scene, view: View, env: int, links: int, tangents: wp.vec3, depth: float) -> bool:
    """Whether one of the links stands on the ray between the near plane and a depth."""
    remaining = links
    link = wp.int32(0)
    while remaining != 0:
        if remaining & 1:
            direction = view.link_rotations[env, link] * tangents
            start = view.link_positions[env, link] + NEAR * direction
            if wp.mesh_query_ray_anyhit(scene.link_meshes[link], start, direction, depth - NEAR):
                return True
        remaining = remaining >> 1
        link += 1
    return False


@wp.kernel
def prepare(
    scene: Scene,
    view: View,
    camera_poses: wp.array[wp.mat44],
    plant_poses: wp.array[wp.mat44],
    link_poses: wp.array2d[wp.mat44],
    targets: wp.array[wp.int32],
):
    """Relative poses, the target's rectangle and the links that can stand in the way, for one environment."""
    env = wp.tid()
    for k in range(OUTCOMES):
        view.counters[env, k] = 0
    view.any_seen[env] = 0

    camera_rotation = rotation(camera_poses[env])
    camera_position = translation(camera_poses[env])
    to_plant = wp.transpose(rotation(plant_poses[env]))
    view.plant_rotations[env] = to_plant * camera_rotation
    view.plant_positions[env] = to_plant * (camera_position - translation(plant_poses[env]))
    for link in range(scene.link_lows.shape[0]):
        pose = link_poses[env, scene.link_indices[link]]
        to_link = wp.transpose(rotation(pose))
        view.link_rotations[env, link] = to_link * camera_rotation
        view.link_positions[env, link] = to_link * (camera_position - translation(pose))

    if targets[env] < 0 or targets[env] >= scene.fruit_counts[env]:
        view.rectangles[env] = wp.vec4(0.0, 0.0, 0.0, 0.0)
        return
    sphere = scene.fruit_spheres[env, targets[env]]
    offset = wp.vec3(sphere[0], sphere[1], sphere[2]) - view.plant_positions[env]
    centre = wp.transpose(view.plant_rotations[env]) * offset
    view.rectangles[env] = bounding_rectangle(centre, sphere[3])
    view.links_in_the_way[env] = links_between(scene, view, env, centre, sphere[3])


@wp.kernel
def trace_target(
    scene: Scene,
    view: View,
    camera: Camera,
    pattern: wp.array[wp.vec2],
    targets: wp.array[wp.int32],
):
    """One ray through the target's rectangle: what it meets, if it belongs to the target's silhouette."""
    env, ray = wp.tid()
    box = view.rectangles[env]
    if box[2] <= box[0] or box[3] <= box[1]:
        return
    x = box[0] + pattern[ray][0] * (box[2] - box[0])
    y = box[1] + pattern[ray][1] * (box[3] - box[1])
    tangents = wp.vec3(x, y, 1.0)
    direction = view.plant_rotations[env] * tangents
    start = view.plant_positions[env] + NEAR * direction
    target = wp.mesh_query_ray(scene.fruit_meshes[env, targets[env]], start, direction, FAR)
    if not target.result:
        return
    outcome = VISIBLE
    if x < camera.left or x > camera.right or y < camera.top or y > camera.bottom:
        outcome = HIDDEN_BY_EDGE
    elif hidden_by_robot(scene, view, env, view.links_in_the_way[env], tangents, target.t + NEAR):
        outcome = HIDDEN_BY_ROBOT
    else:
        nearer = wp.mesh_query_ray(scene.plant_meshes[env], start, direction, target.t - SURFACE_GAP)
        if nearer.result:
            outcome = HIDDEN_BY_PLANT
            if nearer.face >= scene.first_fruit_faces[env]:
                outcome = HIDDEN_BY_FRUIT
    wp.atomic_add(view.counters, env, outcome, 1)


@wp.kernel
def trace_others(
    scene: Scene,
    view: View,
    camera: Camera,
    pattern: wp.array[wp.vec2],
    targets: wp.array[wp.int32],
):
    """Whether another ripe fruit is seen, asked only where nothing of the target is."""
    env, fruit = wp.tid()
    if view.counters[env, VISIBLE] > 0 or scene.fruit_is_ripe[env, fruit] == 0 or fruit == targets[env]:
        return
    turn = view.plant_rotations[env]
    position = view.plant_positions[env]
    sphere = scene.fruit_spheres[env, fruit]
    centre = wp.transpose(turn) * (wp.vec3(sphere[0], sphere[1], sphere[2]) - position)
    box = bounding_rectangle(centre, sphere[3])
    left = wp.max(box[0], camera.left)
    top = wp.max(box[1], camera.top)
    right = wp.min(box[2], camera.right)
    bottom = wp.min(box[3], camera.bottom)
    if left >= right or top >= bottom:
        return
    links = links_between(scene, view, env, centre, sphere[3])
    for ray in range(pattern.shape[0]):
        if view.any_seen[env] != 0:
            return
        x = left + pattern[ray][0] * (right - left)
        y = top + pattern[ray][1] * (bottom - top)
        tangents = wp.vec3(x, y, 1.0)
        direction = turn * tangents
        start = position + NEAR * direction
        hit = wp.mesh_query_ray(scene.fruit_meshes[env, fruit], start, direction, FAR)
        if hit.result:
            gap = hit.t - SURFACE_GAP
            if not wp.mesh_query_ray_anyhit(scene.plant_meshes[env], start, direction, gap):
                if not hidden_by_robot(scene, view, env, links, tangents, hit.t + NEAR):
                    view.any_seen[env] = 1


@wp.kernel
def summarise(
    scene: Scene,
    view: View,
    camera: Camera,
    rays: float,
    targets: wp.array[wp.int32],
    results: wp.array2d[wp.float32],
):
    """Rays to fractions and pixels, for one environment; the rows of `results` are those of `RESULTS`."""
    env = wp.tid()
    if targets[env] < 0 or targets[env] >= scene.fruit_counts[env]:
        for k in range(results.shape[0]):
            results[k, env] = wp.nan
        return
    seen = float(view.counters[env, VISIBLE])
    total = seen
    for k in range(VISIBLE):
        total += float(view.counters[env, k])
    if total > 0.0:
        box = view.rectangles[env]
        pixels = (box[2] - box[0]) * (box[3] - box[1]) * camera.square_pixels / rays
        results[0, env] = seen / total
        results[1, env] = seen * pixels
        results[2, env] = total * pixels
        for k in range(VISIBLE):
            results[4 + k, env] = float(view.counters[env, k]) / total
    else:
        # No silhouette in front of the camera: nothing is seen, and the size is the one it had if looked at.
        sphere = scene.fruit_spheres[env, targets[env]]
        offset = wp.vec3(sphere[0], sphere[1], sphere[2]) - view.plant_positions[env]
        squared = sphere[3] * sphere[3]
        beyond = wp.max(wp.dot(offset, offset) - squared, 0.05 * squared)
        results[0, env] = 0.0
        results[1, env] = 0.0
        results[2, env] = 3.14159265 * squared / beyond * camera.square_pixels
        for k in range(VISIBLE):
            results[4 + k, env] = 0.0
        results[4, env] = 1.0
    results[3, env] = 0.0
    if seen > 0.0 or view.any_seen[env] != 0:
        results[3, env] = 1.0
