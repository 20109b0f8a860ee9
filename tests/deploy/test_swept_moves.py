"""What lies between the postures that the checks of a move look at: thin zones, thin things, thin leaves."""

import itertools
from typing import Any

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from maniskill_tomato.deploy.collision import OBSTACLE, PATH_ERROR, Box, CollisionChecker, arm_spec
from maniskill_tomato.deploy.interface import ArmState, JointMove
from maniskill_tomato.deploy.motion_bounds import (
    chord_error,
    chords_meet,
    lever_arms,
    motion,
    pieces_for,
    straight_line,
)
from maniskill_tomato.deploy.plant_points import sphere_distances, swept_distances
from maniskill_tomato.deploy.refusals import Refusal
from maniskill_tomato.deploy.safety import Safety
from maniskill_tomato.deploy.safety_config import SafetyConfig
from maniskill_tomato.robot.d435 import T_flange_camera_color_optical
from maniskill_tomato.robot.iiwa14 import EE_ORIGIN, JOINT_AXES, JOINT_ORIGINS, JOINT_UPPER, READY_QPOS

mj: Any = mujoco


def poses(joints: Any) -> Any:
    """T_base_flange by SciPy's rotations, joint after joint. Shape (N, 7) to (N, 4, 4)."""
    T = np.tile(np.eye(4), (len(joints), 1, 1))
    for j, (origin, axis) in enumerate(zip(JOINT_ORIGINS, JOINT_AXES, strict=True)):
        step = np.tile(np.eye(4), (len(joints), 1, 1))
        step[:, :3, :3] = Rotation.from_rotvec(joints[:, j : j + 1] * axis).as_matrix()
        step[:, :3, 3] = origin
        T = T @ step
    T[:, :3, 3] += T[:, :3, :3] @ EE_ORIGIN
    return T


def flange_and_camera(start: Any, goal: Any, samples: int = 2000) -> list[Any]:
    """Their places on the straight line in joint space, so dense that neighbours lie within 0.6 mm."""
    T = poses(straight_line(start, goal, samples))
    flange = T[:, :3, 3]
    ways = [flange, flange + T[:, :3, :3] @ T_flange_camera_color_optical[:3, 3]]
    assert max(np.linalg.norm(np.diff(way, axis=0), axis=1).max() for way in ways) < 6e-4
    return ways


def check(safety: Safety, start: Any, goal: Any, points_w: Any = None) -> Refusal | None:
    state = ArmState(joint_positions=start, joint_velocities=np.zeros(7), stamp=10.0)
    return safety.check(JointMove(joint_positions=goal, speed_fraction=0.1), state, 10.0, points_w=points_w)


def honest_moves(rng: np.random.Generator, least: float = 0.05) -> Any:
    """Random moves that the usual envelope lets through and that take the flange somewhere else."""
    safety = Safety()
    while True:
        start = READY_QPOS + rng.normal(0.0, 0.25, 7)
        goal = start + rng.normal(0.0, 0.2, 7)
        ends = poses(np.stack([start, goal]))[:, :3, 3]
        if np.linalg.norm(ends[1] - ends[0]) > least and check(safety, start, goal) is None:
            yield start, goal


def plate(centre: Any, normal: int, thickness: float, half: float = 0.03) -> Box:
    halves = np.full(3, half)
    halves[normal] = thickness / 2.0
    return Box(low=tuple(centre - halves), high=tuple(centre + halves))


def within(positions: Any, box: Box, margin: float = 0.0) -> bool:
    inside = (positions > np.array(box.low) - margin) & (positions < np.array(box.high) + margin)
    return bool(inside.all(-1).any())


def test_no_plate_that_lies_across_the_way_of_flange_or_camera_is_jumped() -> None:
    rng = np.random.default_rng(17)
    refused = 0
    for k, (start, goal) in enumerate(itertools.islice(honest_moves(rng), 150)):
        way = flange_and_camera(start, goal)[k % 2]
        at = int(rng.integers(100, 1900))
        normal = int(np.abs(way[at + 1] - way[at - 1]).argmax())
        zone = plate(way[at], normal, (0.001, 0.005, 0.0001)[k % 3])
        refusal = check(Safety(SafetyConfig(forbidden=(zone,))), start, goal)
        assert refusal is not None and refusal.reason == "forbidden_zone", (k, zone)
        refused += 1
    assert refused == 150


