# mypy: ignore-errors
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false
# pyright: reportGeneralTypeIssues=false, reportIndexIssue=false, reportInvalidTypeForm=false
# pyright: reportOperatorIssue=false, reportReturnType=false
# The type checkers are silent here: Warp's stubs describe calls from outside, not the inside of a kernel.
"""The nearest reachable pose to one that is not: least squares in joint space, where the limits are a box.

The distance D between poses is D^2 = (|dp| / a)^2 + (angle / b)^2, a (5 cm) and b (10 degrees) being allowed.
The joint angles that minimise it within their limits are found by a projected Levenberg-Marquardt method,
started in every arm configuration from the arm angle that breaks the limits least, with its angles put on the
limits. Where the minimum exceeds a or b alone, the method goes on from there with what the two exceed a and b
by as the cost, which is zero wherever a neighbour is allowed.
"""

import math

import warp as wp

from maniskill_tomato.robot.ik_chain import (
    AXIS_SIGNS,
    HALF,
    ONE,
    ZERO,
    Chain,
    mat73d,
    vec7d,
)
from maniskill_tomato.robot.ik_circle import ElbowCircle, evaluate, unlimited_angles

wp.set_module_options({"enable_backward": False})

mat77d = wp.types.matrix(shape=(7, 7), dtype=wp.float64)

ARM_ANGLES = wp.constant(24)
ARM_ANGLE_STEP = wp.constant(wp.float64(math.tau / 24.0))
ITERATIONS = wp.constant(20)
"""Steps at most towards the nearest pose."""
BOX_ITERATIONS = wp.constant(60)
"""Steps at most towards a pose that is allowed, if the nearest is not."""
JUST_INSIDE = wp.constant(wp.float64(0.999))
"""The share of a and b that these steps aim at, so that they end inside."""
HOPELESS = wp.constant(wp.float64(2.5))
"""Distance D of the nearest pose beyond which none allowed is looked for; sqrt(2) but for local minima."""


@wp.struct
class Allowed:
    distance: wp.float64
    """Largest distance of a neighbour pose, in [m]."""
    angle: wp.float64
    """Largest angle between a neighbour pose and the pose asked for, in [rad]."""


@wp.struct
class Hand:
    position: wp.vec3d
    rotation: wp.mat33d
    axes: mat73d
    """Unit axis of each joint in the base frame."""
    origins: mat73d
    """A point on each axis in the base frame, in [m]."""


@wp.func
def hand_of(chain: Chain, q: vec7d) -> Hand:
    hand = Hand()
    x = wp.vec3d(ONE, ZERO, ZERO)
    y = wp.vec3d(ZERO, ONE, ZERO)
    z = wp.vec3d(ZERO, ZERO, ONE)
    p = wp.vec3d(ZERO, ZERO, chain.shoulder_height)
    for j in range(7):
        hand.origins[j] = p
        angle = AXIS_SIGNS[j] * q[j]
        c = wp.cos(angle)
        s = wp.sin(angle)
        if j % 2 == 1:
            hand.axes[j] = AXIS_SIGNS[j] * y
            turned = c * x - s * z
            z = s * x + c * z
            x = turned
        else:
            hand.axes[j] = z
            turned = c * x + s * y
            y = c * y - s * x
            x = turned
        if j == 2:
            p += chain.upper_arm * z
        if j == 4:
            p += chain.forearm * z
    hand.position = p + chain.hand * z
    hand.rotation = wp.matrix_from_cols(x, y, z)
    return hand


@wp.func
def rotation_vector(rotation: wp.mat33d) -> wp.vec3d:
    """Axis times angle of a rotation, in [rad]."""
    sine = HALF * wp.vec3d(
        rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]
    )
    length = wp.length(sine)
    vector = sine
    if length > wp.float64(1.0e-12):
        cosine = HALF * (rotation[0, 0] + rotation[1, 1] + rotation[2, 2] - ONE)
        vector = sine * (wp.atan2(length, cosine) / length)
    return vector


@wp.func
def pose_ratios(hand: Hand, position: wp.vec3d, rotation: wp.mat33d, allowed: Allowed) -> wp.vec2d:
    """Distance and angle to a pose, each as a share of what is allowed."""
    turn = rotation_vector(rotation * wp.transpose(hand.rotation))
    return wp.vec2d(wp.length(position - hand.position) / allowed.distance, wp.length(turn) / allowed.angle)


@wp.func
def solved(matrix: mat77d, right: vec7d) -> vec7d:
    """The solution of a symmetric positive definite system, by Cholesky's method."""
    lower = mat77d()
    for i in range(7):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= lower[i, k] * lower[j, k]
            if i == j:
                lower[i, j] = wp.sqrt(total)
            else:
                lower[i, j] = total / lower[j, j]
    for i in range(7):
        total = right[i]
        for k in range(i):
            total -= lower[i, k] * right[k]
        right[i] = total / lower[i, i]
    for back in range(7):
        i = 6 - back
        total = right[i]
        for k in range(i + 1, 7):
            total -= lower[k, i] * right[k]
        right[i] = total / lower[i, i]
    return right


@wp.func
def beyond(vector: wp.vec3d, radius: wp.float64) -> wp.vec3d:
    """The part of a vector that lies outside a ball about the origin."""
    length = wp.length(vector)
    part = vector
    if radius > ZERO:
        part = vector * (wp.max(length - radius, ZERO) / wp.max(length, radius))
    return part


