# mypy: ignore-errors
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false
# pyright: reportGeneralTypeIssues=false, reportIndexIssue=false, reportInvalidTypeForm=false
# pyright: reportOperatorIssue=false, reportReturnType=false
# The type checkers are silent here: Warp's stubs describe calls from outside, not the inside of a kernel.
"""The kernel of the inverse kinematics: exact solution, else neighbour, else unreachable."""

import warp as wp

from maniskill_tomato.robot.ik_chain import HALF, ONE, TWO, ZERO, Chain, column, homogeneous, vec7d
from maniskill_tomato.robot.ik_circle import TWO_PI, elbow_circle, evaluate, feasible_configurations
from maniskill_tomato.robot.ik_neighbour import Allowed, hand_of, nearest_neighbour, pose_ratios
from maniskill_tomato.robot.ik_select import NO_COST, Weights, angles_at, refined_psi, sampled_choice

wp.set_module_options({"enable_backward": False, "max_unroll": 7})

REACHABLE = wp.constant(wp.int64(0))
NEIGHBOUR = wp.constant(wp.int64(1))
UNREACHABLE = wp.constant(wp.int64(2))
INVALID = wp.constant(wp.int64(-1))
"""The pose is not a rigid transform, or something is not finite."""

STRICT = wp.constant(wp.float64(2.0e-11))
"""Tolerance of the first attempt: what rounding does to a pose at the edge of the workspace."""
ROUNDING = wp.constant(wp.float64(1.0e-15))
"""What rounding does to the distance of shoulder and wrist, in [m]."""
PROBES = wp.constant(16)
"""Arm angles, equally spaced."""
SLIGHTLY_BENT = wp.constant(wp.float64(1.0e-3))
"""Elbow angle, in [rad], from which on the rounding of a distance is no matter."""
LARGEST_SKEW = wp.constant(wp.float64(1.0e-3))
"""How far R^T R may be from the identity, in every element."""


@wp.struct
class Solver:
    """An arm, and how its joint angles are chosen."""

    chain: Chain
    weights: Weights
    tolerance: wp.float64
    """How far outside the workspace a pose may be, in [m] and [rad]."""


@wp.struct
class ExactSolution:
    found: wp.int32
    stretched: wp.int32
    """1 if the arm was taken as stretched; exact elbow angles near zero are then worth another attempt."""
    q: vec7d


@wp.func
def exact_solution(
    chain: Chain,
    position: wp.vec3d,
    rotation: wp.mat33d,
    q_ref: vec7d,
    weights: Weights,
    tolerance: wp.float64,
    stretch: wp.float64,
) -> ExactSolution:
    """The cheapest joint angles that reach a pose to within a few tolerances."""
    solution = ExactSolution()
    circle = elbow_circle(chain, position, rotation, q_ref, tolerance, stretch)
    if circle.reachable == 1:
        if stretch > ZERO and circle.q4 == ZERO:
            solution.stretched = 1
        choice = sampled_choice(chain, circle, q_ref, weights, tolerance)
        if choice.cost < NO_COST:
            psi = refined_psi(chain, circle, choice, q_ref, weights, tolerance)
            q = angles_at(chain, circle, psi, choice.configuration, q_ref, tolerance)
            unit = Allowed()
            unit.distance = ONE
            unit.angle = ONE
            off = pose_ratios(hand_of(chain, q), position, rotation, unit)
            if wp.max(off[0], off[1]) < wp.float64(50.0) * tolerance:
                solution.found = 1
                solution.q = q
    return solution


@wp.func
def nearest_rotation(m: wp.mat33d) -> wp.mat33d:
    """The rotation nearest to a matrix that is almost one: Newton's iteration for the polar decomposition."""
    identity = wp.identity(n=3, dtype=wp.float64)
    for _ in range(2):
        m = m * (wp.float64(1.5) * identity - HALF * (wp.transpose(m) * m))
    return m


@wp.func
def is_rigid(m: wp.mat33d, bottom: wp.vec4d) -> wp.bool:
    """Whether a transform has a rotation and the last row 0 0 0 1, to the precision of float32 and worse."""
    skew = wp.transpose(m) * m - wp.identity(n=3, dtype=wp.float64)
    largest = wp.max(wp.abs(bottom - wp.vec4d(ZERO, ZERO, ZERO, ONE)))
    for i in range(3):
        for j in range(3):
            # The comparison is false for NaN.
            if not (wp.abs(skew[i, j]) < LARGEST_SKEW):
                largest = ONE
    return largest < LARGEST_SKEW and wp.determinant(m) > ZERO


