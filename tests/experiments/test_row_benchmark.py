"""Rows searched by policies: what is seeable, the tables, resuming."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.experiments.configs import RowBenchmarkConfig
from maniskill_tomato.experiments.episode_record import EpisodeRecord, RowSearch
from maniskill_tomato.experiments.rollout import run_episode
from maniskill_tomato.experiments.row_benchmark import (
    SeeableTomatoes,
    compare_rows,
    rows_table,
    run_row_benchmark,
    searched,
)
from maniskill_tomato.learning.rl.envs import make_env
from maniskill_tomato.policies.opening import open_policy
from maniskill_tomato.robot.kinematics import forward_kinematics
from maniskill_tomato.robot.look_at import flange_to_camera
from maniskill_tomato.tasks.making import make_world

TARGET = torch.tensor([0.75, 0.1, 0.8], dtype=torch.float64)


def test_what_a_policy_sees_in_a_row_is_seeable() -> None:
    row: Any = make_env("TomatoViewpointRow-v1", plant={"pool": 4})
    record = run_episode(row, open_policy("nbv"), 2)
    search = searched(record)
    assert len(search.seen) >= 2 and set(search.seen) <= set(search.targets)
    # Each transit stands for more than one move, and a camera that goes by the ready posture goes farther.
    assert search.moves >= record.steps
    assert search.path_m >= record.camera_path_length - 1e-4
    row.reset(seed=2)
    assert row.unwrapped.open_targets(0) == list(search.targets)
    assert set(SeeableTomatoes(row).among(search.seen)) == set(search.seen)
    row.close()


def test_a_tomato_is_seeable_only_from_where_the_arm_can_stand() -> None:
    target = TARGET.float()
    asked: list[Tensor] = []

    def fraction(poses: Tensor, env_index: int, qpos: Tensor, fruit: int) -> Tensor:
        asked.append(poses)
        torch.testing.assert_close(flange_to_camera(forward_kinematics(qpos)), poses, atol=1e-9, rtol=0)
        # Only views from the left and below show it.
        away = poses[:, :3, 3] - target
        return torch.where((away[:, 1] > 0.1) & (away[:, 2] < -0.1), 0.9, 0.3)

    world = SimpleNamespace(
        device=torch.device("cpu"),
        task=SimpleNamespace(full_visibility=0.8),
        ground_truth=SimpleNamespace(visible_fraction=fraction),
        fruit_position_w=lambda env_index, fruit: target + (5.0 if fruit == 1 else 0.0),
    )
    truth = SeeableTomatoes(SimpleNamespace(unwrapped=world))  # type: ignore[arg-type]
    assert truth.among([0, 1]) == [0]
    assert truth.best_view(1) == 0.0 and truth.best_view(0) == pytest.approx(0.9)
    world.task.full_visibility = 0.95
    before = sum(len(poses) for poses in asked)
    assert truth.among([0]) == []
    # All samples were tried before it counted as hidden, some 4,500 less those out of reach.
    assert sum(len(poses) for poses in asked) - before > 800


def record(seed: int, seen: tuple[int, ...], moves: int) -> EpisodeRecord:
    """A search of ten steps, one refused and two with contact."""
    return EpisodeRecord(
        seed=seed,
        success=len(seen) == 4,
        visible_fraction=np.zeros(11),
        viewpoints=np.zeros((11, 6)),
        target=np.zeros((11, 3)),
        rewards=np.zeros(10),
        reachability=np.array([2] + [0] * 9),
        decision_ms=np.ones(10),
        contact=np.array([True, True] + [False] * 8),
        row=RowSearch(
            targets=(0, 1, 2, 3), seen=seen, moves=moves, transits=3, path_m=1.0, joint_path_rad=5.0
        ),
    )


def test_rows_are_told_by_hand_counts() -> None:
    runs = {
        "a": [record(0, (0, 1), 20), record(1, (0, 1, 2), 30)],
        "b": [record(0, (0,), 40), record(1, (0,), 50)],
    }
    seeable = {0: {0, 1}, 1: {0, 1, 2, 3}}
    table = rows_table(runs, seeable)
    assert "2 rows, 8 tomatoes in reach, 6 of them seeable" in table
    assert "| a | 83.3 % | " in table and "| 62.5 % | 10.00 |" in table
    assert "| 10 % | 20 % |" in table
    (line,) = compare_rows(runs, seeable)
    # Row 0: 1 against 1/2; row 1: 3/4 against 1/4.
    assert (line[0], line[1], line[4]) == ("a minus b", "+0.500", "-20.000")


def test_an_episode_of_another_task_is_no_row() -> None:
    other = EpisodeRecord(**{**vars(record(0, (), 1)), "row": None})
    with pytest.raises(InvalidInputError, match="is not the search of a row"):
        searched(other)


@pytest.mark.slow
def test_a_row_benchmark_goes_on_where_it_was(tmp_path: Path) -> None:
    config = RowBenchmarkConfig(policies="stay", rows=1, out=tmp_path)
    done = run_row_benchmark(config)
    page = done.report.read_text()
    assert "| stay | " in done.text and '<th scope="row">stay</th>' in page and page.count("n = 1 rows") >= 4
    assert "benchmark-rows --policies stay --rows 1 --seed 1000 --split held_out" in page
    stored = {path: path.read_bytes() for path in tmp_path.rglob("*.jsonl")}
    assert len(stored) == 2
    assert run_row_benchmark(config).text == done.text
    assert {path: path.read_bytes() for path in tmp_path.rglob("*.jsonl")} == stored
    (row,) = json.loads((tmp_path / "rows-held_out-both.json").read_text())["rows"]["stay"].values()
    assert row["seed"] == 1000 and row["seen"] == seen_by_an_arm_that_stays(1000)


def seen_by_an_arm_that_stays(seed: int) -> list[int]:
    """The tomatoes that come into view on transits to the next target alone."""
    world = make_world("TomatoViewpointRow-v1", plant={"seed": "held_out", "pool": None}, transits="both")
    world.reset(seed)
    seen = []
    while not bool((info := world.info())["success"] | info["fail"]):
        target = int(world.state.target)
        world.step(torch.zeros(1, 3))
        if bool(world.info()["target_done"]):
            seen.append(target)
    return sorted(seen)