def test_a_plate_beside_the_way_refuses_nothing() -> None:
    """Zones a few millimetres beside the way, which neither flange nor camera meets by 2,000 samples."""
    rng = np.random.default_rng(18)
    beside = 0
    for start, goal in itertools.islice(honest_moves(rng), 80):
        ways = flange_and_camera(start, goal)
        centre = ways[0][int(rng.integers(2000))] + rng.normal(0.0, 0.03, 3)
        zone = plate(centre, int(rng.integers(3)), 0.001)
        refusal = check(Safety(SafetyConfig(forbidden=(zone,))), start, goal)
        if any(within(way, zone) for way in ways):
            assert refusal is not None and refusal.reason == "forbidden_zone"
        elif not any(within(way, zone, 5e-4) for way in ways):
            assert refusal is None, refusal
            beside += 1
    assert 30 < beside < 80


def test_out_of_a_zone_leads_a_way_and_into_the_next_one_none() -> None:
    start, goal = READY_QPOS, READY_QPOS + [0.3, 0, 0, 0, 0, 0, 0]
    way = flange_and_camera(start, goal)[0]
    here, ahead = plate(way[0], 1, 0.002), plate(way[1000], 1, 0.001)
    assert check(Safety(SafetyConfig(forbidden=(here,))), start, goal) is None
    refusal = check(Safety(SafetyConfig(forbidden=(here, ahead))), start, goal)
    assert refusal is not None and refusal.reason == "forbidden_zone"
    refusal = check(Safety(SafetyConfig(forbidden=(here,))), start, start)
    assert refusal is not None and refusal.reason == "forbidden_zone", "there it may not stay"
    deep = Box(low=tuple(way[0] - 0.1), high=tuple(way[0] + 0.1))
    refusal = check(Safety(SafetyConfig(forbidden=(deep,))), start, goal)
    assert refusal is not None and refusal.reason == "forbidden_zone", "it must be out of it at once"


