"""Transits by the ready posture: where they end, what they pass, what they are counted as in a row."""

from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from torch import Tensor

import maniskill_tomato  # noqa: F401
from maniskill_tomato.deploy.collision import CollisionChecker
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.policies.adapters import BeliefFollower
from maniskill_tomato.policies.opening import open_policy
from maniskill_tomato.robot.iiwa14 import JOINT_UPPER, READY_QPOS
from maniskill_tomato.robot.inverse_kinematics import Reach
from maniskill_tomato.robot.kinematics import forward_kinematics
from maniskill_tomato.robot.look_at import flange_to_camera
from maniskill_tomato.robot.look_at_move import LookAtMover, keeps_clear
from maniskill_tomato.robot.transit import TransitPlanner

TARGET = torch.tensor([0.75, 0.1, 0.8], dtype=torch.float64)
READY = torch.tensor(READY_QPOS, dtype=torch.float64)


@pytest.fixture(scope="module")
def planner() -> TransitPlanner:
    return TransitPlanner()


@pytest.fixture(scope="module")
def row() -> Iterator[Any]:
    env = gym.make("TomatoViewpointRow-v1", obs_mode="state", render_backend="none", plant={"pool": 4})
    yield env
    env.close()


def places(count: int, seed: int) -> Tensor:
    rng = np.random.default_rng(seed)
    return torch.tensor(rng.uniform((0.25, -0.4, 0.4), (0.6, 0.4, 1.1), (count, 3)))


def camera_of(qpos: Tensor) -> Tensor:
    return flange_to_camera(forward_kinematics(qpos[None]))[0]


def test_a_transit_passes_the_ready_posture_and_ends_at_the_place_with_the_target_in_the_middle(
    planner: TransitPlanner,
) -> None:
    limits = torch.tensor(JOINT_UPPER)
    found = 0
    start = planner.plan(READY, places(8, 1), TARGET)
    assert start is not None
    for place in places(8, 0):
        way = planner.plan(start.waypoints[-1], place[None], TARGET)
        if way is None:
            continue
        found += 1
        assert torch.equal(way.waypoints[0], start.waypoints[-1])
        assert any(torch.equal(stop, READY) for stop in way.waypoints)
        pose = camera_of(way.waypoints[-1])
        torch.testing.assert_close(pose, way.T_world_camera, atol=1e-9, rtol=0)
        torch.testing.assert_close(pose[:3, 3], place, atol=1e-9, rtol=0)
        axis = (TARGET - place) / (TARGET - place).norm()
        torch.testing.assert_close(pose[:3, 2], axis, atol=1e-9, rtol=0)
        assert bool((way.waypoints.abs() <= limits).all())
        dense = torch.cat(
            [torch.lerp(a, b, torch.linspace(0, 1, 40)[:, None].double()) for a, b in _legs(way.waypoints)]
        )
        flange = forward_kinematics(dense)
        # Between the checked positions the flange may come a little nearer.
        flange[:, 2, 3] += 0.01
        assert bool(keeps_clear(flange).all())
    assert found >= 4


def test_the_first_place_in_reach_is_taken_and_none_is_told(planner: TransitPlanner) -> None:
    out_of_reach = torch.tensor([[0.5, 0.0, 2.5], [-2.0, 0.0, 0.5]], dtype=torch.float64)
    near = places(6, 2)
    first = planner.plan(READY, near, TARGET)
    assert first is not None
    way = planner.plan(READY, torch.cat([out_of_reach, near]), TARGET)
    assert way is not None and way.place == 2 + first.place
    assert planner.plan(READY, out_of_reach, TARGET) is None
    assert planner.plan(READY, near[:0], TARGET) is None
    with pytest.raises(InvalidInputError, match="shapes"):
        planner.plan(READY[None], near, TARGET)


def test_a_transit_reaches_what_a_move_refuses(planner: TransitPlanner) -> None:
    mover = LookAtMover()
    rng = np.random.default_rng(3)
    helped = 0
    for _ in range(20):
        qpos = torch.tensor(rng.uniform(-1.0, 1.0, 7)) * torch.tensor(JOINT_UPPER) * 0.8
        place = places(1, int(rng.integers(1 << 30)))
        move = mover.look_from(qpos[None], place, TARGET[None])
        way = planner.plan(qpos, place, TARGET) if bool(keeps_clear(forward_kinematics(qpos))) else None
        helped += way is not None and int(move.reach[0]) == int(Reach.UNREACHABLE)
    assert helped >= 5


