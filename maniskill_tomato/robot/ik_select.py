# mypy: ignore-errors
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false
# pyright: reportGeneralTypeIssues=false, reportIndexIssue=false, reportInvalidTypeForm=false
# pyright: reportOperatorIssue=false, reportReturnType=false
# The type checkers are silent here: Warp's stubs describe calls from outside, not the inside of a kernel.
"""The best arm angle: exact feasible intervals of the elbow circle, then the cheapest point in them.

A joint limit can only be met or left where one of the functions of `ik_circle` takes the limit's value, and
each does so at two arm angles at most: 18 equations of the form a cos(psi) + b sin(psi) + c = 0. Between two
neighbouring roots the set of feasible configurations does not change, so that testing one point of each
interval, and the roots themselves for intervals that have shrunk to a point, decides reachability exactly.

Among the feasible joint angles the one with the least

    sum_i (q_i - q_ref_i)^2 + w sum_i max(0, (|q_i| - (limit_i - margin)) / margin)^2

is wanted, in rad^2. It is searched on a grid of 15 degrees within the intervals, at psi = 0 (the
reference's own elbow position) and where q2 or q6 is closest to zero, then refined by Brent's method over 15
degrees to both sides, as far as the configuration stays feasible.
"""

import math

import warp as wp

from maniskill_tomato.robot.ik_chain import HALF, ONE, PI, TWO, TWO_PI, ZERO, Chain, vec7d
from maniskill_tomato.robot.ik_circle import (
    Q1_X,
    Q1_Y,
    Q2_COS,
    Q3_X,
    Q3_Y,
    Q5_X,
    Q5_Y,
    Q6_COS,
    Q7_X,
    Q7_Y,
    ElbowCircle,
    evaluate,
    feasible_configurations,
    joint_angles,
    values_type,
    wrap,
)

wp.set_module_options({"enable_backward": False})

BREAKS = wp.constant(23)
breaks_type = wp.types.vector(length=23, dtype=wp.float64)
sets_type = wp.types.vector(length=23, dtype=wp.int32)

SPACING = wp.constant(wp.float64(math.radians(15.0)))
GOLDEN = wp.constant(wp.float64(0.5 * (3.0 - math.sqrt(5.0))))
NO_COST = wp.constant(wp.float64(1.0e30))


@wp.struct
class Weights:
    margin: wp.float64
    """Distance from a joint limit at which it begins to cost, in [rad]."""
    limit_weight: wp.float64
    """Cost of a joint that stands at its limit, in [rad^2]."""


@wp.struct
class ArmAngle:
    cost: wp.float64
    """Least cost found, `NO_COST` where nothing is feasible."""
    psi: wp.float64
    """Arm angle, in [rad]."""
    configuration: wp.int32
    low: wp.float64
    """Lower end of the range of arm angles around `psi` in which a cheaper one may lie, in [rad]."""
    high: wp.float64


@wp.func
def joint_cost(chain: Chain, j: int, q: wp.float64, ref: wp.float64, weights: Weights) -> wp.float64:
    excess = wp.max(wp.abs(q) - chain.limits[j] + weights.margin, ZERO) / weights.margin
    return (q - ref) * (q - ref) + weights.limit_weight * excess * excess


@wp.func
def cost_of(chain: Chain, q: vec7d, q_ref: vec7d, weights: Weights) -> wp.float64:
    total = wp.float64(0.0)
    for j in range(7):
        total += joint_cost(chain, j, q[j], q_ref[j], weights)
    return total


@wp.func
def two_costs(
    chain: Chain, j: int, y: wp.float64, x: wp.float64, ref: wp.float64, weights: Weights
) -> wp.vec2d:
    """The costs of a joint at atan2(y, x) and turned by pi from there."""
    angle = wp.atan2(y, x)
    turned = angle + PI
    if angle > ZERO:
        turned = angle - PI
    return wp.vec2d(joint_cost(chain, j, angle, ref, weights), joint_cost(chain, j, turned, ref, weights))


