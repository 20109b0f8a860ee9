"""The envelope: what is refused and why, and that nothing outside it reaches an arm."""

import math
from dataclasses import FrozenInstanceError, replace
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq

from maniskill_tomato.deploy.clock import SimulatedClock
from maniskill_tomato.deploy.collision import Box, CollisionChecker
from maniskill_tomato.deploy.deploy_errors import DeviceTimeoutError, FaultError, RefusedError, StoppedError
from maniskill_tomato.deploy.guarded_arm import GuardedArm
from maniskill_tomato.deploy.interface import Arm, ArmState, JointMove
from maniskill_tomato.deploy.motion_bounds import joint_path
from maniskill_tomato.deploy.plant_points import sphere_distances
from maniskill_tomato.deploy.refusals import Refusal
from maniskill_tomato.deploy.safety import Safety
from maniskill_tomato.deploy.safety_config import SafetyConfig
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.robot.d435 import T_flange_camera_color_optical
from maniskill_tomato.robot.iiwa14 import IIWA14, JOINT_AXES, JOINT_ORIGINS, JOINT_UPPER, READY_QPOS
from maniskill_tomato.robot.kinematics import forward_kinematics
from maniskill_tomato.robot.robot_description import urdf_path

mj: Any = mujoco


def state(joints: Any = READY_QPOS, stamp: float = 10.0) -> ArmState:
    return ArmState(joint_positions=joints, joint_velocities=np.zeros(7), stamp=stamp)


def move(joints: Any, speed: float = 0.1) -> JointMove:
    return JointMove(joint_positions=joints, speed_fraction=speed)


def turned(**joints: float) -> Any:
    """The ready posture with joints such as `j4` turned by an angle in [rad]."""
    posture = READY_QPOS.copy()
    for name, angle in joints.items():
        posture[int(name[1:]) - 1] += angle
    return posture


@pytest.fixture(scope="module")
def safety() -> Safety:
    return Safety()


def test_a_small_move_in_the_open_goes_through(safety: Safety) -> None:
    assert safety.check(move(turned(j1=0.2, j6=-0.2)), state(), 10.1, 9.0) is None


@pytest.mark.parametrize(
    ("joints", "speed", "now", "frame", "reason"),
    [
        (turned(j1=np.nan), 0.1, 10.1, 9.0, "not_finite"),
        (turned(j1=np.inf), 0.1, 10.1, 9.0, "not_finite"),
        (turned(), np.nan, 10.1, 9.0, "not_finite"),
        (turned(), 0.0, 10.1, 9.0, "speed"),
        (turned(), -0.1, 10.1, 9.0, "speed"),
        (turned(), 0.31, 10.1, 9.0, "speed"),
        (turned(j4=np.deg2rad(-22.0)), 0.1, 10.1, 9.0, "joint_limit"),
        (turned(j1=1.6), 0.1, 10.1, 9.0, "joint_step"),
        (turned(), 0.1, 10.6, 9.0, "stale_state"),
        (turned(), 0.1, 9.9, 9.0, "stale_state"),
        (turned(), 0.1, 10.1, 0.0, "stale_frame"),
        (turned(), 0.1, 10.1, 10.2, "stale_frame"),
        (turned(), 0.1, 10.1, np.nan, "not_finite"),
        (turned(j1=1.4), 0.1, 10.1, 9.0, "flange_step"),
    ],
)
def test_each_check_refuses_with_its_reason(
    safety: Safety, joints: Any, speed: float, now: float, frame: float, reason: str
) -> None:
    if reason == "flange_step":
        safety = Safety(SafetyConfig(max_flange_step=0.1))
    refusal = safety.check(move(joints, speed), state(), now, frame)
    assert refusal is not None and refusal.reason == reason, refusal


def test_what_is_at_its_bound_is_accepted() -> None:
    config = SafetyConfig(max_state_age=0.5, max_frame_age=8.0, speed_fraction=0.25, max_speed_fraction=0.25)
    assert Safety(config).check(move(READY_QPOS), state(), 10.5, 2.5) is None
    assert Safety(config).check(move(READY_QPOS, 0.25), state(), 10.0, 10.0) is None
    config = SafetyConfig(max_joint_step=0.5, max_flange_step=2.0)
    assert Safety(config).check(move(turned(j1=0.5)), state(turned(j1=0.0)), 10.0) is None


def test_ages_count_from_the_stamps_and_are_named() -> None:
    safety = Safety(SafetyConfig(max_frame_age=8.0))
    refusal = safety.check(move(READY_QPOS), state(stamp=2.0), 4.25)
    assert str(refusal) == (
        "stale_state: the arm's state is 2.250 s old, it must be from 0 to 0.5 s: 1.750 s too old; the nearest allowed "
        "is 0.5 s"
    )
    refusal = safety.check(move(READY_QPOS), state(stamp=13.0), 13.0, 2.5)
    assert str(refusal) == (
        "stale_frame: the picture is 10.500 s old, it must be from 0 to 8 s: 2.500 s too old; the nearest allowed is "
        "8 s"
    )
    assert safety.check(move(READY_QPOS), state(stamp=13.0), 13.0, 12.5) is None


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_the_margin_holds_at_both_limits_of_a_joint_and_is_named_in_degrees(sign: float) -> None:
    safety = Safety(SafetyConfig(joint_margin=0.1))
    bound = JOINT_UPPER[2] - 0.1
    goal, start = READY_QPOS.copy(), READY_QPOS.copy()
    goal[2], start[2] = sign * (bound + 0.01), sign * (bound - 0.05)
    refusal = safety.check(move(goal), state(start), 10.0)
    assert refusal is not None and refusal.reason == "joint_limit"
    # Rounded inwards.
    degrees = np.floor(np.rad2deg(bound) * 100) / 100
    assert (
        f"from -{degrees:.2f} to {degrees:.2f} deg, got {sign * np.rad2deg(bound + 0.01):.2f} deg: "
        f"{np.rad2deg(0.01):.2f} deg too far" in refusal.detail
    )


