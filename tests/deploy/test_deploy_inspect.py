"""The inspection of a row on the twin: what its list says, how it ends, what becomes of transits."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from maniskill_tomato.deploy.clock import SimulatedClock
from maniskill_tomato.deploy.decision import TASK, default_policy
from maniskill_tomato.deploy.deploy_errors import ProfileError
from maniskill_tomato.deploy.inspection_run import inspect_row, whole_row
from maniskill_tomato.deploy.interface import ArmState, Float64
from maniskill_tomato.deploy.loop import REPLANS, Loop
from maniskill_tomato.deploy.mock.episode import load_episode
from maniskill_tomato.deploy.policy_run import RunConfig
from maniskill_tomato.deploy.profile import Profile, load_profile, parse_profile
from maniskill_tomato.deploy.row_goal import WholeRow
from maniskill_tomato.deploy.run_records import KeptSteps, Mode, RunResult, Step
from maniskill_tomato.deploy.run_replay import load_recording, replay
from maniskill_tomato.deploy.stops import Stops
from maniskill_tomato.deploy.way import Way, WayPlanner, cut_way
from maniskill_tomato.deploy.workcell import Workcell, make_workcell
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.policies.opening import open_policy
from maniskill_tomato.robot.iiwa14 import READY_QPOS
from maniskill_tomato.robot.kinematics import forward_kinematics
from maniskill_tomato.robot.transit import TRANSIT_MOVES, TransitPlanner

SEED = 1

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
"""


def profile(more: str = "") -> Profile:
    return parse_profile(TEXT + more, Path("test.toml"))


def true_fruits() -> tuple[Float64, list[str]]:
    """Centres of the episode's fruits in the base frame, in [m], and how ripe they are."""
    episode = load_episode("validation", SEED)
    T = episode.T_world_plant.double().numpy()
    centres = np.array([fruit.centre for fruit in episode.plant.fruits], dtype=np.float64)
    return centres @ T[:3, :3].T + T[:3, 3], [fruit.ripeness for fruit in episode.plant.fruits]


def goes(
    of: Profile, row_moves: int, mode: Mode = "unattended"
) -> tuple[RunResult, WholeRow, KeptSteps, Workcell]:
    workcell, kept = make_workcell(of, SEED), KeptSteps()
    goal = whole_row(workcell, row_moves)
    policy = open_policy(default_policy(), env_id=TASK)
    with workcell.arm, workcell.camera, Stops() as stops:
        result = Loop(workcell, policy, stops, mode, [kept], goal=goal).run()
    return result, goal, kept, workcell


def test_the_list_holds_fruits_that_are_there_each_once(tmp_path: Path) -> None:
    done = inspect_row(RunConfig(profile=profile(), out=tmp_path, seed=SEED), row_moves=8)
    assert (done.run.reason, done.run.moves) == ("budget", 8), done.run.detail
    content = json.loads((tmp_path / "inspection.json").read_text())
    assert content["fruits"] == list(done.fruits) and content["moves"] == 8 and content["simulated"] is True
    centres, ripeness = true_fruits()
    numbers = []
    for fruit in content["fruits"]:
        away = np.linalg.norm(centres - fruit["position_m"], axis=1)
        assert away.min() < 0.015
        numbers.append(int(away.argmin()))
        assert fruit["ripeness"] == ripeness[numbers[-1]] == fruit["true_ripeness"] == "ripe"
        assert fruit["true_fruit"] == numbers[-1]
        assert fruit["true_position_error_m"] == pytest.approx(away.min(), abs=2e-5)
        assert abs(fruit["visible_fraction"] - fruit["true_visible_fraction"]) < 0.3
        assert 0.015 < fruit["radius_m"] < 0.045 and fruit["views"] >= 1
        assert (tmp_path / fruit["picture"]).stat().st_size > 500
        if fruit["fully_seen"]:
            pose = np.array(fruit["best_view"])
            towards = np.array(fruit["approach"])
            assert np.linalg.norm(towards) == pytest.approx(1.0, abs=1e-4)
            assert towards @ (pose[:3, 3] - fruit["position_m"]) > 0.1
    assert len(numbers) == len(set(numbers)) >= 4, "each fruit once"
    full = [f for f in content["fruits"] if f["fully_seen"] and f["true_visible_fraction"] > 0.8]
    assert content["true_fully_seen"] == len(full) >= 2
    assert content["true_recall"] == pytest.approx(len(full) / content["true_ripe_in_reach"], abs=1e-4)
    assert content["true_precision"] == 1.0
    page = (tmp_path / "report.html").read_text()
    assert "Inspection of a row" in page and page.count("<img") == 1 + len(numbers)
    assert not re.search(r'src="(?!data:)', page) and page.count(f"n = {len(numbers)} fruits") >= 2
    assert (tmp_path / "report.png").stat().st_size > 10_000
    again = replay(load_recording(tmp_path / "run.mcap"))
    assert again.differences == () and again.steps == len(content["steps"])