@wp.func
def rotation_of(pose: wp.mat44d) -> wp.mat33d:
    return wp.mat33d(
        pose[0, 0], pose[0, 1], pose[0, 2],
        pose[1, 0], pose[1, 1], pose[1, 2],
        pose[2, 0], pose[2, 1], pose[2, 2],
    )  # fmt: skip


@wp.func
def position_of(pose: wp.mat44d) -> wp.vec3d:
    return wp.vec3d(pose[0, 3], pose[1, 3], pose[2, 3])


@wp.func
def best_solution(solver: Solver, position: wp.vec3d, rotation: wp.mat33d, q_ref: vec7d) -> ExactSolution:
    """The cheapest joint angles that reach a pose, as exactly as it can be reached."""
    chain = solver.chain
    weights = solver.weights
    tolerance = solver.tolerance
    solution = exact_solution(chain, position, rotation, q_ref, weights, STRICT, ROUNDING)
    if solution.found == 0 and solution.stretched == 1:
        solution = exact_solution(chain, position, rotation, q_ref, weights, STRICT, ZERO)
    if solution.found == 0:
        solution = exact_solution(chain, position, rotation, q_ref, weights, tolerance, tolerance)
    if solution.found == 0 and solution.stretched == 1:
        solution = exact_solution(chain, position, rotation, q_ref, weights, tolerance, ZERO)
    return solution


@wp.func
def reaches(solver: Solver, position: wp.vec3d, rotation: wp.mat33d, q_ref: vec7d) -> wp.bool:
    """Whether `best_solution` finds any joint angles.

    Nearly all poses within reach leave so wide a range of arm angles that one of `PROBES` falls into it. The cheapest
    joint angles, which cost thirty times as much, are searched for in the others only.
    """
    circle = elbow_circle(solver.chain, position, rotation, q_ref, STRICT, ROUNDING)
    if circle.reachable == 1 and circle.q4 > SLIGHTLY_BENT:
        for k in range(PROBES):
            psi = TWO_PI * (wp.float64(k) + HALF) / wp.float64(PROBES)
            values = evaluate(circle, wp.cos(psi), wp.sin(psi))
            if feasible_configurations(solver.chain, values, ZERO) != 0:
                return True
    return best_solution(solver, position, rotation, q_ref).found == 1


@wp.kernel
def solve_kernel(
    poses: wp.array[wp.mat44d],
    references: wp.array[vec7d],
    solver: Solver,
    neighbours: wp.int32,
    allowed: Allowed,
    qpos: wp.array[vec7d],
    reach: wp.array[wp.int64],
    reached: wp.array[wp.mat44d],
):
    i = wp.tid()
    pose = poses[i]
    q_ref = references[i]
    rotation = rotation_of(pose)
    position = position_of(pose)
    chain = solver.chain
    outcome = UNREACHABLE
    q = q_ref
    finite = wp.isfinite(wp.length(position)) and wp.isfinite(wp.length(q_ref))
    if not (finite and is_rigid(rotation, pose[3])):
        outcome = INVALID
    else:
        rotation = nearest_rotation(rotation)
        solution = best_solution(solver, position, rotation, q_ref)
        if solution.found == 1:
            outcome = REACHABLE
            q = solution.q
        elif neighbours == 1:
            # The wrist of a neighbour pose is at most this far away.
            wrist_shift = allowed.distance + TWO * chain.hand * wp.sin(HALF * allowed.angle)
            circle = elbow_circle(chain, position, rotation, q_ref, wrist_shift, ZERO)
            if circle.reachable == 1:
                neighbour = nearest_neighbour(chain, circle, position, rotation, allowed)
                if neighbour.distance < NO_COST:
                    outcome = NEIGHBOUR
                    q = neighbour.q
                    near = hand_of(chain, q)
                    # The pose found is reachable, maybe also nearer to the reference.
                    solution = exact_solution(
                        chain, near.position, near.rotation, q_ref, solver.weights, STRICT, ZERO
                    )
                    if solution.found == 1:
                        q = solution.q
    qpos[i] = q
    reach[i] = outcome
    hand = hand_of(chain, q)
    reached[i] = homogeneous(
        column(hand.rotation, 0), column(hand.rotation, 1), column(hand.rotation, 2), hand.position
    )