def test_an_arm_outside_the_workspace_may_come_in() -> None:
    goal = turned(j2=0.1)
    way = np.array([plain_flange(joints) for joints in joint_path(READY_QPOS, goal, 0.05)])
    assert (np.diff(way[:, 0]) > 1e-3).all()
    inner = Box(low=(float(way[0, 0]) + 1e-3, -0.9, 0.1), high=(0.9, 0.9, 1.35))
    safety = Safety(SafetyConfig(workspace=inner, leave_within=0.05))
    assert safety.check(move(goal), state(), 10.0) is None
    assert safety.check(move(READY_QPOS), state(goal), 10.0) is not None


def test_the_first_place_outside_and_in_a_zone_is_named() -> None:
    goal = turned(j2=0.14)
    way = np.array([plain_flange(joints) for joints in joint_path(READY_QPOS, goal, 0.001)])
    at = way[60]
    workspace = Box(low=(-0.9, -0.9, 0.0), high=(float(at[0]), 0.9, 1.35))
    refusal = Safety(SafetyConfig(workspace=workspace)).check(move(goal), state(), 10.0)
    assert refusal is not None and refusal.reason == "workspace"
    assert place(refusal.detail) == pytest.approx(at, abs=0.02) and place(refusal.detail)[0] >= at[0]
    zone = Box(low=(float(at[0]), -0.9, 0.0), high=(float(at[0]) + 1e-4, 0.9, 1.35))
    refusal = Safety(SafetyConfig(forbidden=(zone,))).check(move(goal), state(), 10.0)
    assert refusal is not None and refusal.reason == "forbidden_zone" and "flange" in refusal.detail
    assert place(refusal.detail) == pytest.approx(at, abs=0.02)


def place(detail: str) -> Any:
    """The place in a message such as "would be at (0.100, 0.200, 0.300) m"."""
    return np.array([float(v) for v in detail.split("(")[1].split(")")[0].split(",")])


def test_a_contact_is_named_with_its_distance_and_the_share_of_the_move_before_it() -> None:
    goal = turned(j2=0.3)
    ahead = float(plain_flange(READY_QPOS)[0]) + 0.12
    wall = Box(low=(ahead, -1.0, 0.0), high=(ahead + 0.08, 1.0, 2.0))
    safety = Safety(SafetyConfig(obstacles=(wall,), obstacle_clearance=0.02, leave_within=0.003))
    refusal = safety.check(move(goal), state(), 10.0)
    assert refusal is not None and refusal.reason == "obstacle"
    words = refusal.detail.split()
    # Between two samples of the way, 3 mrad apart, no part of the arm moves by more than 4 mm.
    assert 18.0 <= float(words[words.index("mm") - 1]) <= 20.0
    # Less of the same move is free, as much of it is not.
    share = float(words[words.index("after") + 1].rstrip("%")) / 100
    assert 0.1 < share < 0.95
    assert safety.check(move(turned(j2=0.3 * (share - 0.02))), state(), 10.0) is None
    assert safety.check(move(turned(j2=0.3 * (share + 0.02))), state(), 10.0) is not None


@pytest.mark.parametrize("leave_within", [0.005, 0.02, 0.1])
def test_the_share_of_the_move_is_that_of_the_first_posture_in_contact(leave_within: float) -> None:
    start, goal = READY_QPOS, turned(j2=0.5)
    ahead = float(plain_flange(start)[0]) + 0.18
    wall = Box(low=(ahead, -1.0, 0.0), high=(ahead + 0.08, 1.0, 2.0))
    safety = Safety(SafetyConfig(obstacles=(wall,), max_flange_step=1.0, leave_within=leave_within))
    postures = [start + k / 1000 * (goal - start) for k in range(1001)]
    first = next(k for k, posture in enumerate(postures) if safety.stands_in_collision(posture, None))
    assert 200 < first < 800
    refusal = safety.check(move(goal), state(start), 10.0)
    assert refusal is not None and f"after {first / 1000:.0%} of the move" in refusal.detail


@pytest.mark.parametrize("distance", [0.2914, 0.2916])
def test_a_contact_is_measured_in_millimetres(distance: float) -> None:
    """The 0.4 mm are far enough from a half that one thousandth more or less shows."""
    goal = turned(j1=0.01)

    def wall(ahead: float) -> Box:
        return Box(low=(ahead, -1.0, 0.0), high=(ahead + 0.08, 1.0, 2.0))

    def contact(ahead: float) -> float:
        checker = CollisionChecker(obstacles=(wall(ahead),), obstacle_clearance=0.5)
        found = checker.nearest(goal[None])
        assert found is not None and found.second == "obstacle 0"
        return found.distance

    ahead = float(plain_flange(goal)[0]) + 0.3
    ahead += distance - contact(ahead)
    assert contact(ahead) == pytest.approx(distance, abs=2e-5)
    safety = Safety(SafetyConfig(obstacles=(wall(ahead),), obstacle_clearance=0.3))
    refusal = safety.check(move(goal), state(), 10.0)
    assert refusal is not None
    assert f"within {distance * 1e3:.1f} mm of obstacle 0 after 100% of the move" in refusal.detail


