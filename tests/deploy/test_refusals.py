"""Every refusal says which limit, by how much, and the nearest that is allowed: that goes through, a little more does
not."""

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, get_args

import numpy as np
import pytest
import torch

from maniskill_tomato.deploy.collision import Box
from maniskill_tomato.deploy.interface import ArmState, JointMove
from maniskill_tomato.deploy.motion_bounds import straight_line
from maniskill_tomato.deploy.move_choice import MoveChooser, MoveRequest
from maniskill_tomato.deploy.plant_points import sphere_distances
from maniskill_tomato.deploy.refusals import Reason
from maniskill_tomato.deploy.safety import Safety
from maniskill_tomato.deploy.safety_config import SafetyConfig
from maniskill_tomato.robot.d435 import T_flange_camera_color_optical
from maniskill_tomato.robot.iiwa14 import BASE_TO_SHOULDER, JOINT_UPPER, READY_QPOS, WRIST_TO_EE
from maniskill_tomato.robot.inverse_kinematics import InverseKinematics, Reach
from maniskill_tomato.robot.kinematics import forward_kinematics
from maniskill_tomato.robot.look_at import CAMERA_ROLLS, look_at_pose
from maniskill_tomato.robot.look_at_move import LARGEST_JOINT_STEP, LookAtMover, keeps_clear
from maniskill_tomato.robot.out_of_reach import SHELL, out_of_reach

NOW = 10.0
EVERYWHERE = Box(low=(-2.0, -2.0, -2.0), high=(2.0, 2.0, 2.0))
WIDE = SafetyConfig(workspace=EVERYWHERE, forbidden=(), max_joint_step=3.0, max_flange_step=3.0)


def turned(**joints: float) -> Any:
    posture = READY_QPOS.copy()
    for name, angle in joints.items():
        posture[int(name[1:]) - 1] += angle
    return posture


def flange(joints: Any) -> Any:
    return forward_kinematics(torch.as_tensor(joints[None]))[0, :3, 3].numpy()


@dataclass(frozen=True, kw_only=True)
class Case:
    """A command that is refused for one reason."""

    config: SafetyConfig = SafetyConfig()
    goal: Any = None
    start: Any = None
    speed: float = 0.1
    state_age: float = 0.0
    frame_age: float | None = None
    points_w: Any = None

    def refusal(self) -> Any:
        move = JointMove(
            joint_positions=READY_QPOS if self.goal is None else self.goal, speed_fraction=self.speed
        )
        start = READY_QPOS if self.start is None else self.start
        state = ArmState(joint_positions=start, joint_velocities=np.zeros(7), stamp=NOW - self.state_age)
        frame = None if self.frame_age is None else NOW - self.frame_age
        return Safety(self.config).check(move, state, NOW, frame, self.points_w)

    def part(self, share: float) -> "Case":
        start = READY_QPOS if self.start is None else self.start
        return replace(self, goal=start + share * (self.goal - start))


def said(text: str, words: str) -> float:
    """The number before some words."""
    found = re.search(r"(-?\d+(?:\.\d+)?(?:e-?\d+)?) " + re.escape(words), text)
    assert found is not None, (words, text)
    return float(found[1])


def nearest(text: str) -> float:
    found = re.search(r"the nearest allowed is (-?\d+(?:\.\d+)?)", text)
    assert found is not None, text
    return float(found[1])


def joint_limit() -> None:
    for sign in (-1.0, 1.0):
        start, goal = READY_QPOS.copy(), READY_QPOS.copy()
        start[6], goal[6] = sign * np.deg2rad(160.0), sign * np.deg2rad(174.0)
        case = Case(start=start, goal=goal)
        text = told(case, "joint_limit")
        bound = np.rad2deg(JOINT_UPPER[6]) - np.rad2deg(0.03)
        assert said(text, "deg too far") == pytest.approx(174.0 - bound, abs=0.01)
        goal[6] = np.deg2rad(nearest(text))
        assert replace(case, goal=goal).refusal() is None
        goal[6] += sign * np.deg2rad(0.02)
        assert replace(case, goal=goal).refusal().reason == "joint_limit"