class StoppingClock(SimulatedClock):
    """Makes the stop file in the middle of a move."""

    def __init__(self, file: Path) -> None:
        super().__init__(1000.0)
        self._file = file

    def sleep(self, seconds: float) -> None:
        super().sleep(seconds)
        if self.now() > 1012.0:
            self._file.touch()


def test_a_stop_file_ends_an_inspection_and_the_list_so_far_is_written(tmp_path: Path) -> None:
    config = RunConfig(profile=profile(), out=tmp_path, seed=SEED, record=False)
    done = inspect_row(config, clock=StoppingClock(tmp_path / "STOP"))
    assert (done.run.reason, done.run.is_fault) == ("stopped", False) and "STOP" in done.run.detail
    assert 1 <= done.run.moves < 20 and "holds its position" in done.run.end_state
    content = json.loads((tmp_path / "inspection.json").read_text())
    assert content["reason"] == "stopped" and content["fruits"]
    assert (tmp_path / "report.html").exists()


def test_a_dry_run_of_an_inspection_sends_nothing() -> None:
    result, _, _, workcell = goes(profile(), 8, "dry_run")
    assert (result.reason, result.is_fault) == ("dry_run", False) and "nothing was sent" in result.detail
    arm: Any = workcell.arm
    assert arm._commands == 0


def a_way(monkeypatch: pytest.MonkeyPatch, *turns: float) -> None:
    """No fruit can be looked at from where the arm is, and every way turns joint 1 so far from there, in [rad]."""

    def to_view(self: Any, places: Any, target: Any, state: ArmState, *others: Any) -> Way:
        pieces = [state.joint_positions + np.array([turn, 0, 0, 0, 0, 0, 0]) for turn in turns]
        return Way(pieces=tuple(pieces), place=0 if turns else None, blocked=())

    monkeypatch.setattr(TransitPlanner, "can_turn", lambda *_: False)
    monkeypatch.setattr(WayPlanner, "to_view", to_view)


def assert_never_again(steps: list[Step]) -> None:
    for k, step in enumerate(steps):
        others = [other.target_position for other in steps[:k]]
        assert all(np.linalg.norm(step.target_position - other) > 0.01 for other in others), "never again"


def test_a_way_whose_first_piece_the_arm_refuses_gives_its_target_up(monkeypatch: pytest.MonkeyPatch) -> None:
    a_way(monkeypatch, 0.02)
    naks = TEXT.replace("height = 160", 'height = 160\nfaults = { arm = "refuse" }')
    result, goal, kept, workcell = goes(parse_profile(naks, Path("test.toml")), 9)
    assert (result.reason, result.moves, result.refused_moves) == ("budget", 9, 5), result.detail
    pieces = [step for step in kept.steps if step.outcome == "refused" and step.action is None]
    assert len(pieces) == 4, "no moves are left for a fifth"
    assert_never_again(pieces)
    assert len(goal.view_joints) == 1, "a view that stays the same is not taken in again"


