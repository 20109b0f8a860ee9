# mypy: ignore-errors
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false
# pyright: reportGeneralTypeIssues=false, reportIndexIssue=false, reportInvalidTypeForm=false
# pyright: reportOperatorIssue=false, reportReturnType=false
# Warp's stubs describe calls from outside, not what stands inside a kernel.
"""Warp kernels of looks, moves and ways; `look_at_move` says what they mean."""

import math

import warp as wp

from maniskill_tomato.robot.ik_chain import ONE, ZERO, homogeneous, vec7d
from maniskill_tomato.robot.ik_solve import (
    INVALID,
    NEIGHBOUR,
    REACHABLE,
    UNREACHABLE,
    Solver,
    best_solution,
    nearest_rotation,
    position_of,
    reaches,
    rotation_of,
)

wp.set_module_options({"enable_backward": False, "max_unroll": 2})

SMALLEST = wp.constant(wp.float64(1.0e-6))
ROLL_STEP = wp.constant(wp.float64(math.radians(30.0)))
JOINTS_SHARE = wp.constant(wp.float64(0.01))
"""Of the sum of joint steps, in a rank: below 1, so that it decides between the two sides of a rank only."""


@wp.struct
class Rules:
    """What a look and a move must keep."""

    solver: Solver
    T_camera_flange: wp.mat44d
    max_move: wp.float64
    """In [m], as are all lengths here."""
    min_distance: wp.float64
    lowest_flange: wp.float64
    base_box: wp.vec3d
    rolls: wp.int32
    """How many of `CAMERA_ROLLS` a move tries."""
    largest_joint_step: wp.float64
    """In a move, in [rad]."""


@wp.struct
class Look:
    found: wp.int32
    q: vec7d
    camera: wp.mat44d
    """Upright where nothing was found."""


@wp.struct
class Move:
    reach: wp.int64
    q: vec7d
    camera: wp.mat44d


@wp.func
def forward_to(position: wp.vec3d, target: wp.vec3d) -> wp.vec3d:
    """The direction in which the target is; that of x from the target itself."""
    ahead = target - position
    if wp.length(ahead) > SMALLEST:
        return wp.normalize(ahead)
    return wp.vec3d(ONE, ZERO, ZERO)


@wp.func
def right_of(forward: wp.vec3d) -> wp.vec3d:
    """The level axis to the right of a camera; -y where it looks straight up or down."""
    level = wp.vec3d(forward[1], -forward[0], ZERO)
    length = wp.length(level)
    if length > SMALLEST:
        return level / length
    return wp.vec3d(ZERO, -ONE, ZERO)


@wp.func
def camera_pose(position: wp.vec3d, target: wp.vec3d, roll: wp.float64) -> wp.mat44d:
    forward = forward_to(position, target)
    right = right_of(forward)
    up = wp.cross(right, forward)
    c = wp.cos(roll)
    s = wp.sin(roll)
    return homogeneous(c * right - s * up, -s * right - c * up, forward, position)


@wp.func
def pushed_out(position: wp.vec3d, target: wp.vec3d, inward: wp.vec3d, min_distance: wp.float64) -> wp.vec3d:
    """The position, or the nearest one in its direction that is far enough from the target."""
    away = position - target
    distance = wp.length(away)
    outward = -inward
    if distance > SMALLEST:
        outward = away / distance
    return target + wp.max(distance, min_distance) * outward


@wp.func
def keeps_clear(flange: wp.vec3d, rules: Rules) -> wp.bool:
    box = rules.base_box
    near_base = wp.abs(flange[0]) < box[0] and wp.abs(flange[1]) < box[1] and wp.abs(flange[2]) < box[2]
    return flange[2] >= rules.lowest_flange and not near_base


@wp.func
def roll_of(k: int) -> wp.float64:
    """The k-th of `CAMERA_ROLLS`."""
    roll = ROLL_STEP * wp.float64((k + 1) / 2)
    if k % 2 == 0:
        roll = -roll
    return roll


@wp.func
def look_from(
    rules: Rules,
    q_ref: vec7d,
    position: wp.vec3d,
    target: wp.vec3d,
    rolls: wp.int32,
    largest_joint_step: wp.float64,
) -> Look:
    look = Look()
    look.q = q_ref
    look.camera = camera_pose(position, target, ZERO)
    best = wp.float64(1.0e30)
    for k in range(rolls):
        rank = (k + 1) / 2
        # Nothing of a higher rank is better than what was found.
        if look.found == 0 or wp.float64(rank) < best:
            camera = camera_pose(position, target, roll_of(k))
            flange = camera * rules.T_camera_flange
            place = position_of(flange)
            if keeps_clear(place, rules):
                solution = best_solution(rules.solver, place, nearest_rotation(rotation_of(flange)), q_ref)
                if solution.found == 1:
                    step = ZERO
                    total = ZERO
                    for j in range(7):
                        turn = wp.abs(solution.q[j] - q_ref[j])
                        step = wp.max(step, turn)
                        total += turn
                    cost = wp.float64(rank) + JOINTS_SHARE * total
                    if step <= largest_joint_step and cost < best:
                        best = cost
                        look.found = 1
                        look.q = solution.q
                        look.camera = camera
    return look