def joint_step() -> None:
    for sign in (-1.0, 1.0):
        case = Case(config=replace(WIDE, max_joint_step=0.4), goal=turned(j1=sign * 0.55))
        text = told(case, "joint_step")
        assert said(text, "rad too far") == pytest.approx(0.15, abs=1e-4)
        goal = READY_QPOS.copy()
        goal[0] = nearest(text)
        assert replace(case, goal=goal).refusal() is None
        goal[0] += sign * 3e-4
        assert replace(case, goal=goal).refusal().reason == "joint_step"


def speed() -> None:
    text = told(Case(speed=0.31), "speed")
    assert said(text, "too fast") == pytest.approx(0.01)
    assert (
        Case(speed=nearest(text)).refusal() is None and Case(speed=nearest(text) + 1e-3).refusal() is not None
    )
    assert "0.1 too slow" in told(Case(speed=-0.1), "speed") and "above 0" in told(Case(speed=0.0), "speed")


def stale_state() -> None:
    text = told(Case(state_age=0.75), "stale_state")
    assert said(text, "s too old") == pytest.approx(0.25)
    assert (
        Case(state_age=nearest(text)).refusal() is None
        and Case(state_age=nearest(text) + 0.01).refusal() is not None
    )
    text = told(Case(state_age=-0.25), "stale_state")
    assert said(text, "s in the future") == pytest.approx(0.25) and nearest(text) == 0.0


def stale_frame() -> None:
    text = told(Case(frame_age=12.0), "stale_frame")
    assert said(text, "s too old") == pytest.approx(2.0)
    assert (
        Case(frame_age=nearest(text)).refusal() is None
        and Case(frame_age=nearest(text) + 0.01).refusal() is not None
    )


def not_finite() -> None:
    text = told(Case(goal=turned(j3=np.nan)), "not_finite")
    assert "commanded joint positions" in text and "any finite number" in text
    text = told(Case(goal=turned(j1=0.1), points_w=np.full((7, 3), np.inf)), "not_finite")
    assert "7 of the 7 points" in text


def workspace() -> None:
    goal = turned(j2=0.3)
    way = np.array([flange(joints) for joints in straight_line(READY_QPOS, goal, 200)])
    edge = float(way[80, 0])
    case = Case(config=replace(WIDE, workspace=Box(low=(-2.0, -2.0, -2.0), high=(edge, 2.0, 2.0))), goal=goal)
    text = told(case, "workspace")
    assert said(text, "mm too far along x") == pytest.approx(1e3 * (way[:, 0].max() - edge), abs=0.2)
    assert_part_is_allowed(case, text, 0.4)


def forbidden_zone() -> None:
    goal = turned(j1=0.5)
    way = np.array([flange(joints) for joints in straight_line(READY_QPOS, goal, 200)])
    zone = Box(low=tuple(way[100] - 0.004), high=tuple(way[100] + 0.004))
    case = Case(config=replace(WIDE, forbidden=(zone,)), goal=goal)
    text = told(case, "forbidden_zone")
    deepest = np.minimum(way - np.array(zone.low), np.array(zone.high) - way).min(axis=1).max()
    assert said(text, "mm deep") == pytest.approx(1e3 * deepest, abs=0.5)
    enters = next(k for k, at in enumerate(way) if (np.abs(at - way[100]) < 0.004).all())
    assert_part_is_allowed(case, text, enters / 200)


def flange_step() -> None:
    goal = turned(j2=0.4)
    way = np.array([flange(joints) for joints in straight_line(READY_QPOS, goal, 200)])
    away = np.linalg.norm(way - way[0], axis=1)
    case = Case(config=replace(WIDE, max_flange_step=float(away[120])), goal=goal)
    text = told(case, "flange_step")
    assert said(text, "mm too far") == pytest.approx(1e3 * (away.max() - away[120]), abs=0.2)
    assert_part_is_allowed(case, text, 0.6)


