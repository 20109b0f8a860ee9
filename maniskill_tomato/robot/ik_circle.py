# mypy: ignore-errors
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false
# pyright: reportGeneralTypeIssues=false, reportIndexIssue=false, reportInvalidTypeForm=false
# pyright: reportOperatorIssue=false, reportReturnType=false
# The type checkers are silent here: Warp's stubs describe calls from outside, not the inside of a kernel.
"""The elbow circle: every joint angle as a function of one arm angle, and which of them keep the limits.

With the wrist and the elbow angle q4 fixed, the elbow can still turn on a circle about the line from
shoulder to wrist; the arm angle psi says where it stands. With e the unit vector of that line, n and m
completing it to a right-handed frame (e, n, m), and

    u(psi) = n cos(psi) + m sin(psi)          from the line towards the elbow,
    v(psi) = e x u = m cos(psi) - n sin(psi)  the elbow's axis,

the axes of link frame 3 are x3 = cos(g) u - sin(g) e, y3 = v, z3 = cos(g) e + sin(g) u, where g is the
angle at the shoulder between line and upper arm, and those of frame 4 are x4 = cos(d) u + sin(d) e, y4 = v,
z4 = cos(d) e - sin(d) u, where d = q4 - g is the angle at the wrist. With the hand's axes X, Y, Z

    q1 = atan2(z3.y, z3.x)   q2 = acos(z3.z)     q3 = atan2(v.z, -x3.z)
    q5 = atan2(v.Z, x4.Z)    q6 = acos(z4.Z)     q7 = atan2(z4.Y, -z4.X)

for q2, q4, q6 >= 0 (the idea of M. Shimizu et al., IEEE Trans. Robotics 24(5), 2008, in other variables).
All ten arguments have the form a cos(psi) + b sin(psi) + c, the rows of `ElbowCircle.terms`.

The arm takes each elbow position in eight ways: changing the sign of q2 turns q1 and q3 by pi, of q4
turns q3 and q5, of q6 turns q5 and q7. A configuration is an integer of three bits, one per changed sign
(1: q2, 2: q4, 4: q6); a set of configurations is an integer of eight bits.
"""

import warp as wp

from maniskill_tomato.robot.ik_chain import (
    HALF,
    ONE,
    PI,
    TWO,
    TWO_PI,
    ZERO,
    Chain,
    column,
    vec7d,
)

wp.set_module_options({"enable_backward": False})

terms_type = wp.types.matrix(shape=(10, 3), dtype=wp.float64)
values_type = wp.types.vector(length=10, dtype=wp.float64)

Q1_Y, Q1_X = wp.constant(0), wp.constant(1)
Q3_Y, Q3_X = wp.constant(2), wp.constant(3)
Q5_Y, Q5_X = wp.constant(4), wp.constant(5)
Q7_Y, Q7_X = wp.constant(6), wp.constant(7)
Q2_COS, Q6_COS = wp.constant(8), wp.constant(9)

FLIPPED_1 = wp.constant(0b10101010)
"""Configurations in which q1 is turned by pi; likewise below."""
FLIPPED_3 = wp.constant(0b01100110)
FLIPPED_5 = wp.constant(0b00111100)
FLIPPED_7 = wp.constant(0b11110000)
ALL_CONFIGURATIONS = wp.constant(0b11111111)


@wp.struct
class ElbowCircle:
    reachable: wp.int32
    """1 where the wrist is neither too far from the shoulder nor too near to it, else 0."""
    q4: wp.float64
    """The elbow angle, not negative, in [rad]."""
    terms: terms_type
    """Rows (a, b, c) of the functions a cos(psi) + b sin(psi) + c, named by `Q1_Y` ... `Q6_COS`."""
    shoulder_sum: wp.mat22d
    """Rows (a, b) of sine and cosine of q1 + q3, both times 1 + cos(q2)."""
    shoulder_sum_offset: wp.vec2d
    wrist_sum: wp.mat22d
    """Rows (a, b) of sine and cosine of q5 + q7, both times 1 + cos(q6)."""
    wrist_sum_offset: wp.vec2d


