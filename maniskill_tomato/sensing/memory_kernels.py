# mypy: ignore-errors
# pyright: reportArgumentType=false, reportAssignmentType=false, reportAttributeAccessIssue=false
# pyright: reportCallIssue=false, reportGeneralTypeIssues=false, reportIndexIssue=false, reportInvalidTypeForm=false
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
LANES = wp.constant(8)
"""Rays that go through the grid in step."""
EDGE = wp.constant(1.0e-4)
"""So near the grid's edge rounding may have taken a ray out of it."""
DISC_RAYS = LANES
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
def smaller(a: float, b: float) -> float:
    """The minimum of numbers, one instruction for many of them: `wp.min` looks for NaN first."""
    return wp.where(a < b, a, b)


@wp.func
def larger(a: float, b: float) -> float:
    """The maximum, likewise."""
    return wp.where(a > b, a, b)


@wp.func
def inside_stretch(start: wp.vec3, inverse_direction: wp.vec3) -> wp.vec2:
    """Between which lengths along a ray it is inside the grid."""
    enter = wp.float32(0.0)
    leave = wp.float32(1.0e9)
    for axis in range(3):
        a = (0.0 - start[axis]) * inverse_direction[axis]
        b = (float(CELLS) - start[axis]) * inverse_direction[axis]
        enter = larger(enter, smaller(a, b))
        leave = smaller(leave, larger(a, b))
    return wp.vec2(enter, leave)


@wp.struct
class Walk:
    """Where a ray begins its way from voxel to voxel (Amanatides & Woo, Eurographics 1987)."""

    x: wp.int32
    y: wp.int32
    z: wp.int32
    borders: wp.vec3
    """Length along the ray at which it leaves the voxel across each axis."""


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
    return walk


@wp.func
def voxel_of(walk: Walk) -> int:
    return (walk.x * CELLS + walk.y) * CELLS + walk.z