@wp.func
def move_to(rules: Rules, q: vec7d, position: wp.vec3d, target: wp.vec3d, goal: wp.vec3d) -> Move:
    """The move to a place: in full, half, a quarter, or not at all."""
    inward = forward_to(position, target)
    goal = pushed_out(goal, target, inward, rules.min_distance)
    move = Move()
    move.reach = UNREACHABLE
    move.q = q
    move.camera = camera_pose(goal, target, ZERO)
    share = wp.float64(1.0)
    for k in range(3):
        if move.reach == UNREACHABLE:
            # The straight way between two positions outside the smallest distance may lead through it.
            place = goal
            if k > 0:
                place = pushed_out(position + share * (goal - position), target, inward, rules.min_distance)
            look = look_from(rules, q, place, target, rules.rolls, rules.largest_joint_step)
            if look.found == 1:
                move.reach = NEIGHBOUR
                if k == 0:
                    move.reach = REACHABLE
                move.q = look.q
                move.camera = look.camera
            share = share / wp.float64(2.0)
    return move


@wp.kernel
def look_kernel(
    references: wp.array[vec7d],
    positions: wp.array[wp.vec3d],
    targets: wp.array[wp.vec3d],
    largest_joint_steps: wp.array[wp.float64],
    rolls: wp.array[wp.int32],
    rules: Rules,
    qpos: wp.array[vec7d],
    reach: wp.array[wp.int64],
    cameras: wp.array[wp.mat44d],
):
    i = wp.tid()
    q = references[i]
    finite = wp.length(q) + wp.length(positions[i]) + wp.length(targets[i])
    look = look_from(rules, q, positions[i], targets[i], rolls[i], largest_joint_steps[i])
    qpos[i] = look.q
    cameras[i] = look.camera
    reach[i] = UNREACHABLE
    if look.found == 1:
        reach[i] = REACHABLE
    if not wp.isfinite(finite):
        reach[i] = INVALID


@wp.kernel
def reach_kernel(
    positions: wp.array[wp.vec3d],
    targets: wp.array[wp.vec3d],
    rules: Rules,
    is_kept_clear: wp.int32,
    reached: wp.array[wp.int64],
):
    """1 where some joint angles look at the target from a position, 0 where none do."""
    i = wp.tid()
    position = positions[i]
    target = targets[i]
    found = wp.int64(0)
    for k in range(rules.rolls):
        if found == wp.int64(0):
            flange = camera_pose(position, target, roll_of(k)) * rules.T_camera_flange
            place = position_of(flange)
            if is_kept_clear == 0 or keeps_clear(place, rules):
                if reaches(rules.solver, place, nearest_rotation(rotation_of(flange)), vec7d()):
                    found = wp.int64(1)
    reached[i] = found
    if not wp.isfinite(wp.length(position) + wp.length(target)):
        reached[i] = INVALID


@wp.kernel
def move_kernel(
    references: wp.array[vec7d],
    positions: wp.array[wp.vec3d],
    targets: wp.array[wp.vec3d],
    actions: wp.array[wp.vec3d],
    rules: Rules,
    qpos: wp.array[vec7d],
    reach: wp.array[wp.int64],
    cameras: wp.array[wp.mat44d],
):
    i = wp.tid()
    q = references[i]
    position = positions[i]
    target = targets[i]
    forward = forward_to(position, target)
    right = right_of(forward)
    action = actions[i] * (rules.max_move / wp.max(wp.length(actions[i]), ONE))
    way = action[0] * right + action[1] * wp.cross(right, forward) + action[2] * forward
    finite = wp.length(q) + wp.length(position) + wp.length(target) + wp.length(way)
    move = move_to(rules, q, position, target, position + way)
    qpos[i] = move.q
    cameras[i] = move.camera
    reach[i] = move.reach
    if not wp.isfinite(finite):
        reach[i] = INVALID


@wp.kernel
def way_kernel(
    references: wp.array[vec7d],
    positions: wp.array[wp.vec3d],
    targets: wp.array[wp.vec3d],
    goals: wp.array[wp.vec3d],
    rules: Rules,
    least_move: wp.float64,
    near_enough: wp.float64,
    most_moves: wp.int32,
    moves: wp.array[wp.int64],
    rests: wp.array[wp.float64],
):
    """Moves straight to a goal: how many, -1 where one is refused, and how far it still is after `most_moves`."""
    i = wp.tid()
    q = references[i]
    position = positions[i]
    target = targets[i]
    goal = goals[i]
    count = wp.int64(0)
    is_open = wp.int32(1)
    for _ in range(most_moves):
        if is_open == 1:
            way = goal - position
            way = way * wp.min(rules.max_move / wp.max(wp.length(way), SMALLEST), ONE)
            move = move_to(rules, q, position, target, position + way)
            after = position_of(move.camera)
            count += wp.int64(1)
            if move.reach == UNREACHABLE or not wp.length(after - position) >= least_move:
                count = wp.int64(-1)
                is_open = wp.int32(0)
            elif wp.length(goal - after) < near_enough:
                is_open = wp.int32(0)
            q = move.q
            position = after
    moves[i] = count
    rests[i] = ZERO
    if is_open == 1:
        rests[i] = wp.length(goal - position)