@wp.func
def cheapest_configuration(
    chain: Chain,
    circle: ElbowCircle,
    c: wp.float64,
    s: wp.float64,
    values: values_type,
    feasible: int,
    q_ref: vec7d,
    weights: Weights,
    tolerance: wp.float64,
) -> ArmAngle:
    """The best of a set of configurations at one arm angle."""
    best = ArmAngle()
    best.cost = NO_COST
    r2 = wp.sqrt(values[Q1_Y] * values[Q1_Y] + values[Q1_X] * values[Q1_X])
    r6 = wp.sqrt(values[Q5_Y] * values[Q5_Y] + values[Q5_X] * values[Q5_X])
    singular = r2 <= tolerance or r6 <= tolerance
    q2 = wp.atan2(r2, values[Q2_COS])
    q6 = wp.atan2(r6, values[Q6_COS])
    cost_1 = two_costs(chain, 0, values[Q1_Y], values[Q1_X], q_ref[0], weights)
    cost_3 = two_costs(chain, 2, values[Q3_Y], values[Q3_X], q_ref[2], weights)
    cost_5 = two_costs(chain, 4, values[Q5_Y], values[Q5_X], q_ref[4], weights)
    cost_7 = two_costs(chain, 6, values[Q7_Y], values[Q7_X], q_ref[6], weights)
    cost_2 = wp.vec2d(
        joint_cost(chain, 1, q2, q_ref[1], weights), joint_cost(chain, 1, -q2, q_ref[1], weights)
    )
    cost_4 = wp.vec2d(
        joint_cost(chain, 3, circle.q4, q_ref[3], weights),
        joint_cost(chain, 3, -circle.q4, q_ref[3], weights),
    )
    cost_6 = wp.vec2d(
        joint_cost(chain, 5, q6, q_ref[5], weights), joint_cost(chain, 5, -q6, q_ref[5], weights)
    )
    for k in range(8):
        if (feasible >> k) & 1 == 1:
            f2 = k & 1
            f4 = (k >> 1) & 1
            f6 = (k >> 2) & 1
            cost = cost_1[f2] + cost_2[f2] + cost_3[f2 ^ f4] + cost_4[f4]
            cost += cost_5[f4 ^ f6] + cost_6[f6] + cost_7[f6]
            if singular:
                cost = cost_of(
                    chain, joint_angles(chain, circle, values, c, s, k, q_ref, tolerance), q_ref, weights
                )
            if cost < best.cost:
                best.cost = cost
                best.configuration = k
    return best


@wp.func
def add_roots(
    breaks: breaks_type, index: int, a: wp.float64, b: wp.float64, constant: wp.float64
) -> breaks_type:
    """Stores the roots of a cos(psi) + b sin(psi) + constant, or twice where it is nearest to zero."""
    amplitude = wp.sqrt(a * a + b * b)
    half = wp.float64(0.0)
    if amplitude > wp.float64(1.0e-15):
        half = wp.acos(wp.clamp(-constant / amplitude, -ONE, ONE))
    centre = wp.atan2(b, a)
    breaks[index] = wrap(centre - half)
    breaks[index + 1] = wrap(centre + half)
    return breaks


@wp.func
def add_limit_roots(
    breaks: breaks_type, index: int, y: wp.vec3d, x: wp.vec3d, limit: wp.float64
) -> breaks_type:
    """Stores where atan2(y, x) is at a limit, or opposite to one."""
    c = wp.cos(limit)
    s = wp.sin(limit)
    upper = c * y - s * x
    lower = c * y + s * x
    breaks = add_roots(breaks, index, upper[0], upper[1], upper[2])
    return add_roots(breaks, index + 2, lower[0], lower[1], lower[2])


@wp.func
def sorted_breaks(breaks: breaks_type) -> breaks_type:
    for i in range(1, BREAKS):
        value = breaks[i]
        j = int(i)
        while j > 0 and breaks[j - 1] > value:
            breaks[j] = breaks[j - 1]
            j -= 1
        breaks[j] = value
    return breaks


@wp.func
def interval_end(breaks: breaks_type, i: int) -> wp.float64:
    """Where the interval that begins at a break ends, in [rad]."""
    if i < BREAKS - 1:
        return breaks[i + 1]
    return breaks[0] + TWO_PI


@wp.func
def with_range(point: ArmAngle, breaks: breaks_type, feasible_after: sets_type) -> ArmAngle:
    """A choice with the arm angles around it, at most `SPACING` away, at which its configuration stays feasible.

    Most breaks end nothing: they are limits of other configurations, or where the reference's elbow stands.
    """
    point.low = point.psi - SPACING
    point.high = point.psi + SPACING
    for i in range(BREAKS):
        end = interval_end(breaks, i)
        if end > breaks[i] and (feasible_after[i] >> point.configuration) & 1 == 0:
            for turn in range(-1, 2):
                around = wp.float64(turn) * TWO_PI
                if end + around <= point.psi:
                    point.low = wp.max(point.low, end + around)
                if breaks[i] + around >= point.psi:
                    point.high = wp.min(point.high, breaks[i] + around)
    return point