def obstacle() -> None:
    goal, ahead = turned(j2=0.3), float(flange(READY_QPOS)[0]) + 0.23
    wall = Box(low=(ahead, -1.0, 0.0), high=(ahead + 0.08, 1.0, 2.0))
    case = Case(config=replace(WIDE, obstacles=(wall,), obstacle_clearance=0.05), goal=goal)
    text = told(case, "obstacle")
    # The least clearance with which the whole move is refused for the same thing is how near it gets.
    at_nearest = said(text, "mm, ")
    assert said(text, "mm too near") == pytest.approx(50.0 - at_nearest, abs=0.11)
    for clearance, is_refused in ((at_nearest - 0.7, False), (at_nearest + 0.7, True)):
        if clearance > 0.0:
            config = replace(case.config, obstacle_clearance=clearance / 1e3)
            assert (replace(case, config=config).refusal() is not None) == is_refused
    assert at_nearest > 1.0
    assert_part_is_allowed(case, text)


def table() -> None:
    start = np.deg2rad([0.0, 40.0, 0.0, -60.0, 0.0, 40.0, 0.0])
    down = np.deg2rad([0.0, 95.0, 0.0, -45.0, 0.0, 40.0, 0.0])
    case = Case(config=replace(WIDE, joint_margin=0.0), start=start, goal=down)
    text = told(case, "table")
    assert said(text, "mm too near") > 0.0 and "30 mm must be left" in text
    assert_part_is_allowed(case, text)


def self_collision() -> None:
    start = np.deg2rad([0.0, 40.0, 0.0, -60.0, 0.0, 40.0, 0.0])
    folded = np.deg2rad([0.0, 110.0, 0.0, -120.0, 0.0, 100.0, 0.0])
    case = Case(config=replace(WIDE, joint_margin=0.0, table_height=-1.0), start=start, goal=folded)
    text = told(case, "self_collision")
    assert said(text, "mm too near") > 0.0 and "5 mm must be left" in text
    assert_part_is_allowed(case, text)


def plant() -> None:
    goal = turned(j2=0.4)
    points = np.repeat(flange(goal)[None], 8, axis=0) + [0.03, 0.0, 0.0]
    case = Case(config=WIDE, goal=goal, points_w=points)
    text = told(case, "plant")
    dense = sphere_distances(straight_line(READY_QPOS, goal, 2000), points)
    assert said(text, "mm too near") == pytest.approx(-1e3 * dense.min(), abs=1.0)
    enters = int((dense.max(axis=1) < 0.0).argmax()) / 2000
    assert_part_is_allowed(case, text, enters)


def told(case: Case, reason: str) -> str:
    refusal = case.refusal()
    assert refusal is not None and refusal.reason == reason, refusal
    return str(refusal)


def assert_part_is_allowed(case: Case, text: str, expected: float | None = None) -> None:
    """The part of the move that is told goes through, and one percent more does not."""
    share = said(text, "% of the move are allowed") / 100
    assert 0.05 < share < 0.95
    assert case.part(share).refusal() is None
    assert case.part(share + 0.01).refusal() is not None
    if expected is not None:
        assert share == pytest.approx(expected, abs=0.02)
    degrees = [float(v) for v in text.rsplit("(", 1)[1].split(")")[0].split(",")]
    np.testing.assert_allclose(degrees, np.rad2deg(case.part(share).goal), atol=0.051)


KINDS: dict[str, Callable[[], None]] = {
    "not_finite": not_finite,
    "speed": speed,
    "joint_limit": joint_limit,
    "joint_step": joint_step,
    "stale_state": stale_state,
    "stale_frame": stale_frame,
    "workspace": workspace,
    "forbidden_zone": forbidden_zone,
    "flange_step": flange_step,
    "self_collision": self_collision,
    "table": table,
    "obstacle": obstacle,
    "plant": plant,
}


@pytest.mark.parametrize("reason", get_args(Reason))
def test_a_refusal_says_by_how_much_and_the_nearest_that_is_allowed(reason: str) -> None:
    KINDS[reason]()


def test_where_no_part_of_a_move_is_allowed_that_is_said() -> None:
    start = READY_QPOS
    zone = Box(low=tuple(flange(start) - 0.1), high=tuple(flange(start) + 0.1))
    text = told(Case(config=replace(WIDE, forbidden=(zone,)), goal=turned(j1=0.05)), "forbidden_zone")
    assert text.endswith("no part of the move is allowed")