@wp.func
def wrap(angle: wp.float64) -> wp.float64:
    """The same angle within [-pi, pi], for one not farther than three turns off."""
    return angle - TWO_PI * wp.round(angle / TWO_PI)


@wp.func
def elbow_axis(q: vec7d) -> wp.vec3d:
    """The axis v of the elbow circle's point at which a configuration of the arm stands."""
    s1 = wp.sin(q[0])
    c1 = wp.cos(q[0])
    s3 = wp.sin(q[2])
    c3 = wp.cos(q[2])
    c2 = wp.cos(q[1])
    axis = wp.vec3d(-c1 * c2 * s3 - s1 * c3, -s1 * c2 * s3 + c1 * c3, wp.sin(q[1]) * s3)
    if q[3] < ZERO:
        axis = -axis
    return axis


@wp.func
def term(first: wp.vec3d, second: wp.vec3d, constant: wp.vec3d, k: wp.vec3d) -> wp.vec3d:
    return wp.vec3d(wp.dot(first, k), wp.dot(second, k), wp.dot(constant, k))


@wp.func
def elbow_circle(
    chain: Chain,
    p: wp.vec3d,
    rotation: wp.mat33d,
    q_ref: vec7d,
    tolerance: wp.float64,
    stretch: wp.float64,
) -> ElbowCircle:
    """The circle for a pose of the hand, with psi = 0 where the elbow of the reference stands.

    Args:
        chain: The arm's.
        p: Position of the end effector, in [m].
        rotation: Its axes in the base frame as columns.
        q_ref: The reference, in [rad].
        tolerance: How far outside the reachable shell the wrist may lie, in [m]; it is moved onto it.
        stretch: How near to full reach the wrist must be for the arm to count as stretched, in [m]. There an error
            of the distance grows to its square root in q4, and from there in q2 and q6, which may be at limits.
    """
    circle = ElbowCircle()
    upper_arm = chain.upper_arm
    forearm = chain.forearm
    x = column(rotation, 0)
    y = column(rotation, 1)
    z = column(rotation, 2)
    to_wrist = p - chain.hand * z - wp.vec3d(ZERO, ZERO, chain.shoulder_height)
    distance = wp.length(to_wrist)
    if distance > chain.largest_reach + tolerance or distance < chain.smallest_reach - tolerance:
        return circle
    circle.reachable = 1
    # The half-angle form keeps its digits near the stretched arm, where acos loses half of them.
    far = wp.float64(0.0)
    if distance < chain.largest_reach - stretch:
        far = chain.largest_reach * chain.largest_reach - distance * distance
    near = distance * distance - (upper_arm - forearm) * (upper_arm - forearm)
    q4 = wp.min(TWO * wp.atan2(wp.sqrt(far), wp.sqrt(near)), chain.limits[3])
    circle.q4 = q4
    span = wp.sqrt(upper_arm * upper_arm + forearm * forearm + TWO * upper_arm * forearm * wp.cos(q4))
    sg = forearm * wp.sin(q4) / span
    cg = (upper_arm + forearm * wp.cos(q4)) / span
    sd = upper_arm * wp.sin(q4) / span
    cd = (forearm + upper_arm * wp.cos(q4)) / span

    e = to_wrist / distance
    axis = elbow_axis(q_ref)
    m = axis - wp.dot(axis, e) * e
    if wp.length(m) < wp.float64(1.0e-6):
        other = wp.vec3d(ZERO, ONE, ZERO)
        if wp.abs(e[1]) > wp.float64(0.9):
            other = wp.vec3d(ONE, ZERO, ZERO)
        m = other - wp.dot(other, e) * e
    m = wp.normalize(m)
    n = wp.cross(m, e)

    zero = wp.vec3d(ZERO, ZERO, ZERO)
    base_x = wp.vec3d(ONE, ZERO, ZERO)
    base_y = wp.vec3d(ZERO, ONE, ZERO)
    base_z = wp.vec3d(ZERO, ZERO, ONE)
    circle.terms[Q1_Y] = term(sg * n, sg * m, cg * e, base_y)
    circle.terms[Q1_X] = term(sg * n, sg * m, cg * e, base_x)
    circle.terms[Q2_COS] = term(sg * n, sg * m, cg * e, base_z)
    circle.terms[Q3_Y] = term(m, -n, zero, base_z)
    circle.terms[Q3_X] = term(-cg * n, -cg * m, sg * e, base_z)
    circle.terms[Q5_Y] = term(m, -n, zero, z)
    circle.terms[Q5_X] = term(cd * n, cd * m, sd * e, z)
    circle.terms[Q6_COS] = term(-sd * n, -sd * m, cd * e, z)
    circle.terms[Q7_Y] = term(-sd * n, -sd * m, cd * e, y)
    circle.terms[Q7_X] = term(sd * n, sd * m, -cd * e, x)

    # x3.y - v.x = (1 + cos(q2)) sin(q1 + q3), x3.x + v.y = (1 + cos(q2)) cos(q1 + q3); the wrist likewise.
    circle.shoulder_sum = wp.mat22d(cg * n[1] - m[0], cg * m[1] + n[0], cg * n[0] + m[1], cg * m[0] - n[1])
    circle.shoulder_sum_offset = wp.vec2d(-sg * e[1], -sg * e[0])
    circle.wrist_sum = wp.mat22d(
        wp.dot(m, x) - cd * wp.dot(n, y),
        -wp.dot(n, x) - cd * wp.dot(m, y),
        cd * wp.dot(n, x) + wp.dot(m, y),
        cd * wp.dot(m, x) - wp.dot(n, y),
    )
    circle.wrist_sum_offset = wp.vec2d(-sd * wp.dot(e, y), sd * wp.dot(e, x))
    return circle


