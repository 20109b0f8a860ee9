# mypy: ignore-errors
# pyright: reportArgumentType=false, reportAssignmentType=false, reportAttributeAccessIssue=false
# pyright: reportCallIssue=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOperatorIssue=false, reportReturnType=false
# Warp's stubs describe calls from outside, not what stands inside a kernel.
"""Warp kernels that fill a voxel grid around the target from view rays and predict from it what other views see.

Inside the kernels lengths count in voxel edges, with the grid's lower corner at the origin.
"""

import warp as wp

from maniskill_tomato.raycast.kernels import rotation, translation
from maniskill_tomato.raycast.view_ray_kernels import OTHER, OUTSIDE, look_axes
from maniskill_tomato.warp_runtime import SIMULTANEOUS_LANES

wp.set_module_options({"enable_backward": False, "max_unroll": 8, "cpu_compiler_flags": SIMULTANEOUS_LANES})

CELLS = wp.constant(32)
"""Voxels along each edge of the grid."""
CELL_SIZE = wp.constant(0.02)
"""Edge of a voxel, in [m]."""
PASS_UNIT = wp.constant(256.0)
"""Passed lengths are kept as integers of this many to a voxel edge: their sum does not depend on the order."""
KNOWN_LENGTH = wp.constant(64)
"""A voxel without a hit through which less than this has passed (a quarter of its edge) is unknown."""
VOXELS = wp.constant(32768)
"""Of the grid, a power of two."""
BLOCK = wp.constant(4)
"""Voxels along each edge of the largest block whose density stands in for what is not seen of it."""
BLOCKS = wp.constant(512)
"""Number of such blocks."""
DISC_RAYS = wp.constant(8)
"""Rays from the target's disc towards a candidate."""
MAX_VISITS = wp.constant(64)
"""Camera positions that are remembered; later ones replace the first."""


vec8 = wp.types.vector(length=8, dtype=wp.float32)
ints8 = wp.types.vector(length=8, dtype=wp.int32)


@wp.struct
class Grid:
    """What B environments remember."""

    hits: wp.array2d[wp.int32]
    """Rays that ended at something other than the target, by voxel. Shape (B, 32768)."""
    passes: wp.array2d[wp.int32]
    """Length that rays went through the voxel, in `PASS_UNIT`. Shape (B, 32768)."""
    densities: wp.array2d[wp.float32]
    """Estimated hits per voxel edge, less than 0 (its negative) where the voxel is unknown. Shape (B, 32768)."""
    hit_rows: wp.array2d[wp.vec4i]
    """The same memory as `hits`, four voxels each. Shape (B, 8192)."""
    pass_rows: wp.array2d[wp.vec4i]
    density_rows: wp.array2d[wp.vec4]
    changed: wp.array2d[wp.int32]
    """1 for blocks whose densities are older than their hits and passes. Shape (B, 512)."""
    centres: wp.array[wp.vec3]
    """The target, in the world frame, in [m]. Shape (B,)."""
    visited: wp.array2d[wp.vec3]
    """Camera positions in the world frame, in [m]. Shape (B, 64)."""
    visits: wp.array[wp.int32]
    """How many camera positions there were. Shape (B,)."""
    fractions: wp.array2d[wp.float32]
    """V_f that was measured from each of them. Shape (B, 64)."""


@wp.struct
class Foliage:
    """What is assumed about foliage before it is seen."""

    density: wp.float32
    """Expected hits per voxel edge in an unknown voxel."""
    voxel_weight: wp.float32
    """Length after which a voxel's own observations outweigh its surroundings, in voxel edges."""
    block_weight: wp.float32
    """The same for blocks of 2 and 4 voxels along each edge."""
    radius: wp.float32
    """Radius of the target's disc, in [m]."""


@wp.func
def inverse(x: float) -> float:
    """1 / x, finite."""
    if wp.abs(x) < 1.0e-9:
        return wp.float32(1.0e9)
    return 1.0 / x