# ------------------------------------------------------------------ kinematics


def reaches(position: Any, target: Any, joints: Any) -> bool:
    """The same question to the inverse kinematics, roll by roll."""
    solver = InverseKinematics()
    rolls = torch.tensor(CAMERA_ROLLS, dtype=torch.float64)
    poses = look_at_pose(torch.as_tensor(position)[None], torch.as_tensor(target)[None], rolls)
    poses = poses @ torch.as_tensor(np.linalg.inv(T_flange_camera_color_optical))
    found = solver.solve(poses, torch.as_tensor(np.tile(joints, (len(rolls), 1))), neighbour=False)
    near = (found.qpos - torch.as_tensor(joints)).abs().amax(-1) <= LARGEST_JOINT_STEP
    return bool(((found.reach == int(Reach.REACHABLE)) & near & keeps_clear(poses)).any())


@pytest.mark.parametrize(
    ("position", "target", "words"),
    [
        ((0.75, 0.0, 1.0), (1.2, 0.0, 1.0), "the wrist would be"),
        ((0.5, 0.2, 0.02), (0.9, 0.2, 0.1), "at least 0.15 m are allowed"),
        ((-0.35, 0.1, 0.9), (-0.8, 0.1, 0.9), "in one move, allowed are 1.5 rad"),
    ],
)
def test_a_view_out_of_reach_is_told_with_its_limit_and_the_nearest_place(
    position: Any, target: Any, words: str
) -> None:
    at, target = np.array(position), np.array(target)
    assert not reaches(at, target, READY_QPOS)
    found = out_of_reach(LookAtMover(), T_flange_camera_color_optical, READY_QPOS, at, target)
    text = str(found)
    assert words in text, text
    assert found.excess is not None and found.excess > 0.0
    if "wrist" in words:
        rolls = torch.tensor(CAMERA_ROLLS, dtype=torch.float64)
        poses = look_at_pose(torch.as_tensor(at)[None], torch.as_tensor(target)[None], rolls).numpy()
        hand = poses @ np.linalg.inv(T_flange_camera_color_optical)
        wrist = hand[:, :3, 3] - WRIST_TO_EE * hand[:, :3, 2]
        away = np.linalg.norm(wrist - [0.0, 0.0, BASE_TO_SHOULDER], axis=1).min()
        assert said(text, "mm too far") == pytest.approx(1e3 * (away - 0.82), abs=0.06)
    if found.nearest is None:
        assert "no place within" in text
        return
    assert reaches(found.nearest, target, READY_QPOS)
    assert said(text, "mm away") == pytest.approx(1e3 * np.linalg.norm(found.nearest - at), abs=0.06)
    # A millimetre farther towards the place asked for it is not, and nothing is much nearer.
    towards = (at - found.nearest) / found.distance
    assert not reaches(found.nearest + 1e-3 * towards, target, READY_QPOS)
    rng = np.random.default_rng(2)
    for direction in rng.normal(size=(60, 3)):
        radius = (found.distance - SHELL) * rng.random() ** (1 / 3)
        if radius > 0.0:
            assert not reaches(at + radius * direction / np.linalg.norm(direction), target, READY_QPOS)


def test_the_choice_of_a_move_out_of_reach_says_so() -> None:
    request = MoveRequest(
        joint_positions=READY_QPOS,
        camera_position=np.array([0.9, 0.0, 0.9]),
        target_position=np.array([1.4, 0.0, 0.9]),
        action=(0.0, 0.0, 1.0),
    )
    chooser = MoveChooser(Safety(WIDE), T_flange_camera_color_optical)
    own_goal = chooser.own_goal(request)
    state = ArmState(joint_positions=READY_QPOS, joint_velocities=np.zeros(7), stamp=NOW)
    chosen = chooser.choose(request, own_goal, state, NOW, NOW, np.zeros((0, 3)))
    assert own_goal is None and chosen.move is None
    assert chosen.out_of_reach.startswith("out of reach: the wrist would be"), chosen.out_of_reach
