"""The list of episodes in reports: failures first, each with its reason and a command that runs it again."""

import re
import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from maniskill_tomato.cli import main, parse
from maniskill_tomato.experiments.episode_listing import (
    LISTED,
    episode_list,
    failures_first,
    list_episode,
    list_episodes,
    reason,
    replay_with_eval,
)
from maniskill_tomato.experiments.episode_record import EpisodeRecord, RowSearch
from maniskill_tomato.robot.inverse_kinematics import Reach

HORIZON = 5


def record(seed: int, seen: list[float], success: bool, **changes: Any) -> EpisodeRecord:
    moves = len(seen) - 1
    made = EpisodeRecord(
        seed=seed,
        success=success,
        visible_fraction=np.array(seen),
        viewpoints=np.zeros((moves + 1, 6)),
        target=np.zeros((moves + 1, 3)),
        rewards=np.zeros(moves),
        reachability=np.zeros(moves, dtype=np.int64),
        decision_ms=np.ones(moves),
    )
    return replace(made, **changes)


def with_camera(
    seed: int, measured: list[float], true: list[float], success: bool, chosen: int
) -> EpisodeRecord:
    """An episode after fruit 3, in which the camera looked at the fruit `chosen`."""
    views = len(measured)
    return record(
        seed,
        measured,
        success,
        true_visible_fraction=np.array(true),
        true_target=np.zeros((views, 3)),
        chosen_visible_fraction=np.array(true),
        chosen_fruit=np.full(views, chosen),
        target_fruit=np.full(views, 3),
        target_named=np.ones(views, dtype=np.bool_),
    )


def lines(html: str) -> list[list[str]]:
    """The cells of each row of a table, then the lines under it."""
    found: list[list[str]] = []
    for kind, row in re.findall(
        r"<tr( class=\"below\")?[^>]*>(<t[hd] (?:scope=\"row\"|colspan).*?)</tr>", html
    ):
        parts = re.findall(r"<p>(.*?)</p>" if kind else r"<t[hd][^>]*>(.*?)</t[hd]>", row)
        texts = [re.sub(r"<[^>]+>", "", part) for part in parts]
        if kind:
            found[-1] += texts
        else:
            found.append(texts)
    return found


def test_failures_come_first_the_worst_of_them_at_the_top_then_the_longest_successes() -> None:
    records = [
        record(1, [0.1, 0.9], True),
        record(2, [0.1, 0.2, 0.3, 0.3, 0.3, 0.6], False),
        record(3, [0.2, 0.3, 0.9], True),
        record(4, [0.0, 0.1, 0.1, 0.1, 0.1, 0.1], False),
    ]
    html = episode_list(list_episodes(records, 0.8, HORIZON, lambda seed: f"again {seed}"))
    assert lines(html) == [
        ["4", "failed", "5", "0.00", "0.10", "moves ran out", "again 4"],
        ["2", "failed", "5", "0.10", "0.60", "moves ran out", "again 2"],
        ["3", "solved", "2", "0.20", "0.90", "again 3"],
        ["1", "solved", "1", "0.10", "0.90", "again 1"],
    ]
    assert "2 of 4 episodes failed." in html


def test_the_reason_says_what_ended_the_episode_and_what_hindered_the_arm() -> None:
    out = int(Reach.UNREACHABLE)
    ran_out = record(0, [0.1] * 6, False)
    assert reason(ran_out, 0.8, HORIZON) == "moves ran out"
    refused = replace(
        ran_out, reachability=np.array([0, out, out, 0, 0]), contact=np.array([1, 0, 0, 0, 0], bool)
    )
    assert (
        reason(refused, 0.8, HORIZON)
        == "moves ran out, 2 moves out of reach, 1 move with the arm in the plant"
    )
    left = record(0, [0.1] * 3, False, reachability=np.array([out, out]))
    assert reason(left, 0.8, HORIZON) == (
        "the camera was sent out of the arm's workspace, which ends the episode, 1 move out of reach"
    )
    row = RowSearch(targets=(1, 2, 4), seen=(2,), moves=40, transits=2, path_m=1.0, joint_path_rad=3.0)
    assert reason(replace(ran_out, row=row), 0.8, HORIZON) == "1 of 3 tomatoes seen when moves ran out"


def test_a_robot_that_ends_the_search_of_a_row_too_early_has_failed() -> None:
    row = RowSearch(targets=(1, 2, 4), seen=(2, 7), moves=40, transits=2, path_m=1.0, joint_path_rad=3.0)
    early = list_episode(replace(record(0, [0.1, 0.9], True), row=row), 0.8, None, None)
    assert (early.success, early.reason) == (False, "1 of 3 tomatoes seen when the robot ended its search")
    whole = replace(row, seen=(1, 2, 4))
    assert list_episode(replace(record(0, [0.1, 0.9], True), row=whole), 0.8, None, None).success