def test_path_lengths_are_those_of_a_fine_plain_loop(planner: TransitPlanner) -> None:
    start = planner.plan(READY, places(8, 1), TARGET)
    assert start is not None
    way = planner.plan(start.waypoints[-1], places(8, 5), TARGET)
    assert way is not None
    camera = joints = 0.0
    for a, b in _legs(way.waypoints):
        joints += float((b - a).abs().sum())
        last = camera_of(a)[:3, 3]
        for share in np.linspace(0.0, 1.0, 101)[1:]:
            here = camera_of(a + share * (b - a))[:3, 3]
            camera += float((here - last).norm())
            last = here
    assert way.joint_path_rad == pytest.approx(joints, rel=1e-9)
    assert way.camera_path_m == pytest.approx(camera, rel=0.01)


def test_the_arm_does_not_meet_itself_on_a_transit(planner: TransitPlanner) -> None:
    checker = CollisionChecker(table_clearance=0.0, self_clearance=0.0)
    qpos, seen = READY, 0
    for seed in range(6):
        way = planner.plan(qpos, places(4, seed), TARGET)
        if way is None:
            continue
        seen += 1
        qpos = way.waypoints[-1]
        assert checker.nearest(way.passed.numpy()) is None
    assert seen >= 4


def test_a_refused_move_of_a_row_becomes_a_transit_that_is_counted(row: Any) -> None:
    base = row.unwrapped
    policy = BeliefFollower(open_policy("random_viewpoint"), row)
    met = 0
    for seed in (4, 6):
        obs, info = row.reset(seed=seed)
        done = False
        while not done and met < 2:
            before, target = info, int(base.target_fruit[0])
            start, moved = base.agent.robot.get_qpos()[0].double(), base.belief.camera_position[0].clone()
            obs, reward, terminated, truncated, info = row.step(policy.act(obs))
            done = bool(terminated) or bool(truncated)
            transits = int(info["transits"][0])
            assert int(info["moves"][0] - before["moves"][0]) == 1 + 2 * transits
            way = float(info["path_length"][0] - before["path_length"][0])
            straight = float((base.belief.camera_position[0] - moved).norm())
            assert way >= straight - 1e-5
            gain = float(info["visible_fraction_gain"][0])
            paid = gain - 0.02 * (1 + 2 * transits) + float(info["target_done"][0])
            assert float(reward) == pytest.approx(paid, abs=1e-6)
            if transits and int(base.target_fruit[0]) == target:
                met += 1
                end = base.agent.robot.get_qpos()[0].double()
                joints = float(info["joint_path_length"][0] - before["joint_path_length"][0])
                by_ready = float((READY - start).abs().max()) + float((end - READY).abs().max())
                assert joints >= by_ready - 1e-4 and way > straight
                assert int(info["reachability"][0]) == int(Reach.REACHABLE)
    assert met == 2


def test_a_state_after_a_transit_continues_exactly(row: Any) -> None:
    base, rng = row.unwrapped, np.random.default_rng(1)
    obs, info = row.reset(seed=1)
    moves = 0
    while not int(info["transits"][0]):
        obs, _, terminated, _, info = row.step(rng.normal(size=3).astype(np.float32))
        moves += 1
        assert moves < 60 and not bool(terminated)
    saved = base.get_state_dict()
    actions = [rng.normal(size=3).astype(np.float32) for _ in range(3)]
    expected = [row.step(a)[4] for a in actions]
    base.set_state_dict(saved)
    assert torch.equal(base.get_obs(base.get_info()), obs)
    for name in ("transits", "joint_path_length", "moves"):
        assert torch.equal(base.get_info()[name], info[name])
    for a, told in zip(actions, expected, strict=True):
        info = row.step(a)[4]
        for name in ("visible_fraction", "path_length", "joint_path_length", "moves", "clearance"):
            torch.testing.assert_close(info[name], told[name], atol=1e-6, rtol=0)


def test_a_row_without_moves_left_fails(row: Any) -> None:
    row.reset(seed=0)
    row.unwrapped.world.state.moves[:] = 118
    _, _, terminated, _, info = row.step(np.zeros(3, dtype=np.float32))
    assert not bool(terminated)
    _, _, terminated, _, info = row.step(np.zeros(3, dtype=np.float32))
    assert bool(terminated) and bool(info["fail"][0]) and not bool(info["success"][0])


def test_transits_can_be_left_out_and_bad_ones_are_refused() -> None:
    with pytest.raises(InvalidInputError, match="refused"):
        gym.make("TomatoViewpointRow-v1", render_backend="none", transits="always")


def _legs(waypoints: Tensor) -> list[tuple[Tensor, Tensor]]:
    return list(zip(waypoints[:-1], waypoints[1:], strict=True))