@wp.func
def sampled_choice(
    chain: Chain, circle: ElbowCircle, q_ref: vec7d, weights: Weights, tolerance: wp.float64
) -> ArmAngle:
    """The best feasible point of the grid, with the range around it in which its configuration stays feasible."""
    terms = circle.terms
    breaks = breaks_type()
    breaks = add_limit_roots(breaks, 0, terms[Q1_Y], terms[Q1_X], chain.limits[0])
    breaks = add_limit_roots(breaks, 4, terms[Q3_Y], terms[Q3_X], chain.limits[2])
    breaks = add_limit_roots(breaks, 8, terms[Q5_Y], terms[Q5_X], chain.limits[4])
    breaks = add_limit_roots(breaks, 12, terms[Q7_Y], terms[Q7_X], chain.limits[6])
    breaks = add_roots(breaks, 16, terms[Q2_COS, 0], terms[Q2_COS, 1], terms[Q2_COS, 2] - chain.cos_limit_2)
    breaks = add_roots(breaks, 18, terms[Q6_COS, 0], terms[Q6_COS, 1], terms[Q6_COS, 2] - chain.cos_limit_6)
    straight_2 = wp.atan2(terms[Q2_COS, 1], terms[Q2_COS, 0])
    straight_6 = wp.atan2(terms[Q6_COS, 1], terms[Q6_COS, 0])
    breaks[20] = straight_2
    breaks[21] = straight_6
    breaks[22] = ZERO
    breaks = sorted_breaks(breaks)

    best = ArmAngle()
    best.cost = NO_COST
    feasible_after = sets_type()
    for i in range(BREAKS):
        middle = HALF * (breaks[i] + interval_end(breaks, i))
        feasible_after[i] = feasible_configurations(
            chain, evaluate(circle, wp.cos(middle), wp.sin(middle)), tolerance
        )
    width_before = breaks[0] + TWO_PI - breaks[BREAKS - 1]
    feasible_before = feasible_after[BREAKS - 1]
    for i in range(BREAKS):
        low = breaks[i]
        width = interval_end(breaks, i) - low
        feasible = feasible_after[i]

        # The root itself is only of interest if it is feasible alone, singular or where the reference stands.
        if i == 0 or width_before > ZERO:
            c = wp.cos(low)
            s = wp.sin(low)
            values = evaluate(circle, c, s)
            here = feasible_configurations(chain, values, tolerance)
            if low != ZERO and low != straight_2 and low != straight_6:
                here = here & (255 - (feasible | feasible_before))
            if here != 0:
                point = cheapest_configuration(chain, circle, c, s, values, here, q_ref, weights, tolerance)
                if point.cost < best.cost:
                    point.psi = low
                    best = point
        if feasible != 0 and width > ZERO:
            count = int(width / SPACING) + 1
            step = width / wp.float64(count)
            for k in range(count):
                psi = low + (wp.float64(k) + HALF) * step
                c = wp.cos(psi)
                s = wp.sin(psi)
                values = evaluate(circle, c, s)
                point = cheapest_configuration(
                    chain, circle, c, s, values, feasible, q_ref, weights, tolerance
                )
                if point.cost < best.cost:
                    point.psi = psi
                    best = point
        width_before = width
        feasible_before = feasible
    if best.cost < NO_COST:
        best = with_range(best, breaks, feasible_after)
    return best


@wp.func
def angles_at(
    chain: Chain,
    circle: ElbowCircle,
    psi: wp.float64,
    configuration: int,
    q_ref: vec7d,
    tolerance: wp.float64,
) -> vec7d:
    c = wp.cos(psi)
    s = wp.sin(psi)
    return joint_angles(chain, circle, evaluate(circle, c, s), c, s, configuration, q_ref, tolerance)


@wp.func
def refined_psi(
    chain: Chain,
    circle: ElbowCircle,
    start: ArmAngle,
    q_ref: vec7d,
    weights: Weights,
    tolerance: wp.float64,
) -> wp.float64:
    """The arm angle of least cost near a choice with its configuration: Brent's method, 20 steps at most."""
    a = start.low
    b = start.high
    x = start.psi
    w = x
    v = x
    fx = start.cost
    fw = fx
    fv = fx
    step = wp.float64(0.0)
    before = wp.float64(0.0)
    for _ in range(20):
        middle = HALF * (a + b)
        precision = wp.float64(1.0e-9)
        if wp.abs(x - middle) > TWO * precision - HALF * (b - a):
            golden = wp.bool(True)
            if wp.abs(before) > precision:
                r = (x - w) * (fx - fv)
                t = (x - v) * (fx - fw)
                p = (x - v) * t - (x - w) * r
                t = TWO * (t - r)
                if t > ZERO:
                    p = -p
                t = wp.abs(t)
                if wp.abs(p) < wp.abs(HALF * t * before) and p > t * (a - x) and p < t * (b - x):
                    before = step
                    step = p / t
                    golden = wp.bool(False)
            if golden:
                before = a - x
                if x < middle:
                    before = b - x
                step = GOLDEN * before
            if wp.abs(step) < precision:
                step = wp.sign(step) * precision
            u = x + step
            fu = cost_of(
                chain, angles_at(chain, circle, u, start.configuration, q_ref, tolerance), q_ref, weights
            )
            if fu <= fx:
                if u < x:
                    b = x
                else:
                    a = x
                v = w
                fv = fw
                w = x
                fw = fx
                x = u
                fx = fu
            else:
                if u < x:
                    a = u
                else:
                    b = u
                if fu <= fw or w == x:
                    v = w
                    fv = fw
                    w = u
                    fw = fu
                elif fu <= fv or v == x or v == w:
                    v = u
                    fv = fu
    return x
