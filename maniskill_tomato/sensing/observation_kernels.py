# mypy: ignore-errors
# pyright: reportArgumentType=false, reportAssignmentType=false, reportAttributeAccessIssue=false
# pyright: reportCallIssue=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOperatorIssue=false, reportReturnType=false
# Warp's stubs describe calls from outside, not what stands inside a kernel.
"""Warp kernel that writes the observation vector."""

import warp as wp

from maniskill_tomato.raycast.kernels import rotation, translation
from maniskill_tomato.raycast.view_ray_kernels import OTHER, OUTSIDE, TARGET, look_axes
from maniskill_tomato.sensing import view_lattice
from maniskill_tomato.sensing.memory_kernels import MAX_VISITS, Foliage, Grid, predicted_view
from maniskill_tomato.warp_runtime import SIMULTANEOUS_LANES

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": SIMULTANEOUS_LANES})

PATCH = wp.constant(8)
"""Cells along each side of the patch, each of 2 x 2 rays."""
MAP = wp.constant(11)
"""Directions along each side of the map at the present distance."""
NEAR_MAP = wp.constant(7)
"""Directions along each side of the map at the nearer distance."""
MAP_STEP = wp.constant(0.17453293)
"""Between neighbouring directions of the map, in [rad] (10 degrees)."""
NEAR_MAP_STEP = wp.constant(0.26179939)
"""The same of the nearer map (15 degrees)."""
NEARER = wp.constant(0.6)
"""The nearer map's distance by the present one."""
VISIT_SPREAD = wp.constant(0.08)
"""How far from a camera position another counts as looked from, in [m]: standard deviation of a bell."""
GAP_SCALE = wp.constant(0.32)
"""The distance between a hit and the target's plane that becomes 1, in [m]."""

AZIMUTHS = wp.constant(view_lattice.AZIMUTHS)
ELEVATIONS = wp.constant(view_lattice.ELEVATIONS)
DISTANCES = wp.constant(view_lattice.DISTANCES)
ANGLE_STEP = wp.constant(view_lattice.ANGLE_STEP)
FIRST_DISTANCE = wp.constant(view_lattice.FIRST_DISTANCE)
DISTANCE_RATIO = wp.constant(view_lattice.DISTANCE_RATIO)


@wp.struct
class Belief:
    """What was looked at, for B environments."""

    viewpoints: wp.array2d[wp.float32]
    camera_poses: wp.array[wp.mat44]
    visible_fractions: wp.array[wp.float32]
    time_left: wp.array[wp.float32]
    """As a share of the episode."""
    directions: wp.array2d[wp.vec3]
    distances: wp.array2d[wp.float32]
    labels: wp.array2d[wp.int8]
    reachable: wp.array2d[wp.uint8]
    """By candidate of the view lattice."""
    looked: wp.array[wp.int32]
    """0 where nothing has changed, so that the vector stays as it is."""


@wp.struct
class Layout:
    """Where each part begins in the vector; -1 for a part that is switched off."""

    viewpoint: wp.int32
    pose: wp.int32
    target: wp.int32
    visible_fraction: wp.int32
    time: wp.int32
    patch: wp.int32
    map: wp.int32
    near_map: wp.int32
    nearest: wp.float32
    """Smallest distance of the nearer map, in [m]."""
    target_middle: wp.vec3
    target_scale: wp.vec3


@wp.func
def write_numbers(belief: Belief, layout: Layout, target: wp.vec3, env: int, out: wp.array2d[float]):
    position = translation(belief.camera_poses[env])
    offset = position - target
    distance = wp.length(offset)
    if layout.viewpoint >= 0:
        for i in range(3):
            at = layout.viewpoint + i
            out[env, at] = (belief.viewpoints[env, i] - layout.target_middle[i]) / layout.target_scale[i]
            out[env, at + 3] = belief.viewpoints[env, i + 3] / wp.pi
    if layout.pose >= 0:
        direction = offset / wp.max(distance, 1.0e-6)
        for i in range(3):
            out[env, layout.pose + i] = offset[i] / 0.5
            out[env, layout.pose + 4 + i] = direction[i]
        out[env, layout.pose + 3] = distance / 0.5 - 1.0
    if layout.target >= 0:
        for i in range(3):
            out[env, layout.target + i] = (target[i] - layout.target_middle[i]) / layout.target_scale[i]
    if layout.visible_fraction >= 0:
        out[env, layout.visible_fraction] = 2.0 * belief.visible_fractions[env] - 1.0
    if layout.time >= 0:
        out[env, layout.time] = 2.0 * belief.time_left[env] - 1.0