@wp.func
def curvature(part: wp.vec3d, radius: wp.float64) -> wp.mat33d:
    """A square root of the Hessian of |beyond(v, radius)|^2 / 2, from that part of the vector v."""
    length = wp.length(part)
    root = wp.identity(n=3, dtype=wp.float64)
    if radius > ZERO:
        root = wp.mat33d()
        if length > ZERO:
            along = part / length
            across = wp.sqrt(length / (length + radius))
            root = across * wp.identity(n=3, dtype=wp.float64) + (ONE - across) * wp.outer(along, along)
    return root


@wp.func
def descended(
    chain: Chain,
    q: vec7d,
    position: wp.vec3d,
    rotation: wp.mat33d,
    allowed: Allowed,
    radius: wp.float64,
    iterations: int,
) -> vec7d:
    """Joint angles within their limits that locally minimise how far the two ratios exceed a radius.

    The cost is max(|dp| / a - radius, 0)^2 + max(angle / b - radius, 0)^2: D^2 for radius 0.
    """
    scale_p = ONE / allowed.distance
    scale_r = ONE / allowed.angle
    hand = hand_of(chain, q)
    error_p = beyond(scale_p * (position - hand.position), radius)
    error_r = beyond(scale_r * rotation_vector(rotation * wp.transpose(hand.rotation)), radius)
    cost = wp.length_sq(error_p) + wp.length_sq(error_r)
    damping = wp.float64(1.0e-2)
    running = cost > ZERO
    for _ in range(iterations):
        if running:
            jacobian_p = mat73d()
            jacobian_r = mat73d()
            gradient = vec7d()
            free = vec7d()
            root_p = curvature(error_p, radius)
            root_r = curvature(error_r, radius)
            for j in range(7):
                arm = hand.position - hand.origins[j]
                jacobian_p[j] = scale_p * wp.cross(hand.axes[j], arm)
                jacobian_r[j] = scale_r * hand.axes[j]
                gradient[j] = wp.dot(jacobian_p[j], error_p) + wp.dot(jacobian_r[j], error_r)
                jacobian_p[j] = root_p * jacobian_p[j]
                jacobian_r[j] = root_r * jacobian_r[j]
                free[j] = ONE
                if (q[j] >= chain.limits[j] and gradient[j] > ZERO) or (
                    q[j] <= -chain.limits[j] and gradient[j] < ZERO
                ):
                    free[j] = ZERO
                gradient[j] = free[j] * gradient[j]
            normal = jacobian_p * wp.transpose(jacobian_p) + jacobian_r * wp.transpose(jacobian_r)
            for i in range(7):
                for j in range(7):
                    normal[i, j] = free[i] * free[j] * normal[i, j]
                normal[i, i] = normal[i, i] + damping + (ONE - free[i])
            moved = q + solved(normal, gradient)
            for j in range(7):
                moved[j] = wp.clamp(moved[j], -chain.limits[j], chain.limits[j])
            hand_moved = hand_of(chain, moved)
            moved_p = beyond(scale_p * (position - hand_moved.position), radius)
            moved_r = beyond(scale_r * rotation_vector(rotation * wp.transpose(hand_moved.rotation)), radius)
            cost_moved = wp.length_sq(moved_p) + wp.length_sq(moved_r)
            if cost_moved < cost:
                running = cost - cost_moved > wp.float64(1.0e-9) * cost
                q = moved
                hand = hand_moved
                error_p = moved_p
                error_r = moved_r
                cost = cost_moved
                damping = damping * wp.float64(0.1)
            else:
                damping = damping * wp.float64(10.0)
                running = damping < wp.float64(1.0e8)
    return q


@wp.struct
class Neighbour:
    distance: wp.float64
    """The distance D of the best pose found, 1e30 where none is allowed."""
    q: vec7d


@wp.func
def least_violating(chain: Chain, circle: ElbowCircle, configuration: int) -> vec7d:
    """The angles of a configuration on the circle that break the limits least, put on the limits."""
    best = vec7d()
    best_violation = wp.float64(1.0e30)
    for k in range(ARM_ANGLES):
        psi = wp.float64(k) * ARM_ANGLE_STEP
        c = wp.cos(psi)
        s = wp.sin(psi)
        q = unlimited_angles(circle, evaluate(circle, c, s), c, s, configuration)
        violation = wp.float64(0.0)
        for j in range(7):
            within = wp.clamp(q[j], -chain.limits[j], chain.limits[j])
            violation += (q[j] - within) * (q[j] - within)
            q[j] = within
        if violation < best_violation:
            best_violation = violation
            best = q
    return best


@wp.func
def nearest_neighbour(
    chain: Chain, circle: ElbowCircle, position: wp.vec3d, rotation: wp.mat33d, allowed: Allowed
) -> Neighbour:
    """The nearest pose within the allowed distance and angle, and joint angles that reach it."""
    best = Neighbour()
    best.distance = wp.float64(1.0e30)
    for configuration in range(8):
        q = descended(
            chain,
            least_violating(chain, circle, configuration),
            position,
            rotation,
            allowed,
            ZERO,
            ITERATIONS,
        )
        ratios = pose_ratios(hand_of(chain, q), position, rotation, allowed)
        if wp.max(ratios[0], ratios[1]) > ONE and wp.length(ratios) < HOPELESS:
            q = descended(chain, q, position, rotation, allowed, JUST_INSIDE, BOX_ITERATIONS)
            ratios = pose_ratios(hand_of(chain, q), position, rotation, allowed)
        if wp.max(ratios[0], ratios[1]) <= ONE and wp.length(ratios) < best.distance:
            best.distance = wp.length(ratios)
            best.q = q
    return best