@wp.func
def inside_stretch(start: wp.vec3, inverse_direction: wp.vec3) -> wp.vec2:
    """Between which lengths along a ray it is inside the grid."""
    enter = wp.float32(0.0)
    leave = wp.float32(1.0e9)
    for axis in range(3):
        a = (0.0 - start[axis]) * inverse_direction[axis]
        b = (float(CELLS) - start[axis]) * inverse_direction[axis]
        enter = wp.max(enter, wp.min(a, b))
        leave = wp.min(leave, wp.max(a, b))
    return wp.vec2(enter, leave)


@wp.struct
class Walk:
    """A ray on its way from voxel to voxel (Amanatides & Woo, Eurographics 1987)."""

    x: wp.int32
    y: wp.int32
    z: wp.int32
    borders: wp.vec3
    """Length along the ray at which it leaves the voxel across each axis."""
    travelled: wp.float32


@wp.func
def begin_walk(start: wp.vec3, direction: wp.vec3, inverse_direction: wp.vec3, at: float) -> Walk:
    walk = Walk()
    point = start + at * direction
    last = CELLS - 1
    walk.x = wp.clamp(int(wp.floor(point[0])), 0, last)
    walk.y = wp.clamp(int(wp.floor(point[1])), 0, last)
    walk.z = wp.clamp(int(wp.floor(point[2])), 0, last)
    cell = wp.vec3(float(walk.x), float(walk.y), float(walk.z))
    for axis in range(3):
        ahead = cell[axis]
        if direction[axis] > 0.0:
            ahead += 1.0
        border = (ahead - start[axis]) * inverse_direction[axis]
        if wp.abs(direction[axis]) < 1.0e-9:
            border = 1.0e9
        walk.borders[axis] = border
    walk.travelled = at
    return walk


@wp.func
def voxel_of(walk: Walk) -> int:
    return (walk.x * CELLS + walk.y) * CELLS + walk.z