@wp.func
def evaluate(circle: ElbowCircle, c: wp.float64, s: wp.float64) -> values_type:
    """The ten functions at the arm angle with this cosine and sine."""
    return circle.terms * wp.vec3d(c, s, ONE)


@wp.func
def within_limit(y: wp.float64, x: wp.float64, limit: wp.float64, flipped: int, tolerance: wp.float64) -> int:
    """The configurations that atan2(y, x), turned by pi in the `flipped` ones, leaves within the limit.

    Whatever lies outside by no more than `tolerance`, measured on (x, y), counts as within; near the joint's
    singularity (x = y = 0) all do.
    """
    across = wp.abs(y) * wp.cos(PI - limit)
    along = x * wp.sin(PI - limit)
    allowed = ALL_CONFIGURATIONS
    if -along - across > tolerance:
        allowed = allowed & flipped
    if along - across > tolerance:
        allowed = allowed & (ALL_CONFIGURATIONS - flipped)
    return allowed


@wp.func
def feasible_configurations(chain: Chain, values: values_type, tolerance: wp.float64) -> int:
    """The set of configurations that keep all joint limits."""
    if values[Q2_COS] < chain.cos_limit_2 - tolerance or values[Q6_COS] < chain.cos_limit_6 - tolerance:
        return 0
    return (
        within_limit(values[Q1_Y], values[Q1_X], chain.limits[0], FLIPPED_1, tolerance)
        & within_limit(values[Q3_Y], values[Q3_X], chain.limits[2], FLIPPED_3, tolerance)
        & within_limit(values[Q5_Y], values[Q5_X], chain.limits[4], FLIPPED_5, tolerance)
        & within_limit(values[Q7_Y], values[Q7_X], chain.limits[6], FLIPPED_7, tolerance)
    )


@wp.func
def shared_sum(
    total: wp.float64, ref_a: wp.float64, ref_b: wp.float64, limit_a: wp.float64, limit_b: wp.float64
) -> wp.vec2d:
    """Two angles with the sum `total` (up to full turns), within their limits and nearest to a reference."""
    best = wp.vec2d(ZERO, ZERO)
    best_cost = wp.float64(1.0e30)
    for turn in range(-1, 2):
        goal = total + TWO_PI * wp.float64(turn)
        low = wp.max(-limit_a, goal - limit_b)
        high = wp.min(limit_a, goal + limit_b)
        if low <= high:
            a = wp.clamp(ref_a + HALF * (goal - ref_a - ref_b), low, high)
            b = goal - a
            cost = (a - ref_a) * (a - ref_a) + (b - ref_b) * (b - ref_b)
            if cost < best_cost:
                best_cost = cost
                best = wp.vec2d(a, b)
    return best