def test_a_target_to_which_there_is_no_way_is_given_up_for_one_move(monkeypatch: pytest.MonkeyPatch) -> None:
    a_way(monkeypatch)
    result, _, kept, _ = goes(profile(), 3)
    assert (result.reason, result.moves, result.refused_moves) == ("budget", 3, 2), result.detail
    ways = [step for step in kept.steps if step.action is None and step.outcome == "refused"]
    assert len(ways) == 2, "no moves are left for a third"
    assert all("no way" in step.detail for step in ways)
    assert_never_again(ways)


def test_a_way_that_pictures_show_to_be_unsafe_is_planned_anew_then_given_up(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    a_way(monkeypatch, 9.0)
    result, goal, kept, _ = goes(profile(), 3)
    refused = [step for step in kept.steps if step.outcome == "refused"]
    assert [step.outcome for step in kept.steps[: REPLANS + 2]] == ["refused"] * (REPLANS + 2)
    assert all(step.action is None and "joint_limit" in step.detail for step in refused[: REPLANS + 2])
    assert np.ptp([step.target_position for step in refused[: REPLANS + 2]], axis=0).max() == 0.0
    after = kept.steps[REPLANS + 2]
    assert np.linalg.norm(after.target_position - refused[0].target_position) > 0.01
    assert result.moves == 3 and all(
        np.abs(joints - refused[0].joint_positions).max() < 2.0 for joints in goal.view_joints
    )


def test_a_way_counts_as_two_moves_and_its_views_are_mapped(monkeypatch: pytest.MonkeyPatch) -> None:
    a_way(monkeypatch, 0.02, 0.04, 0.06)
    result, goal, kept, _ = goes(profile(), 4)
    first = kept.steps[:4]
    assert [step.outcome for step in first[:3]] == ["moved"] * 3
    assert [step.action is None for step in first] == [True, True, True, False]
    turned = [0.02, 0.04, 0.06]
    np.testing.assert_allclose(
        np.stack([step.commanded for step in first[:3] if step.commanded is not None])[:, 0]
        - first[0].joint_positions[0],
        turned,
        atol=1e-9,
    )
    assert [step.moves_left for step in first[:3]] == [2, 2, 2] and first[3].moves_left == 4 - TRANSIT_MOVES
    mapped = np.stack(goal.view_joints)[:4, 0]
    np.testing.assert_allclose(mapped - first[0].joint_positions[0], [0.0, *turned], atol=1e-6)
    assert result.moves == 4


def test_a_way_is_cut_into_pieces_that_go_where_it_goes() -> None:
    rng = np.random.default_rng(0)
    waypoints = np.array(READY_QPOS) + rng.uniform(-0.8, 0.8, (4, 7))
    pieces = cut_way(waypoints, 0.5, 0.2)
    way = np.stack([waypoints[0], *pieces])
    assert np.abs(np.diff(way, axis=0)).max() <= 0.5 + 1e-9
    for waypoint in waypoints[1:]:
        assert np.abs(way - waypoint).max(axis=1).min() < 1e-9
    for start, end in zip(way[:-1], way[1:], strict=True):
        line = start + np.linspace(0.0, 1.0, 50)[:, None] * (end - start)
        flange = forward_kinematics(torch.as_tensor(line)).numpy()[:, :3, 3]
        assert np.linalg.norm(flange - flange[0], axis=1).max() <= 0.2 + 1e-3


def test_what_an_inspection_cannot_use_is_refused_before_a_device_is_opened(tmp_path: Path) -> None:
    out = tmp_path / "out"
    rays = replace(profile(), perception=replace(profile().perception, sight="rays"))
    with pytest.raises(ProfileError, match="follows one target"):
        inspect_row(RunConfig(profile=rays, out=out))
    with pytest.raises(InvalidInputError, match="row_moves must be 1 or more"):
        inspect_row(RunConfig(profile=profile(), out=out), row_moves=0)
    assert not out.exists()


def test_mock_rendered_gets_no_target_from_the_twin() -> None:
    assert load_profile("mock_rendered").target.source == load_profile("iiwa14_d435").target.source == "seen"
