"""Ways to other views: safe from end to end by a calculation of their own, and taken where a move is refused."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from maniskill_tomato.deploy.interface import ArmState, Float64, JointMove
from maniskill_tomato.deploy.loop import Loop
from maniskill_tomato.deploy.plant_points import sphere_distances
from maniskill_tomato.deploy.profile import parse_profile
from maniskill_tomato.deploy.run_records import KeptSteps
from maniskill_tomato.deploy.safety import Safety
from maniskill_tomato.deploy.safety_config import SafetyConfig
from maniskill_tomato.deploy.stops import Stops
from maniskill_tomato.deploy.way import WayPlanner
from maniskill_tomato.deploy.workcell import make_workcell
from maniskill_tomato.policies.protocol import Planner
from maniskill_tomato.robot.d435 import T_flange_camera_color_optical
from maniskill_tomato.robot.iiwa14 import JOINT_UPPER, READY_QPOS
from maniskill_tomato.robot.kinematics import forward_kinematics
from maniskill_tomato.sensing.belief import Belief

TARGET = np.array([0.8, 0.0, 0.55])
NOTHING = np.zeros((0, 3))
HERE = np.array(READY_QPOS, dtype=np.float64)


def state(joints: Float64) -> ArmState:
    return ArmState(joint_positions=joints, joint_velocities=np.zeros(7), stamp=0.0)


def camera(joints: Float64) -> Float64:
    """The optical frame. Shape (4, 4)."""
    pose: Float64 = forward_kinematics(torch.as_tensor(joints)).numpy() @ T_flange_camera_color_optical
    return pose


def lines(start: Float64, pieces: Sequence[Float64]) -> Float64:
    """Joint positions on the straight lines of a way, in [rad]. Shape (N, 7)."""
    stops = [start, *pieces]
    shares = np.linspace(0.0, 1.0, 30)[:, None]
    return np.concatenate([a + shares * (b - a) for a, b in zip(stops[:-1], stops[1:], strict=True)])


def test_a_way_ends_where_the_camera_looks_at_the_target_and_touches_no_leaf() -> None:
    safety = Safety()
    planner = WayPlanner(safety, T_flange_camera_color_optical)
    left, place = np.array([[0.45, 0.1, 0.7], [0.45, -0.1, 0.7]])
    start = planner.to_view(left[None], TARGET, state(HERE), 0.0, 0.0, NOTHING).pieces[-1]
    (free,) = planner.to_view(place[None], TARGET, state(start), 0.0, 0.0, NOTHING).pieces
    leaf = camera((start + free) / 2)[:3, 3] + np.random.default_rng(0).uniform(-0.03, 0.03, (60, 3))
    straight = JointMove(joint_positions=free, speed_fraction=0.1)
    refusal = safety.check(straight, state(start), 0.0, 0.0, leaf)
    assert refusal is not None and refusal.reason == "plant"
    way = planner.to_view(place[None], TARGET, state(start), 0.0, 0.0, leaf)
    assert way.place == 0 and len(way.pieces) > 1 and way.blocked == ()
    nearest = sphere_distances(lines(start, way.pieces), leaf).min(axis=0)
    assert int((nearest < 0.0).sum()) < safety.config.plant_points_needed
    pose = camera(way.pieces[-1])
    np.testing.assert_allclose(pose[:3, 3], place, atol=1e-4)
    towards = (TARGET - place) / np.linalg.norm(TARGET - place)
    assert pose[:3, 2] @ towards > 0.9999
    steps = np.abs(np.diff(np.stack([start, *way.pieces]), axis=0))
    assert steps.max() <= safety.config.max_joint_step


def test_places_among_leaves_are_told_and_the_next_one_is_taken() -> None:
    planner = WayPlanner(Safety(), T_flange_camera_color_optical)
    places = np.array([[0.5, 0.1, 0.5], [0.42, -0.2, 0.6]])
    leaf = places[0] + np.random.default_rng(1).uniform(-0.02, 0.02, (60, 3))
    way = planner.to_view(places, TARGET, state(HERE), 0.0, 0.0, leaf)
    assert (way.place, way.blocked) == (1, (0,))
    only = planner.to_view(places[:1], TARGET, state(HERE), 0.0, 0.0, leaf)
    assert (only.place, only.pieces, only.blocked) == (None, (), (0,))


class IntoTheGround(Planner):
    """Always down: soon the table is in the way."""

    name = "into the ground"

    def act(self, belief: Belief) -> Tensor:
        return torch.tensor([[0.0, -1.0, 0.0]])


TEXT = """
[arm]
driver = "mock"
[camera]
driver = "mock"
[twin]
episodes = "validation"
width = 212
height = 160
[perception]
segmenter = "ground_truth"
sight = "rays"
[target]
source = "twin"
[loop]
max_moves = 12
threshold = 0.99
"""


def test_where_a_policy_insists_on_refused_moves_the_arm_goes_to_another_view() -> None:
    workcell, kept = make_workcell(parse_profile(TEXT, Path("test.toml")), 3), KeptSteps()
    with workcell.arm, workcell.camera, Stops() as stops:
        result = Loop(workcell, IntoTheGround(), stops, "unattended", [kept]).run()
    assert not result.is_fault and result.moves <= 12
    assert result.refused_moves == 0
    handed = [step for step in kept.steps if step.action is not None and "on the way" in step.detail]
    assert handed and all(step.outcome == "moved" for step in handed)
    assert all(np.abs(step.joint_positions).max() < JOINT_UPPER.max() for step in kept.steps)


@pytest.mark.parametrize("clearance", [None, 0.0])
def test_points_that_are_not_finite_leave_no_way(clearance: float | None) -> None:
    safety = Safety(SafetyConfig(plant_clearance=clearance))
    planner = WayPlanner(safety, T_flange_camera_color_optical)
    points = np.full((10, 3), np.nan)
    way = planner.to_view(np.array([[0.42, 0.2, 0.55]]), TARGET, state(HERE), 0.0, 0.0, points)
    assert (way.place is None) == (clearance is not None)