def test_an_arm_that_touches_something_may_leave_it_in_one_step_and_not_reach_it_in_one() -> None:
    clear, touching = READY_QPOS, turned(j2=0.09)
    ahead = float(plain_flange(clear)[0]) + 0.09
    wall = Box(low=(ahead, -1.0, 0.0), high=(ahead + 0.08, 1.0, 2.0))
    safety = Safety(SafetyConfig(obstacles=(wall,), obstacle_clearance=0.02, leave_within=0.1))
    assert not safety.stands_in_collision(clear, None)
    assert safety.stands_in_collision(touching, None)
    assert safety.check(move(clear), state(touching), 10.0) is None
    refusal = safety.check(move(touching), state(clear), 10.0)
    assert refusal is not None and refusal.reason == "obstacle"


def test_a_posture_stands_in_collision_with_itself_or_with_enough_points_of_the_plant(safety: Safety) -> None:
    folded = np.deg2rad([0.0, 110.0, 0.0, -120.0, 0.0, 100.0, 0.0])
    assert safety.stands_in_collision(folded, None)
    assert not safety.stands_in_collision(READY_QPOS, None)
    leaf = plain_flange(READY_QPOS) + np.random.default_rng(0).normal(0.0, 0.005, (20, 3))
    assert safety.stands_in_collision(READY_QPOS, leaf)
    assert not safety.stands_in_collision(READY_QPOS, leaf[:3]), "a few points are noise"
    far = leaf + [0.0, 0.0, 0.6]
    assert not safety.stands_in_collision(READY_QPOS, far)
    assert not safety.stands_in_collision(READY_QPOS, np.concatenate([leaf[:3], far]))
    blind = Safety(SafetyConfig(plant_clearance=None))
    assert not blind.stands_in_collision(READY_QPOS, leaf)


def test_a_state_that_is_not_finite_lets_nothing_through(safety: Safety) -> None:
    bad = READY_QPOS.copy()
    bad[2] = np.nan
    refusal = safety.check(move(READY_QPOS), state(bad), 10.0)
    assert refusal is not None and refusal.reason == "not_finite"


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_seen_point_that_is_not_finite_lets_nothing_through(safety: Safety, bad: float) -> None:
    points = np.full((20, 3), 5.0)
    goal = turned(j1=0.1)
    assert safety.check(move(goal), state(), 10.0, points_w=points) is None
    points[7, 1] = bad
    refusal = safety.check(move(goal), state(), 10.0, points_w=points)
    assert refusal is not None and refusal.reason == "not_finite" and "1 of the 20 points" in refusal.detail
    assert safety.stands_in_collision(goal, points)
    blind = Safety(SafetyConfig(plant_clearance=None))
    assert blind.check(move(goal), state(), 10.0, points_w=points) is None, "that does not ask for the plant"