def test_where_a_camera_decides_success_and_visible_fraction_are_the_true_ones() -> None:
    wrong = list_episode(with_camera(1, [0.1, 0.9], [0.1, 0.2], True, chosen=5), 0.8, HORIZON, None)
    assert (wrong.success, wrong.reason, wrong.best) == (False, "it looked at another fruit", 0.2)
    over = list_episode(with_camera(2, [0.1, 0.9], [0.1, 0.6], True, chosen=3), 0.8, HORIZON, None)
    assert (
        over.reason == "it stopped at the target, of which it saw less than it measured" and not over.success
    )
    right = list_episode(with_camera(3, [0.1, 0.9], [0.2, 0.85], True, chosen=3), 0.8, HORIZON, None)
    assert (right.success, right.reason, right.start, right.command) == (True, "", 0.2, "")


def test_a_long_list_keeps_its_failures_and_counts_what_it_leaves_out() -> None:
    records = [record(k, [0.1, 0.9], k != LISTED + 20) for k in range(LISTED + 30)]
    listed = list_episodes(records, 0.8, HORIZON, lambda seed: None)
    html = episode_list(listed, "nbv")
    assert len(lines(html)) == LISTED and lines(html)[0][0] == str(LISTED + 20)
    assert f"nbv: 1 of {LISTED + 30} episodes failed. The first {LISTED} lines are shown." in html
    assert html.startswith("<details>") and failures_first(listed)[0].seed == LISTED + 20


@pytest.mark.parametrize(
    ("env_id", "options"),
    [
        ("TomatoViewpointGuided-v1", {}),
        ("TomatoViewpointSparse-v1", {"plant": {"preset": "full", "seed": 4}, "plant_pose": [0.8, 0.1, 0.5]}),
        ("TomatoViewpoint-v1", {"episodes": "validation"}),
        ("TomatoViewpoint-v1", {"plant": {"seed": "held_out", "pool": 3}}),
        ("TomatoViewpoint-v1", {"episodes": "held_out", "perception": "occlusion_model", "target": "map"}),
        ("TomatoViewpoint-v1", {"episodes": "held_out", "perception": "segmenter", "render_backend": "auto"}),
    ],
)
def test_the_command_is_read_back_as_the_same_task(env_id: str, options: dict[str, Any]) -> None:
    command = replay_with_eval(env_id, "my policies/p.pt", 17, options, allow_other_task=True)
    assert command is not None
    words = shlex.split(command)
    assert words[0] == "maniskill-tomato"
    asked = parse(words[1:])
    found = {k: list(v) if isinstance(v, tuple) else v for k, v in asked.options_of_task().items()}
    assert (asked.env_id, asked.policy, asked.seed, asked.episodes) == (env_id, "my policies/p.pt", 17, 1)
    assert found == options and asked.allow_other_task


def test_options_without_a_flag_give_no_command() -> None:
    for options in (
        {},  # `eval` takes the held-out list.
        {"episodes": "held_out", "plant": {"mesh": "folder", "units": "cm"}},
        {"episodes": "held_out", "sensor_noise": {"depth_noise": 1.0}},
    ):
        assert replay_with_eval("TomatoViewpoint-v1", "nbv", 0, options) is None


def test_random_actions_of_the_thesis_s_tasks_have_no_such_command_and_the_page_says_why(
    tmp_path: Path,
) -> None:
    words = ["--policy", "random", "--episodes", "1", "--no-video", "--no-baseline", "--out", str(tmp_path)]
    main(["eval", "TomatoViewpointGuided-v1", *words])
    page = (tmp_path / "report.html").read_text()
    assert "one of them alone has other actions" in page
    assert len(lines(page)[0]) == 6 and "maniskill-tomato" not in lines(page)[0][5]
    assert "runs/again" not in page


@pytest.mark.parametrize("policy", ["nbv", "random_viewpoint"])
def test_the_command_of_the_list_runs_the_same_episode_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, policy: str
) -> None:
    monkeypatch.chdir(tmp_path)
    first = [
        "eval",
        "TomatoViewpoint-v1",
        "--policy",
        policy,
        "--episodes",
        "3",
        "--seed",
        "5",
        "--no-baseline",
    ]
    main([*first, "--episode-list", "validation", "--no-video", "--out", "first"])
    page = (tmp_path / "first" / "report.html").read_text()
    seed, _, moves, start, best, command = lines(page)[1]
    assert f"maniskill-tomato {' '.join(first)}" in page
    words = shlex.split(command.replace("&#x27;", "'"))
    main([*words[1:], "--no-video"])
    again = lines((tmp_path / f"runs/again-{seed}" / "report.html").read_text())[0]
    assert again[0] == seed and (again[2], again[3], again[4]) == (moves, start, best)