@wp.func
def write_patch_cell(
    belief: Belief, start: int, target: wp.vec3, env: int, cell: int, out: wp.array2d[float]
):
    """Target less outside, occluder, and how far occluders and background stand from the target's plane."""
    pose = belief.camera_poses[env]
    forward = wp.normalize(target - translation(pose))
    away = wp.dot(target - translation(pose), forward)
    forward_c = wp.transpose(rotation(pose)) * forward
    row = cell // PATCH
    column = cell - row * PATCH
    seen = wp.float32(0.0)
    occluded = wp.float32(0.0)
    gaps = wp.float32(0.0)
    others = wp.float32(0.0)
    for corner in range(4):
        ray = (2 * row + corner // 2) * (2 * PATCH) + 2 * column + corner % 2
        label = belief.labels[env, ray]
        if label == TARGET:
            seen += 0.25
        elif label == OUTSIDE:
            seen -= 0.25
        elif label == OTHER:
            depth = belief.distances[env, ray] * wp.dot(belief.directions[env, ray], forward_c)
            gap = away - depth
            others += 1.0
            gaps += wp.clamp(gap / GAP_SCALE, -1.0, 1.0)
            if gap > 0.0:
                occluded += 0.25
    cells = PATCH * PATCH
    out[env, start + cell] = seen
    out[env, start + cells + cell] = occluded
    out[env, start + 2 * cells + cell] = gaps / wp.max(others, 1.0)


@wp.func
def turned(target: wp.vec3, position: wp.vec3, right: float, up: float, distance: float) -> wp.vec3:
    """A camera position after turning about the target by angles to the right and up."""
    axes = look_axes(position, target)
    angle = wp.sqrt(right * right + up * up)
    across = wp.vec3(0.0, 0.0, 0.0)
    if angle > 0.0:
        across = (axes * wp.vec3(right, up, 0.0)) * (wp.sin(angle) / angle)
    back = axes * wp.vec3(0.0, 0.0, -wp.cos(angle))
    return target + distance * (across + back)


@wp.func
def looked_from(grid: Grid, env: int, position: wp.vec3) -> float:
    nearest = wp.float32(1.0e6)
    for i in range(wp.min(grid.visits[env], MAX_VISITS)):
        nearest = wp.min(nearest, wp.length(grid.visited[env, i] - position))
    ratio = nearest / VISIT_SPREAD
    return wp.exp(-0.5 * ratio * ratio)


@wp.func
def unreachable_share(belief: Belief, env: int, target: wp.vec3, position: wp.vec3) -> float:
    """Share of candidates out of reach, interpolated linearly in the lattice; 1 more than half a step outside it."""
    offset = position - target
    distance = wp.max(wp.length(offset), 1.0e-6)
    a = wp.atan2(-offset[1], -offset[0]) / ANGLE_STEP + float(AZIMUTHS // 2)
    e = wp.asin(wp.clamp(offset[2] / distance, -1.0, 1.0)) / ANGLE_STEP + float(ELEVATIONS // 2)
    d = wp.log(distance / FIRST_DISTANCE) / wp.log(DISTANCE_RATIO)
    last_a = float(AZIMUTHS - 1)
    last_e = float(ELEVATIONS - 1)
    last_d = float(DISTANCES - 1)
    if a < -0.5 or e < -0.5 or d < -0.5 or a > last_a + 0.5 or e > last_e + 0.5 or d > last_d + 0.5:
        return 1.0
    a = wp.clamp(a, 0.0, last_a)
    e = wp.clamp(e, 0.0, last_e)
    d = wp.clamp(d, 0.0, last_d)
    first_a = wp.min(int(a), AZIMUTHS - 2)
    first_e = wp.min(int(e), ELEVATIONS - 2)
    first_d = wp.min(int(d), DISTANCES - 2)
    share = wp.float32(0.0)
    for corner in range(8):
        i = corner // 4
        j = (corner // 2) % 2
        k = corner % 2
        weight_a = wp.where(i == 1, a - float(first_a), 1.0 - a + float(first_a))
        weight_e = wp.where(j == 1, e - float(first_e), 1.0 - e + float(first_e))
        weight_d = wp.where(k == 1, d - float(first_d), 1.0 - d + float(first_d))
        candidate = ((first_a + i) * ELEVATIONS + first_e + j) * DISTANCES + first_d + k
        if belief.reachable[env, candidate] == wp.uint8(0):
            share += weight_a * weight_e * weight_d
    return share


@wp.kernel
def observe(belief: Belief, grid: Grid, foliage: Foliage, layout: Layout, out: wp.array2d[wp.float32]):
    """One thread writes the numbers, one each cell of the patch and each direction of the maps."""
    env, part = wp.tid()
    if belief.looked[env] == 0:
        return
    target = grid.centres[env]
    position = translation(belief.camera_poses[env])
    patch_cells = PATCH * PATCH
    map_cells = MAP * MAP
    near_cells = NEAR_MAP * NEAR_MAP
    if part == 0:
        write_numbers(belief, layout, target, env, out)
        return
    cell = part - 1
    if cell < patch_cells:
        if layout.patch >= 0:
            write_patch_cell(belief, layout.patch, target, env, cell, out)
        return
    cell -= patch_cells
    distance = wp.length(position - target)
    if cell < map_cells:
        if layout.map >= 0:
            row = cell // MAP
            right = float(cell - row * MAP - MAP // 2) * MAP_STEP
            up = float(MAP // 2 - row) * MAP_STEP
            there = turned(target, position, right, up, distance)
            view = predicted_view(grid, foliage, env, there)
            out[env, layout.map + cell] = 2.0 * view[0] - 1.0
            out[env, layout.map + map_cells + cell] = view[1]
            out[env, layout.map + 2 * map_cells + cell] = looked_from(grid, env, there)
            out[env, layout.map + 3 * map_cells + cell] = unreachable_share(belief, env, target, there)
        return
    cell -= map_cells
    if layout.near_map >= 0:
        row = cell // NEAR_MAP
        right = float(cell - row * NEAR_MAP - NEAR_MAP // 2) * NEAR_MAP_STEP
        up = float(NEAR_MAP // 2 - row) * NEAR_MAP_STEP
        there = turned(target, position, right, up, wp.max(layout.nearest, NEARER * distance))
        view = predicted_view(grid, foliage, env, there)
        out[env, layout.near_map + cell] = 2.0 * view[0] - 1.0
        out[env, layout.near_map + near_cells + cell] = unreachable_share(belief, env, target, there)