def test_workspace_and_forbidden_zone_hold_on_the_way_too() -> None:
    goal = turned(j1=0.8)
    flange = forward_kinematics(torch.as_tensor(joint_path(READY_QPOS, goal, 0.02)))[:, :3, 3].numpy()
    # The way is an arc about the z axis: its ends are allowed here, its middle is not.
    middle = flange[len(flange) // 2]
    zone = Box(low=tuple(middle - 0.005), high=tuple(middle + 0.005))
    safety = Safety(SafetyConfig(forbidden=(zone,), max_flange_step=1.0))
    refusal = safety.check(move(goal), state(), 10.0)
    assert refusal is not None and refusal.reason == "forbidden_zone"
    # Turning joint 1 from one side to the other, x is largest in the middle.
    start, goal = turned(j1=-0.4), turned(j1=0.4)
    ends = forward_kinematics(torch.as_tensor(np.stack([start, goal])))[:, 0, 3]
    bound = 0.5 * (float(ends[0]) + float(flange[0, 0]))
    narrow = Box(low=(-0.9, -0.9, 0.15), high=(bound, 0.9, 1.35))
    safety = Safety(SafetyConfig(workspace=narrow, forbidden=(), max_flange_step=1.0))
    assert bool((ends < bound).all())
    refusal = safety.check(move(goal), state(start), 10.0)
    assert refusal is not None and refusal.reason == "workspace"


def test_contacts_with_table_itself_and_obstacles_are_refused() -> None:
    low = np.deg2rad([0.0, 40.0, 0.0, -60.0, 0.0, 40.0, 0.0])
    down = np.deg2rad([0.0, 95.0, 0.0, -45.0, 0.0, 40.0, 0.0])
    everywhere = Box(low=(-2.0, -2.0, -2.0), high=(2.0, 2.0, 2.0))
    safety = Safety(
        SafetyConfig(
            workspace=everywhere, max_joint_step=3.0, max_flange_step=3.0, forbidden=(), joint_margin=0.0
        )
    )
    refusal = safety.check(move(down), state(low), 10.0)
    assert refusal is not None and refusal.reason == "table", refusal
    folded = np.deg2rad([0.0, 110.0, 0.0, -120.0, 0.0, 100.0, 0.0])
    high_table = SafetyConfig(
        workspace=everywhere,
        max_joint_step=3.0,
        max_flange_step=3.0,
        forbidden=(),
        joint_margin=0.0,
        table_height=-1.0,
    )
    # A posture that `test_robot_description` knows to collide with the base.
    refusal = Safety(high_table).check(move(folded), state(low), 10.0)
    assert refusal is not None and refusal.reason == "self_collision"
    flange = forward_kinematics(torch.tensor(READY_QPOS[None]))[0, :3, 3].numpy()
    wall = Box(low=(float(flange[0]) + 0.12, -1.0, 0.0), high=(float(flange[0]) + 0.2, 1.0, 2.0))
    safety = Safety(SafetyConfig(obstacles=(wall,), obstacle_clearance=0.02))
    assert safety.check(move(READY_QPOS), state(), 10.0) is None
    refusal = safety.check(move(turned(j2=0.3)), state(), 10.0)
    assert refusal is not None and refusal.reason == "obstacle", refusal


def test_the_plant_that_was_seen_is_kept_clear_of(safety: Safety) -> None:
    goal = turned(j1=0.3)
    on_the_way = forward_kinematics(torch.as_tensor(turned(j1=0.15)[None]))[0].numpy()
    cluster = on_the_way[:3, 3] + np.random.default_rng(0).normal(0.0, 0.005, (20, 3))
    refusal = safety.check(move(goal), state(), 10.0, points_w=cluster)
    assert refusal is not None and refusal.reason == "plant"
    assert safety.check(move(goal), state(), 10.0, points_w=cluster[:3]) is None, "a few points are noise"
    assert safety.check(move(goal), state(), 10.0, points_w=cluster + [0.0, 0.0, 0.5]) is None
    # Out of the leaves it may go: the same points at the start, and the move leads away.
    inside = turned(j1=0.15)
    assert safety.check(move(turned(j1=-0.2)), state(inside), 10.0, points_w=cluster) is None


def test_so_many_points_as_are_needed_refuse_a_move_and_one_less_does_not(safety: Safety) -> None:
    goal = turned(j1=0.3)
    on_the_way = np.repeat(plain_flange(turned(j1=0.15))[None], 20, axis=0)
    far = on_the_way + [0.0, 0.0, 0.6]
    for needed, checked in ((6, safety), (2, Safety(SafetyConfig(plant_points_needed=2)))):
        for count, others in ((needed, 0), (needed, 5), (needed - 1, 0), (needed - 1, 5)):
            points = np.concatenate([on_the_way[:count], far[:others]])
            refusal = checked.check(move(goal), state(), 10.0, points_w=points)
            assert (refusal is not None) == (count == needed), (needed, count, others)
            assert refusal is None or f"{needed} points of the plant" in refusal.detail
            assert checked.stands_in_collision(turned(j1=0.15), points) == (count == needed)


def test_a_plant_that_is_approached_but_not_reached_refuses_nothing(safety: Safety) -> None:
    goal = turned(j2=0.2)
    beyond = np.repeat(plain_flange(turned(j2=0.4))[None], 20, axis=0)
    nearest = sphere_distances(joint_path(READY_QPOS, goal, 0.02), beyond)[:, 0]
    assert (np.diff(nearest) < -1e-3).all() and nearest[-1] > 0.05
    assert safety.check(move(goal), state(), 10.0, points_w=beyond) is None
    near = Safety(SafetyConfig(plant_clearance=float(nearest[-1]) + 1e-3))
    refusal = near.check(move(goal), state(), 10.0, points_w=beyond)
    assert refusal is not None and refusal.reason == "plant"
    # The same at the end of a single step.
    before = joint_path(READY_QPOS, goal, 0.02)[-2]
    once = Safety(replace(near.config, leave_within=0.03))
    refusal = once.check(move(goal), state(before), 10.0, points_w=beyond)
    assert refusal is not None and refusal.reason == "plant"


@pytest.mark.parametrize(("clearance", "distance"), [(0.2994, 0.2914), (0.2996, 0.2916)])
def test_a_plant_is_measured_in_millimetres(clearance: float, distance: float) -> None:
    """The 0.4 mm are far enough from a half that one thousandth more or less shows."""
    goal = turned(j2=0.1)
    way = joint_path(READY_QPOS, goal, 0.02)

    def point(reach: float) -> Any:
        return plain_flange(goal)[None] + [reach, 0.0, 0.0]

    def nearest(reach: float) -> float:
        return float(sphere_distances(way, point(reach))[1:].min())

    reach: Any = brentq(lambda reach: nearest(reach) - distance, 0.2, 0.6)
    points = np.repeat(point(reach), 20, axis=0)
    refusal = Safety(SafetyConfig(plant_clearance=clearance)).check(
        move(goal), state(), 10.0, points_w=points
    )
    assert refusal is not None and refusal.detail == (
        f"20 points of the plant would be nearer than {clearance * 1e3:.1f} mm to the arm's spheres, the nearest "
        f"{distance * 1e3:.1f} mm: {(clearance - distance) * 1e3:.1f} mm too near; fewer than 6 such points are taken "
        "for noise"
    )


def test_the_farthest_place_from_the_start_is_the_flange_step() -> None:
    """Nearly a full turn with a growing radius: the ends are near each other, the farthest place lies between."""
    start, goal = turned(j1=-2.8), turned(j1=2.8, j2=0.3)
    way = np.array([plain_flange(joints) for joints in joint_path(start, goal, 0.002)])
    away = np.linalg.norm(way - way[0], axis=1)
    assert away.max() > away[-1] + 0.1
    everywhere = Box(low=(-2.0, -2.0, -2.0), high=(2.0, 2.0, 2.0))
    config = SafetyConfig(max_joint_step=6.0, workspace=everywhere, forbidden=())
    refusal = Safety(replace(config, max_flange_step=0.1)).check(move(goal), state(start), 10.0)
    assert refusal is not None and refusal.reason == "flange_step"
    assert f"the flange would get {away.max():.4f} m away" in refusal.detail
    for slack, reason in ((1e-4 + 1e-6, None), (-1e-6, "flange_step")):
        bound = replace(config, max_flange_step=float(away.max()) + slack)
        refusal = Safety(bound).check(move(goal), state(start), 10.0)
        assert (refusal and refusal.reason) == reason


def test_a_joint_path_is_a_straight_line_of_the_fewest_steps() -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        start, end = rng.uniform(-2.0, 2.0, (2, 7))
        step = float(rng.uniform(0.02, 1.0))
        path = joint_path(start, end, step)
        count = len(path) - 1
        expected = [start + k / count * (end - start) for k in range(count + 1)]
        np.testing.assert_allclose(path, expected, rtol=0.0, atol=1e-14)
        largest = np.abs(end - start).max()
        assert largest / count <= step and (count == 1 or largest / (count - 1) > step)
    for end in (READY_QPOS, turned(j4=1e-3)):
        np.testing.assert_allclose(joint_path(READY_QPOS, end, 0.02), [READY_QPOS, end], rtol=0.0, atol=1e-14)


def test_the_camera_is_where_the_calibration_puts_it() -> None:
    """A camera 60 mm farther out and turned by 90 degrees: zone, collision shape and spheres go with it."""
    mount = np.array(T_flange_camera_color_optical)
    mount[:3, :3] = mount[:3, :3] @ np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    mount[:3, 3] += [0.0, 0.0, 0.06]
    goal = turned(j1=0.2)
    T = forward_kinematics(torch.as_tensor(goal[None]))[0].numpy() @ mount
    lens = T[:3, 3]
    zone = Box(low=tuple(lens - 0.01), high=tuple(lens + 0.01))
    config = SafetyConfig(forbidden=(zone,))
    assert Safety(config).check(move(goal), state(), 10.0) is None
    refusal = Safety(config, mount).check(move(goal), state(), 10.0)
    assert refusal is not None and refusal.reason == "forbidden_zone" and "camera" in refusal.detail
    # A wall 10 mm before the glass: only the moved housing reaches it.
    ahead = lens + 0.03 * T[:3, 2]
    wall = SafetyConfig(
        obstacles=(Box(low=tuple(ahead - 0.01), high=tuple(ahead + 0.01)),), obstacle_clearance=0.02
    )
    assert Safety(wall).check(move(goal), state(), 10.0) is None
    refusal = Safety(wall, mount).check(move(goal), state(), 10.0)
    assert refusal is not None and refusal.reason == "obstacle" and "camera_link" in refusal.detail
    # The bar is 90 mm long, its middle 32.5 mm right of the colour lens; the spheres hold both ends where it is now.
    ends = np.array(
        [lens + share * T[:3, 0] - 0.008 * T[:3, 2] for share in (0.0325 - 0.044, 0.0325 + 0.044)]
    )
    assert (sphere_distances(goal[None], ends, mount)[0] < 0.0).all()
    assert (sphere_distances(goal[None], ends)[0] > 0.0).all()
    refusal = Safety(None, mount).check(move(goal), state(), 10.0, points_w=np.repeat(lens[None], 20, axis=0))
    assert refusal is not None and refusal.reason == "plant"


def test_sphere_distances_never_exceed_those_of_mujocos_shapes() -> None:
    """The spheres hold every link mesh; MuJoCo's primitives stand out from them by up to 25 mm."""
    spec = mj.MjSpec.from_file(urdf_path())
    spec.worldbody.add_geom(
        name="probe", type=mj.mjtGeom.mjGEOM_SPHERE, size=[1e-4, 0, 0], pos=[0.1, 0.2, 0.3]
    )
    model = spec.compile()
    data = mj.MjData(model)
    probe = model.geom("probe").id
    links = {f"link_{k}" for k in (5, 6, 7)} | {"link_ee", "camera_link"}
    shapes = [g for g in range(model.ngeom) if model.body(model.geom_bodyid[g]).name in links]
    rng = np.random.default_rng(3)
    fromto = np.zeros(6)
    for _ in range(40):
        data.qpos[:] = rng.uniform(-JOINT_UPPER, JOINT_UPPER)
        mj.mj_kinematics(model, data)
        point = data.body("link_ee").xpos + rng.uniform(-0.3, 0.3, 3)
        model.geom_pos[probe] = point
        mj.mj_kinematics(model, data)
        exact = min(mj.mj_geomDistance(model, data, probe, g, 2.0, fromto) for g in shapes)
        ours = float(sphere_distances(np.array(data.qpos)[None], point[None])[0, 0])
        assert ours < exact + 0.025
        assert ours > exact - 0.06


def test_the_collision_checker_sees_what_plain_mujoco_sees() -> None:
    """Random postures: some contact by ours if and only if by the URDF in MuJoCo, with its own filter."""
    model = mj.MjModel.from_xml_path(urdf_path())
    data = mj.MjData(model)
    checker = CollisionChecker(
        table_height=-5.0, table_clearance=0.0, self_clearance=0.0, obstacle_clearance=0.0
    )
    rng = np.random.default_rng(5)
    hits = 0
    for _ in range(1500):
        joints = rng.uniform(-JOINT_UPPER, JOINT_UPPER)
        data.qpos[:] = joints
        mj.mj_kinematics(model, data)
        mj.mj_collision(model, data)
        touching = any(contact.dist < 0.0 for contact in data.contact[: data.ncon])
        assert (checker.nearest(joints[None]) is not None) == touching
        hits += touching
    assert hits > 3


def test_the_safety_configuration_refuses_what_makes_no_sense() -> None:
    cases: tuple[dict[str, Any], ...] = (
        {"speed_fraction": 0.5},
        {"max_speed_fraction": 0.9},
        {"joint_margin": -0.1},
        {"leave_within": 0.5},
        {"plant_points_needed": 0},
        {"speed_fraction": float("nan")},
    )
    for wrong in cases:
        with pytest.raises(InvalidInputError):
            SafetyConfig(**wrong)
    with pytest.raises(InvalidInputError, match="low must lie below high"):
        Box(low=(0.0, 0.0, 0.0), high=(1.0, 0.0, 1.0))
    for far in (math.inf, 1e300, 1.1e4):
        with pytest.raises(InvalidInputError, match="from -10000 to 10000 m"):
            Box(low=(0.9, -far, -far), high=(0.91, far, far))


def test_a_wall_as_large_as_a_box_may_be_keeps_its_distance_to_a_micrometre() -> None:
    posture = turned()[None]
    ahead = float(plain_flange(turned())[0]) + 0.25
    small, large = (
        CollisionChecker(
            obstacles=(Box(low=(ahead, -size, -size), high=(ahead + size, size, size)),),
            obstacle_clearance=0.5,
        ).nearest(posture)
        for size in (1.0, 9999.0)
    )
    assert small is not None and large is not None
    assert small.second == large.second == "obstacle 0"
    assert large.distance == pytest.approx(small.distance, abs=1e-6)


@pytest.mark.parametrize(
    ("name", "accepted", "refused"),
    [
        ("joint_margin", (0.0, 0.5), (-0.01, 0.51)),
        ("table_clearance", (0.0, 0.5), (-0.01, 0.51)),
        ("self_clearance", (0.0, 0.5), (-0.01, 0.51)),
        ("obstacle_clearance", (0.0, 0.5), (-0.01, 0.51)),
        ("plant_clearance", (-0.05, 0.3, None), (-0.06, 0.31)),
        ("max_speed_fraction", (0.1, 0.3), (0.09, 0.31, 0.0)),
        ("leave_within", (1e-6, 0.1), (-1e-6, 0.0, 0.11)),
        ("plant_points_needed", (1, 1000), (0, -1)),
    ],
)
def test_the_numbers_of_the_envelope_have_their_ranges(
    name: str, accepted: tuple[Any, ...], refused: tuple[Any, ...]
) -> None:
    for value in accepted:
        config: dict[str, Any] = {name: value}
        assert getattr(SafetyConfig(**config), name) == value
    for value in refused:
        config = {name: value}
        with pytest.raises(InvalidInputError, match=name):
            SafetyConfig(**config)


def test_the_default_envelope_is_the_documented_one() -> None:
    """The base's zone is |x|, |y| < 0.3 m, z < 0.25 m (Eq. 5-4); the rest is `docs/deploy.md`."""
    config = SafetyConfig()
    assert config.forbidden == (Box(low=(-0.3, -0.3, -1.0), high=(0.3, 0.3, 0.25)),)
    assert config.workspace == Box(low=(-0.9, -0.9, 0.15), high=(0.9, 0.9, 1.35))
    assert (config.speed_fraction, config.max_speed_fraction) == (0.1, 0.3)
    assert (config.joint_margin, config.max_joint_step, config.max_flange_step) == (0.03, 1.5, 0.35)
    assert (config.max_state_age, config.max_frame_age, config.leave_within) == (0.5, 10.0, 0.02)
    assert (config.self_clearance, config.table_clearance, config.obstacle_clearance) == (0.005, 0.03, 0.05)
    assert (config.plant_clearance, config.plant_points_needed) == (0.0, 6)
    assert (config.table_height, config.obstacles, config.arrival_tolerance) == (0.0, (), 0.01)


def test_neither_an_envelope_nor_a_refusal_can_be_changed() -> None:
    with pytest.raises(FrozenInstanceError):
        SafetyConfig().max_joint_step = 9.0  # type: ignore[misc]
    refusal = Refusal(reason="table", detail="too low")
    with pytest.raises(FrozenInstanceError):
        refusal.reason = "plant"  # type: ignore[misc]
    assert str(refusal) == "table: too low"


class SpyArm(Arm):
    """Goes at once where it is sent, and keeps what it was sent."""

    name = "spy"
    model = IIWA14
    simulated = True
    can_stop = True

    def __init__(self, clock: SimulatedClock) -> None:
        self.clock = clock
        self.joints: Any = READY_QPOS.copy()
        self.sent: list[tuple[Any, JointMove]] = []
        self.report: Any = None
        self.arrives = True

    @property
    def is_connected(self) -> bool:
        return True

    def connect(self) -> None: ...

    def disconnect(self) -> None: ...

    def read(self, max_age_s: float = 0.5) -> ArmState:
        joints = self.joints if self.report is None else self.report
        return ArmState(joint_positions=joints, joint_velocities=np.zeros(7), stamp=self.clock.now())

    def command(self, move: JointMove) -> JointMove:
        self.sent.append((self.joints.copy(), move))
        if self.arrives:
            self.joints = np.array(move.joint_positions)
        self.clock.sleep(60.0)
        return move

    def wait(self, timeout_s: float) -> bool:
        self.clock.sleep(timeout_s)
        return self.arrives

    def stop(self) -> bool:
        return True


def plain_flange(joints: Any) -> Any:
    """Flange position by a plain chain of rotation matrices."""
    T = np.eye(4)
    for origin, axis, angle in zip(JOINT_ORIGINS, JOINT_AXES, joints, strict=True):
        x, y, z = axis
        K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        step = np.eye(4)
        step[:3, :3] = np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K
        step[:3, 3] = origin
        T = T @ step
    return (T @ [0.0, 0.0, 0.035, 1.0])[:3]


def assert_inside(start: Any, sent: JointMove, config: SafetyConfig, model: Any, data: Any) -> None:
    """The envelope once more, worked out on its own: plain chain, MuJoCo's own contacts, 40 samples of the way."""
    goal = sent.joint_positions
    assert np.isfinite(goal).all()
    assert (np.abs(goal) <= JOINT_UPPER - config.joint_margin).all()
    assert (np.abs(goal - start) <= config.max_joint_step).all()
    assert 0.0 < sent.speed_fraction <= 0.3
    first = plain_flange(start)
    for share in np.linspace(0.025, 1.0, 40):
        joints = start + share * (goal - start)
        flange = plain_flange(joints)
        slack = 1e-9  # Rounding.
        assert (flange > np.array(config.workspace.low) - slack).all()
        assert (flange < np.array(config.workspace.high) + slack).all()
        assert not (np.abs(flange[:2]) < 0.3 - slack).all() or flange[2] > 0.25 - slack
        assert np.linalg.norm(flange - first) <= config.max_flange_step + slack
        data.qpos[:] = joints
        mj.mj_kinematics(model, data)
        mj.mj_collision(model, data)
        assert all(contact.dist >= 0.0 for contact in data.contact[: data.ncon])


def hostile(rng: np.random.Generator, here: Any) -> JointMove:
    """A command from a broken or malicious policy: wild, near-limit, nearly right, or not numbers at all."""
    kind = rng.integers(7)
    if kind == 0:
        joints = rng.uniform(-4.0, 4.0, 7)
    elif kind == 1:
        joints = rng.choice([-1.0, 1.0], 7) * JOINT_UPPER + rng.normal(0.0, 0.05, 7)
    elif kind == 2:
        joints = here + rng.normal(0.0, 0.8, 7)
    elif kind == 3:
        joints = here + rng.normal(0.0, 0.15, 7)
    elif kind == 4:
        joints = np.where(rng.random(7) < 0.3, rng.choice([np.nan, np.inf, -np.inf, 1e308, -0.0], 7), here)
    elif kind == 5:
        joints = np.rad2deg(here)  # The wrong unit.
    else:
        joints = here.copy()
        joints[rng.integers(7)] += rng.normal(0.0, 1.5)
    speed = rng.choice([0.1, 0.1, 0.3, 0.300001, 0.0, -0.1, 1.0, np.nan, np.inf])
    return move(joints, float(speed))


def attack(seed: int, commands: int) -> tuple[int, int]:
    """Sends hostile commands; how many were refused and sent."""
    config = SafetyConfig()
    clock = SimulatedClock(100.0)
    arm = SpyArm(clock)
    guard = GuardedArm(arm, Safety(config), clock)
    rng = np.random.default_rng(seed)
    refused = 0
    for _ in range(commands):
        frame = clock.now() - float(
            rng.choice([0.1, 1.0, 11.0, -1.0, np.nan], p=[0.7, 0.2, 0.04, 0.03, 0.03])
        )
        try:
            guard.command(hostile(rng, arm.joints), frame)
            assert guard.wait(0.1)
        except RefusedError:
            refused += 1
    model = mj.MjModel.from_xml_path(urdf_path())
    data = mj.MjData(model)
    for start, sent in arm.sent:
        assert_inside(start, sent, config, model, data)
    assert refused + len(arm.sent) == commands
    return refused, len(arm.sent)


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(seed=st.integers(0, 2**32 - 1))
def test_no_hostile_command_outside_the_envelope_reaches_the_arm(seed: int) -> None:
    attack(seed, 200)


@pytest.mark.slow
@pytest.mark.timeout(3000)
@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(seed=st.integers(0, 2**32 - 1))
def test_none_of_100000_hostile_commands_reaches_the_arm_from_outside_the_envelope(seed: int) -> None:
    attack(seed, 1000)


def test_the_hostile_commands_are_neither_all_refused_nor_all_sent() -> None:
    refused, sent = attack(1, 400)
    assert refused > 200 and sent > 20


def test_a_command_does_not_follow_on_one_that_has_not_ended() -> None:
    clock = SimulatedClock(100.0)
    guard = GuardedArm(SpyArm(clock), Safety(), clock)
    guard.command(move(turned(j1=0.1)))
    with pytest.raises(RefusedError, match="busy"):
        guard.command(move(turned(j1=0.2)))


def test_a_stop_stays_until_another_run_begins() -> None:
    clock = SimulatedClock(100.0)
    arm = SpyArm(clock)
    guard = GuardedArm(arm, Safety(), clock)
    guard.command(move(turned(j1=0.1)))
    assert guard.wait(0.1) and guard.stop()
    with pytest.raises(StoppedError, match="stopped"):
        guard.command(move(turned(j1=0.2)))
    reasons = iter([None, None, "key"])
    guard.begin_run(lambda: next(reasons))
    guard.command(move(turned(j1=0.2)))
    assert guard.wait(0.1)
    for _ in range(2):
        with pytest.raises(StoppedError, match="key"):
            guard.command(move(turned(j1=0.3)))
    assert len(arm.sent) == 2


def test_a_stop_asked_for_while_a_move_is_sent_is_passed_on() -> None:
    clock = SimulatedClock(100.0)
    arm = SpyArm(clock)
    stopped: list[bool] = []
    arm.stop = lambda: stopped.append(True) or True  # type: ignore[method-assign, func-returns-value]
    guard = GuardedArm(arm, Safety(), clock)
    guard.begin_run(lambda: "SIGTERM" if arm.sent else None)
    guard.command(move(turned(j1=0.1)))
    assert stopped == [True]


def test_a_forbidden_arm_is_not_moved_by_any_command() -> None:
    clock = SimulatedClock(100.0)
    arm = SpyArm(clock)
    guard = GuardedArm(arm, Safety(), clock, why_forbidden=lambda: "not calibrated")
    with pytest.raises(RefusedError, match="not calibrated"):
        guard.command(move(turned(j1=0.1)))
    assert arm.sent == []


def test_states_that_cannot_be_true_are_faults() -> None:
    clock = SimulatedClock(100.0)
    arm = SpyArm(clock)
    guard = GuardedArm(arm, Safety(), clock)
    guard.read()
    arm.report = turned(j2=0.4)
    with pytest.raises(FaultError, match="joint_2 jumped by 0.400 rad"):
        guard.read()
    arm.report = turned(j3=np.nan)
    with pytest.raises(FaultError, match="not finite"):
        guard.read()
    arm.report = np.rad2deg(READY_QPOS)
    with pytest.raises(FaultError, match="which unit"):
        guard.read()


@pytest.mark.parametrize(
    "when", [{"stamp": 100.5}, {"stamp": math.nan}, {"stamp_error": math.nan}, {"stamp_error": -1.0}]
)
def test_a_state_from_the_future_or_from_no_time_is_a_fault(when: dict[str, Any]) -> None:
    clock = SimulatedClock(100.0)
    arm = SpyArm(clock)
    guard = GuardedArm(arm, Safety(), clock)
    state = replace(arm.read(), **when)
    arm.read = lambda max_age_s=0.5: state  # type: ignore[method-assign]
    with pytest.raises(FaultError, match="no state can be of later"):
        guard.read()


@pytest.mark.parametrize("speed", [0.2, math.nan])
def test_a_driver_that_says_it_sent_another_speed_is_stopped(speed: float) -> None:
    clock = SimulatedClock(100.0)
    arm = SpyArm(clock)
    command, stopped = arm.command, list[bool]()
    arm.command = lambda move: replace(command(move), speed_fraction=speed)  # type: ignore[method-assign]
    arm.stop = lambda: stopped.append(True) or True  # type: ignore[method-assign, func-returns-value]
    guard = GuardedArm(arm, Safety(), clock)
    with pytest.raises(FaultError, match="speed fraction"):
        guard.command(move(turned(j1=0.1)))
    assert stopped == [True]


def test_a_driver_that_breaks_at_a_stop_is_not_said_to_have_stopped() -> None:
    clock = SimulatedClock(100.0)
    arm = SpyArm(clock)
    guard = GuardedArm(arm, Safety(), clock)
    guard.command(move(turned(j1=0.1)))
    arm.stop = lambda: bool(1 / 0)  # type: ignore[method-assign]
    assert guard.stop() is False and guard.is_under_way and guard.why_stopped == "stopped"


def test_an_arm_that_does_not_arrive_is_a_fault_and_one_that_never_ends_a_timeout() -> None:
    clock = SimulatedClock(100.0)
    arm = SpyArm(clock)
    guard = GuardedArm(arm, Safety(), clock)
    guard.command(move(turned(j1=0.1)))
    arm.joints = turned(j1=0.05)
    with pytest.raises(FaultError, match="joint_1"):
        guard.wait(0.1)
    arm.arrives = False
    guard = GuardedArm(arm, Safety(), clock)
    guard.command(move(turned(j1=0.1)))
    with pytest.raises(DeviceTimeoutError, match="blocked"):
        while True:
            guard.wait(1.0)