@wp.func
def block_of(walk: Walk) -> int:
    side = CELLS // BLOCK
    return ((walk.x // BLOCK) * side + walk.y // BLOCK) * side + walk.z // BLOCK


@wp.func
def is_in_grid(walk: Walk) -> bool:
    return (
        walk.x >= 0 and walk.x < CELLS and walk.y >= 0 and walk.y < CELLS and walk.z >= 0 and walk.z < CELLS
    )


@wp.func
def next_voxel(walk: Walk, direction: wp.vec3, inverse_direction: wp.vec3) -> Walk:
    """Across the nearest border."""
    if walk.borders[0] <= walk.borders[1] and walk.borders[0] <= walk.borders[2]:
        walk.travelled = wp.max(walk.travelled, walk.borders[0])
        walk.borders[0] = walk.borders[0] + wp.abs(inverse_direction[0])
        walk.x += wp.where(direction[0] > 0.0, 1, -1)
    elif walk.borders[1] <= walk.borders[2]:
        walk.travelled = wp.max(walk.travelled, walk.borders[1])
        walk.borders[1] = walk.borders[1] + wp.abs(inverse_direction[1])
        walk.y += wp.where(direction[1] > 0.0, 1, -1)
    else:
        walk.travelled = wp.max(walk.travelled, walk.borders[2])
        walk.borders[2] = walk.borders[2] + wp.abs(inverse_direction[2])
        walk.z += wp.where(direction[2] > 0.0, 1, -1)
    return walk


@wp.func
def in_grid(point_w: wp.vec3, centre: wp.vec3) -> wp.vec3:
    half = 0.5 * float(CELLS)
    return (point_w - centre) / CELL_SIZE + wp.vec3(half, half, half)


@wp.kernel
def integrate(
    grid: Grid,
    camera_poses: wp.array[wp.mat44],
    directions: wp.array2d[wp.vec3],
    distances: wp.array2d[wp.float32],
    labels: wp.array2d[wp.int8],
    fractions: wp.array[wp.float32],
    active: wp.array[wp.int32],
):
    """One ray: the lengths that it went through voxels and, at its end, a hit."""
    env, ray = wp.tid()
    if active[env] == 0:
        return
    camera_position = translation(camera_poses[env])
    if ray == 0:
        grid.visited[env, grid.visits[env] % MAX_VISITS] = camera_position
        grid.fractions[env, grid.visits[env] % MAX_VISITS] = fractions[env]
        grid.visits[env] = grid.visits[env] + 1
    label = labels[env, ray]
    if label == OUTSIDE:
        return
    start = in_grid(camera_position, grid.centres[env])
    direction = rotation(camera_poses[env]) * directions[env, ray]
    inverse_direction = wp.vec3(inverse(direction[0]), inverse(direction[1]), inverse(direction[2]))
    stretch = inside_stretch(start, inverse_direction)
    length = distances[env, ray] / CELL_SIZE
    end = wp.min(stretch[1], length)
    if end <= stretch[0]:
        return
    walk = begin_walk(start, direction, inverse_direction, stretch[0])
    while is_in_grid(walk):
        voxel = voxel_of(walk)
        before = walk.travelled
        grid.changed[env, block_of(walk)] = 1
        walk = next_voxel(walk, direction, inverse_direction)
        passed = wp.min(walk.travelled, end) - before
        wp.atomic_add(grid.passes, env, voxel, int(passed * PASS_UNIT + 0.5))
        if walk.travelled >= end:
            if label == OTHER and length <= stretch[1]:
                wp.atomic_add(grid.hits, env, voxel, 1)
            return


@wp.func
def posterior(hits: float, passes: float, expected: float, weight: float) -> float:
    """Hits per length: the mean of a gamma posterior with a given prior mean."""
    return (hits + weight * expected) / (passes / PASS_UNIT + weight)


@wp.func
def first_voxel(block: int) -> int:
    side = CELLS // BLOCK
    x = block // (side * side)
    y = (block // side) % side
    return BLOCK * ((x * CELLS + y) * CELLS + block % side)


@wp.kernel
def estimate(grid: Grid, foliage: Foliage):
    """The densities of one block, where out of date. Leaves are larger than voxels: neighbours tell of each other."""
    env, block = wp.tid()
    if grid.changed[env, block] == 0:
        return
    grid.changed[env, block] = 0
    first = first_voxel(block) // BLOCK
    half = BLOCK // 2
    hits = ints8()
    passes = ints8()
    for i in range(BLOCK):
        for j in range(BLOCK):
            row = first + (i * CELLS + j) * (CELLS // BLOCK)
            hit = grid.hit_rows[env, row]
            passed = grid.pass_rows[env, row]
            part = (i // half) * 4 + (j // half) * 2
            for k in range(half):
                hits[part + k] = hits[part + k] + hit[k * half] + hit[k * half + 1]
                passes[part + k] = passes[part + k] + passed[k * half] + passed[k * half + 1]
    all_hits = wp.float32(0.0)
    all_passes = wp.float32(0.0)
    for part in range(8):
        all_hits += float(hits[part])
        all_passes += float(passes[part])
    whole = posterior(all_hits, all_passes, foliage.density, foliage.block_weight)
    around = vec8()
    for part in range(8):
        around[part] = posterior(float(hits[part]), float(passes[part]), whole, foliage.block_weight)
    for i in range(BLOCK):
        for j in range(BLOCK):
            row = first + (i * CELLS + j) * (CELLS // BLOCK)
            hit = grid.hit_rows[env, row]
            passed = grid.pass_rows[env, row]
            part = (i // half) * 4 + (j // half) * 2
            densities = wp.vec4()
            for k in range(BLOCK):
                expected = around[part + k // half]
                own = posterior(float(hit[k]), float(passed[k]), expected, foliage.voxel_weight)
                density = wp.where(hit[k] == 0 and passed[k] == 0, expected, own)
                is_unknown = hit[k] == 0 and passed[k] < KNOWN_LENGTH
                densities[k] = wp.where(is_unknown, -density, density)
            grid.density_rows[env, row] = densities


@wp.func
def disc_point(index: int) -> wp.vec2:
    """Points of the unit disc that stand for equal areas (a sunflower, Vogel 1979)."""
    radius = wp.sqrt((float(index) + 0.5) / float(DISC_RAYS))
    angle = 2.39996323 * float(index)
    return wp.vec2(radius * wp.cos(angle), radius * wp.sin(angle))


@wp.func
def predicted_view(grid: Grid, foliage: Foliage, env: int, position: wp.vec3) -> wp.vec2:
    """Expected visible share of the target's disc from a position, and the unknown share of the way there.

    All rays go from voxel to voxel in step and without branches, so that a processor works on them at once.
    """
    target = grid.centres[env]
    axes = look_axes(position, target)
    goal = in_grid(position, target)
    borders_x = vec8()
    borders_y = vec8()
    borders_z = vec8()
    across_x = vec8()
    across_y = vec8()
    across_z = vec8()
    steps_x = ints8()
    steps_y = ints8()
    steps_z = ints8()
    voxels = ints8()
    travelled = vec8()
    ends = vec8()
    depths = vec8()
    unknown = vec8()
    whole = wp.float32(0.0)
    left = wp.float32(0.0)
    for ray in range(DISC_RAYS):
        point = foliage.radius * disc_point(ray)
        bulge = wp.sqrt(wp.max(foliage.radius * foliage.radius - wp.dot(point, point), 0.0))
        start = in_grid(target + axes * wp.vec3(point[0], point[1], -bulge), target)
        length = wp.length(goal - start)
        direction = (goal - start) / wp.max(length, 1.0e-6)
        inverse_direction = wp.vec3(inverse(direction[0]), inverse(direction[1]), inverse(direction[2]))
        walk = begin_walk(start, direction, inverse_direction, 0.0)
        borders_x[ray] = walk.borders[0]
        borders_y[ray] = walk.borders[1]
        borders_z[ray] = walk.borders[2]
        across_x[ray] = wp.abs(inverse_direction[0])
        across_y[ray] = wp.abs(inverse_direction[1])
        across_z[ray] = wp.abs(inverse_direction[2])
        steps_x[ray] = wp.where(direction[0] > 0.0, CELLS * CELLS, -CELLS * CELLS)
        steps_y[ray] = wp.where(direction[1] > 0.0, CELLS, -CELLS)
        steps_z[ray] = wp.where(direction[2] > 0.0, 1, -1)
        voxels[ray] = voxel_of(walk)
        ends[ray] = wp.min(length, inside_stretch(start, inverse_direction)[1])
        whole += ends[ray]
        left = wp.max(left, ends[ray])
    while left > 0.0:
        left = wp.float32(0.0)
        for ray in range(DISC_RAYS):
            x = borders_x[ray]
            y = borders_y[ray]
            z = borders_z[ray]
            goes_x = x <= y and x <= z
            goes_y = y <= z and not goes_x
            goes_z = not (goes_x or goes_y)
            border = wp.min(wp.max(travelled[ray], wp.min(x, wp.min(y, z))), ends[ray])
            stretch = border - travelled[ray]
            # Rounding may take a ray that ends on the grid's edge one voxel further, for a length of nothing.
            density = grid.densities[env, voxels[ray] & (VOXELS - 1)]
            depths[ray] = depths[ray] + wp.abs(density) * stretch
            unknown[ray] = unknown[ray] + wp.where(density < 0.0, stretch, 0.0)
            travelled[ray] = border
            left = wp.max(left, ends[ray] - border)
            borders_x[ray] = x + wp.where(goes_x, across_x[ray], 0.0)
            borders_y[ray] = y + wp.where(goes_y, across_y[ray], 0.0)
            borders_z[ray] = z + wp.where(goes_z, across_z[ray], 0.0)
            along = wp.where(goes_y, steps_y[ray], steps_z[ray])
            voxels[ray] = voxels[ray] + wp.where(goes_x, steps_x[ray], along)
    seen = wp.float32(0.0)
    hidden = wp.float32(0.0)
    for ray in range(DISC_RAYS):
        seen += wp.exp(-depths[ray])
        hidden += unknown[ray]
    return wp.vec2(seen / float(DISC_RAYS), hidden / wp.max(whole, 1.0e-6))


@wp.kernel
def predict(
    grid: Grid,
    foliage: Foliage,
    positions: wp.array2d[wp.vec3],
    predictions: wp.array2d[wp.vec2],
):
    env, candidate = wp.tid()
    predictions[env, candidate] = predicted_view(grid, foliage, env, positions[env, candidate])