@wp.func
def limited_pair(a: wp.float64, b: wp.float64, limit_a: wp.float64, limit_b: wp.float64) -> wp.vec2d:
    """Two angles put on their limits if beyond, the one taking over what the other is short of."""
    first = wp.clamp(a, -limit_a, limit_a)
    second = wp.clamp(b + a - first, -limit_b, limit_b)
    return wp.vec2d(wp.clamp(a + b - second, -limit_a, limit_a), second)


@wp.func
def unlimited_angles(
    circle: ElbowCircle, values: values_type, c: wp.float64, s: wp.float64, configuration: int
) -> vec7d:
    """The joint angles at the arm angle with this cosine and sine, whether within the limits or not.

    q3 and q7 come from the sums q1 + q3 and q5 + q7, which keep their digits where q2 or q6 is near zero and the
    two angles of a sum lose them.
    """
    sign_2 = wp.float64(1 - 2 * (configuration & 1))
    sign_4 = wp.float64(1 - (configuration & 2))
    sign_6 = wp.float64(1 - ((configuration >> 1) & 2))
    at = wp.vec2d(c, s)
    shoulder = sign_4 * (circle.shoulder_sum * at + circle.shoulder_sum_offset)
    wrist = sign_4 * (circle.wrist_sum * at + circle.wrist_sum_offset)
    q = vec7d()
    q[0] = wp.atan2(sign_2 * values[Q1_Y], sign_2 * values[Q1_X])
    q[1] = sign_2 * wp.atan2(
        wp.sqrt(values[Q1_Y] * values[Q1_Y] + values[Q1_X] * values[Q1_X]), values[Q2_COS]
    )
    q[2] = wrap(wp.atan2(shoulder[0], shoulder[1]) - q[0])
    q[3] = sign_4 * circle.q4
    q[4] = wp.atan2(sign_4 * sign_6 * values[Q5_Y], sign_4 * sign_6 * values[Q5_X])
    q[5] = sign_6 * wp.atan2(
        wp.sqrt(values[Q5_Y] * values[Q5_Y] + values[Q5_X] * values[Q5_X]), values[Q6_COS]
    )
    q[6] = wrap(wp.atan2(wrist[0], wrist[1]) - q[4])
    return q


@wp.func
def joint_angles(
    chain: Chain,
    circle: ElbowCircle,
    values: values_type,
    c: wp.float64,
    s: wp.float64,
    configuration: int,
    q_ref: vec7d,
    tolerance: wp.float64,
) -> vec7d:
    """The joint angles at a feasible arm angle, with what the tolerance let through put on the limits.

    Where q2 = 0 only q1 + q3 is defined, where q6 = 0 only q5 + q7: they are shared out as near to the
    reference as the limits allow.
    """
    q = unlimited_angles(circle, values, c, s, configuration)
    shoulder = limited_pair(q[0], q[2], chain.limits[0], chain.limits[2])
    if wp.abs(values[Q1_Y]) + wp.abs(values[Q1_X]) <= tolerance:
        shoulder = shared_sum(wrap(q[0] + q[2]), q_ref[0], q_ref[2], chain.limits[0], chain.limits[2])
    wrist = limited_pair(q[4], q[6], chain.limits[4], chain.limits[6])
    if wp.abs(values[Q5_Y]) + wp.abs(values[Q5_X]) <= tolerance:
        wrist = shared_sum(wrap(q[4] + q[6]), q_ref[4], q_ref[6], chain.limits[4], chain.limits[6])
    q = vec7d(shoulder[0], q[1], shoulder[1], q[3], wrist[0], q[5], wrist[1])
    for j in range(7):
        q[j] = wp.clamp(q[j], -chain.limits[j], chain.limits[j])
    return q