@wp.func
def block_of(voxel: int) -> int:
    side = CELLS // BLOCK
    x = voxel // (CELLS * CELLS * BLOCK)
    y = voxel // (CELLS * BLOCK) & (side - 1)
    return (x * side + y) * side + (voxel // BLOCK & (side - 1))


@wp.func
def crossings(start: wp.vec3, end: wp.vec3) -> int:
    """Voxels on the way between two points, and one more for what rounding shifts."""
    count = wp.int32(2)
    for axis in range(3):
        count += int(wp.abs(wp.floor(end[axis]) - wp.floor(start[axis])))
    return count


@wp.func
def in_grid(point_w: wp.vec3, centre: wp.vec3) -> wp.vec3:
    half = 0.5 * float(CELLS)
    return (point_w - centre) / CELL_SIZE + wp.vec3(half, half, half)


_ADD_PASSES = f"""
    int* row = passes.data + size_t(env) * {VOXELS};
    int* marks = changed.data + size_t(env) * {BLOCKS};
    for (int ray = 0; ray < {LANES}; ++ray) {{
        wp::atomic_add(row + voxels[ray], lengths[ray]);
        marks[blocks[ray]] = 1;
    }}
"""


@wp.func_native(_ADD_PASSES)
def add_passes(
    passes: wp.array2d[wp.int32],
    changed: wp.array2d[wp.int32],
    env: int,
    voxels: ints8,
    blocks: ints8,
    lengths: ints8,
):
    """One stretch of each of eight rays, whose voxels' blocks are marked as changed."""
    ...


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
    """Eight rays: the lengths that they went through voxels and, at their ends, hits."""
    env, bundle = wp.tid()
    if active[env] == 0:
        return
    camera_position = translation(camera_poses[env])
    if bundle == 0:
        grid.visited[env, grid.visits[env] % MAX_VISITS] = camera_position
        grid.fractions[env, grid.visits[env] % MAX_VISITS] = fractions[env]
        grid.visits[env] = grid.visits[env] + 1
    turn = rotation(camera_poses[env])
    start = in_grid(camera_position, grid.centres[env])
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
    last_voxels = ints8()
    hits = ints8()
    blocks = ints8()
    lengths = ints8()
    travelled = vec8()
    ends = vec8()
    visits = wp.int32(0)
    for lane in range(LANES):
        ray = wp.min(bundle * LANES + lane, labels.shape[1] - 1)
        direction = turn * directions[env, ray]
        inverse_direction = wp.vec3(inverse(direction[0]), inverse(direction[1]), inverse(direction[2]))
        stretch = inside_stretch(start, inverse_direction)
        length = distances[env, ray] / CELL_SIZE
        end = wp.where(labels[env, ray] == OUTSIDE, 0.0, smaller(stretch[1], length))
        end = wp.where(bundle * LANES + lane == ray, end, 0.0)
        walk = begin_walk(start, direction, inverse_direction, stretch[0])
        borders_x[lane] = walk.borders[0]
        borders_y[lane] = walk.borders[1]
        borders_z[lane] = walk.borders[2]
        across_x[lane] = wp.abs(inverse_direction[0])
        across_y[lane] = wp.abs(inverse_direction[1])
        across_z[lane] = wp.abs(inverse_direction[2])
        steps_x[lane] = wp.where(direction[0] > 0.0, CELLS * CELLS, -CELLS * CELLS)
        steps_y[lane] = wp.where(direction[1] > 0.0, CELLS, -CELLS)
        steps_z[lane] = wp.where(direction[2] > 0.0, 1, -1)
        voxels[lane] = voxel_of(walk)
        last_voxels[lane] = voxel_of(walk)
        travelled[lane] = stretch[0]
        ends[lane] = larger(end, stretch[0])
        is_hit = wp.where(length < stretch[1] - EDGE, wp.where(labels[env, ray] == OTHER, 1, 0), 0)
        hits[lane] = wp.where(end > stretch[0], is_hit, 0)
        crossed = crossings(start + stretch[0] * direction, start + ends[lane] * direction)
        visits = wp.max(visits, wp.where(end > stretch[0], crossed, 0))
    while visits > 0:
        visits -= 1
        for ray in range(LANES):
            x = borders_x[ray]
            y = borders_y[ray]
            z = borders_z[ray]
            nearest = smaller(x, smaller(y, z))
            border = smaller(larger(travelled[ray], nearest), ends[ray])
            lengths[ray] = int((border - travelled[ray]) * PASS_UNIT + 0.5)
            voxel = voxels[ray] & (VOXELS - 1)
            last_voxels[ray] = wp.where(travelled[ray] < ends[ray], voxel, last_voxels[ray])
            blocks[ray] = block_of(last_voxels[ray])
            travelled[ray] = border
            borders_x[ray] = x + wp.where(x <= nearest, across_x[ray], 0.0)
            borders_y[ray] = y + wp.where(y <= nearest, across_y[ray], 0.0)
            borders_z[ray] = z + wp.where(z <= nearest, across_z[ray], 0.0)
            along = wp.where(x <= nearest, steps_x[ray], 0) + wp.where(y <= nearest, steps_y[ray], 0)
            voxels[ray] = voxels[ray] + along + wp.where(z <= nearest, steps_z[ray], 0)
        add_passes(grid.passes, grid.changed, env, last_voxels, blocks, lengths)
    for ray in range(LANES):
        if hits[ray] != 0:
            wp.atomic_add(grid.hits, env, last_voxels[ray], 1)


@wp.func
def posterior(hits: float, passes: float, expected: float, weight: float) -> float:
    """Hits per length: the mean of a gamma posterior with a given prior mean."""
    return (hits + weight * expected) / (passes / PASS_UNIT + weight)


# What Warp's own indexing allows, any stride and negative indices, costs as much as the estimate itself.
_ROWS_AT = f"""
    const int* first = values.data + size_t(env) * {VOXELS} + voxel;
    wp::vec_t<8, int> rows;
    for (int k = 0; k < 4; ++k) {{
        rows[k] = first[k];
        rows[4 + k] = first[{CELLS} + k];
    }}
    return rows;
"""
_PUT_ROWS = f"""
    float* first = values.data + size_t(env) * {VOXELS} + voxel;
    for (int k = 0; k < 4; ++k) {{
        first[k] = rows[k];
        first[{CELLS} + k] = rows[4 + k];
    }}
"""


@wp.func_native(_ROWS_AT)
def rows_at(values: wp.array2d[wp.int32], env: int, voxel: int) -> ints8:
    """Four voxels along z, and the four beside them along y."""
    ...


@wp.func_native(_PUT_ROWS)
def put_rows(values: wp.array2d[wp.float32], env: int, voxel: int, rows: vec8):
    """Writes the same."""
    ...


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
    corner = first_voxel(block)
    hits = ints8()
    passes = ints8()
    for i in range(BLOCK):
        for j in range(2):
            first = corner + (i * CELLS + 2 * j) * CELLS
            hit = rows_at(grid.hits, env, first)
            passed = rows_at(grid.passes, env, first)
            for k in range(8):
                part = i // 2 * 4 + j * 2 + k % 4 // 2
                hits[part] = hits[part] + hit[k]
                passes[part] = passes[part] + passed[k]
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
        for j in range(2):
            first = corner + (i * CELLS + 2 * j) * CELLS
            hit = rows_at(grid.hits, env, first)
            passed = rows_at(grid.passes, env, first)
            densities = vec8()
            for k in range(8):
                expected = around[i // 2 * 4 + j * 2 + k % 4 // 2]
                density = posterior(float(hit[k]), float(passed[k]), expected, foliage.voxel_weight)
                densities[k] = wp.where(hit[k] * KNOWN_LENGTH + passed[k] < KNOWN_LENGTH, -density, density)
            put_rows(grid.densities, env, first, densities)


@wp.func_native(f"return values.data[size_t(env) * {VOXELS} + voxel];")
def density_at(values: wp.array2d[wp.float32], env: int, voxel: int) -> float: ...


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
    visits = wp.int32(0)
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
        visits = wp.max(visits, crossings(start, start + ends[ray] * direction))
    while visits > 0:
        visits -= 1
        for ray in range(DISC_RAYS):
            x = borders_x[ray]
            y = borders_y[ray]
            z = borders_z[ray]
            nearest = smaller(x, smaller(y, z))
            border = smaller(larger(travelled[ray], nearest), ends[ray])
            stretch = border - travelled[ray]
            # Rounding may take a ray that ends on the grid's edge one voxel further, for a length of nothing.
            density = density_at(grid.densities, env, voxels[ray] & (VOXELS - 1))
            depths[ray] = depths[ray] + wp.abs(density) * stretch
            unknown[ray] = unknown[ray] + wp.where(density < 0.0, stretch, 0.0)
            travelled[ray] = border
            borders_x[ray] = x + wp.where(x <= nearest, across_x[ray], 0.0)
            borders_y[ray] = y + wp.where(y <= nearest, across_y[ray], 0.0)
            borders_z[ray] = z + wp.where(z <= nearest, across_z[ray], 0.0)
            along = wp.where(x <= nearest, steps_x[ray], 0) + wp.where(y <= nearest, steps_y[ray], 0)
            voxels[ray] = voxels[ray] + along + wp.where(z <= nearest, steps_z[ray], 0)
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