def test_no_point_moves_faster_or_leaves_its_chord_farther_than_bounded() -> None:
    rng = np.random.default_rng(3)
    closest = 0.0
    for _ in range(60):
        beyond = rng.normal(0.0, 0.05, 3)
        levers = lever_arms(JOINT_ORIGINS, float(np.linalg.norm(EE_ORIGIN) + np.linalg.norm(beyond)))
        start, goal = rng.uniform(-JOINT_UPPER, JOINT_UPPER, (2, 7))
        goal = start + rng.uniform(0.05, 0.4) * (goal - start)
        T = poses(straight_line(start, goal, 800))
        way = T[:, :3, 3] + T[:, :3, :3] @ beyond
        assert np.linalg.norm(np.diff(way, axis=0), axis=1).sum() <= motion(goal - start, levers)
        pieces = int(rng.choice([1, 2, 4, 8]))
        nodes = way[:: 800 // pieces]
        chords = straight_lines(nodes, 800 // pieces)
        off = float(np.linalg.norm(way - chords, axis=1).max())
        bound = chord_error(goal - start, levers, pieces)
        assert off <= bound
        closest = max(closest, off / bound)
        enough = pieces_for(goal - start, levers, 1e-3)
        assert chord_error(goal - start, levers, enough) <= 1e-3
    assert closest > 0.2, "a bound that is never approached says nothing"


def straight_lines(nodes: Any, pieces: int) -> Any:
    parts = [straight_line(a, b, pieces)[:-1] for a, b in itertools.pairwise(nodes)]
    return np.concatenate([*parts, nodes[-1:]])


def test_a_chord_meets_a_box_if_some_point_of_it_lies_inside() -> None:
    rng = np.random.default_rng(4)
    met = 0
    for _ in range(400):
        points = rng.uniform(-1.0, 1.0, (2, 3))
        if rng.random() < 0.3:
            points[1, rng.integers(3)] = points[0, rng.integers(3)]
        low = rng.uniform(-1.0, 0.5, 3)
        high = low + rng.uniform(0.2, 1.2, 3)
        dense = straight_line(points[0], points[1], 4000)
        depth = np.minimum(dense - low, high - dense).min(-1).max()
        if abs(depth) > 1e-3:
            assert bool(chords_meet(points, low, high)[0]) == (depth > 0.0)
            met += int(depth > 0.0)
    assert 30 < met < 370
    still = np.zeros((2, 3))
    assert (
        chords_meet(still, np.full(3, -1.0), np.ones(3))[0]
        and not chords_meet(still, np.ones(3), np.full(3, 2.0))[0]
    )


@pytest.mark.parametrize("thickness", [0.001, 0.005])
def test_no_thin_thing_is_passed_by_any_part_of_the_arm(thickness: float) -> None:
    """Against plain MuJoCo at 600 postures of a way: what would touch is refused, what stays clear is not."""
    rng = np.random.default_rng(6)
    touched = cleared = 0
    for start, goal in itertools.islice(honest_moves(rng), 12):
        way = flange_and_camera(start, goal)[1]
        wall = plate(
            way[int(rng.integers(2000))] + rng.normal(0.0, 0.08, 3), int(rng.integers(3)), thickness, 0.05
        )
        least = smallest_distance(start, goal, wall)
        checker = CollisionChecker(obstacles=(wall,), obstacle_clearance=0.01, table_clearance=0.01)
        if smallest_distance(start, start, wall) < 0.01:
            continue
        contact = checker.along(start, goal, 0.02)
        if least < 0.01 - PATH_ERROR:
            assert contact is not None and contact.second == f"{OBSTACLE} 0"
            touched += 1
        elif least > 0.01 + PATH_ERROR:
            assert contact is None
            cleared += 1
    assert touched > 1 and cleared > 1


def smallest_distance(start: Any, goal: Any, wall: Box) -> float:
    """Between the arm and the wall along the way, as plain MuJoCo measures it, up to 0.05 m."""
    model = arm_spec(-1.0, (wall,), T_flange_camera_color_optical).compile()
    model.geom_margin[:] = 0.05
    data = mj.MjData(model)
    thing = model.geom(f"{OBSTACLE} 0").id
    least = 0.05
    for joints in straight_line(start, goal, 600):
        data.qpos[:] = joints
        mj.mj_kinematics(model, data)
        mj.mj_collision(model, data)
        with_it = (np.array(data.contact.geom).reshape(-1, 2) == thing).any(axis=1)
        least = min(least, float(np.array(data.contact.dist)[with_it].min(initial=0.05)))
    return least


def test_what_is_too_near_already_may_be_left_but_not_approached() -> None:
    start = READY_QPOS
    camera = flange_and_camera(start, start + 1e-6)[1][0]
    wall = Box(low=tuple(camera + [0.03, -0.5, -0.5]), high=tuple(camera + [0.031, 0.5, 0.5]))
    checker = CollisionChecker(obstacles=(wall,), obstacle_clearance=0.05)
    assert checker.nearest(start[None]) is not None
    back, on = np.zeros(7), np.zeros(7)
    back[1], on[1] = -0.1, 0.1
    assert checker.along(start, start + back, 0.1) is None
    contact = checker.along(start, start + on, 0.1)
    assert contact is not None and contact.share < 0.05
    contact = checker.along(start, start + back, 0.005)
    assert contact is not None and contact.share == pytest.approx(0.05), "it must be clear soon"


def test_the_plant_is_looked_for_all_along_the_way() -> None:
    """Points on the way of the spheres, against postures so dense that spheres move by less than 1 mm between them."""
    rng = np.random.default_rng(8)
    mount = T_flange_camera_color_optical
    between = 0
    for start, goal in itertools.islice(honest_moves(rng), 12):
        way = flange_and_camera(start, goal)[1]
        points = way[rng.integers(0, 2001, 300)] + rng.normal(0.0, 0.05, (300, 3))
        found = swept_distances(start, goal, points, 0.0, mount)
        dense = sphere_distances(straight_line(start, goal, 1500), points, mount).min(axis=0)
        assert (found >= dense - 2e-4).all()
        assert (found[dense < -1e-3] < 0.0).all()
        ends = sphere_distances(np.stack([start, goal]), points, mount).min(axis=0)
        between += int(((dense < 0.0) & (ends > 0.0)).sum())
    assert between > 50
