"""The twin beside the simulated task."""

import json
import re
from pathlib import Path
from typing import Any

import pytest
import torch

from maniskill_tomato.deploy.deploy_errors import ProfileError
from maniskill_tomato.deploy.mock.episode import load_episode
from maniskill_tomato.deploy.profile import load_profile
from maniskill_tomato.errors import TomatoError
from maniskill_tomato.experiments.configs import TwinConfig
from maniskill_tomato.experiments.twin_comparison import compare_twin, simulated_task, summarise_twin


def episode(number: int, twin: bool, simulated: bool, moves: int, truly: bool = True) -> dict[str, Any]:
    return {
        "episode": number,
        "twin": {
            "success": twin,
            "truly_visible": twin and truly,
            "reason": "success" if twin else "budget",
            "moves": moves,
            "refused_moves": 1,
            "cpu_seconds": 2.0,
            "device_seconds": 10.0 * moves,
            "steps": [{"timing_ms": {"capture": 50.0}}, {"timing_ms": {"capture": 70.0, "policy": 4.0}}],
        },
        "simulation": {"success": simulated, "moves": 2, "contact": number == 0},
    }


def test_the_summary_counts_what_a_pencil_counts() -> None:
    cannot = episode(3, False, True, 1)
    cannot["twin"] = {"success": False, "reason": "cannot begin", "detail": "no", "steps": []}
    found = summarise_twin(
        [
            episode(0, True, True, 4),
            episode(1, True, False, 6, truly=False),
            episode(2, False, True, 10),
            cannot,
        ]
    )
    assert (found["twin_success"], found["simulation_success"], found["episodes"]) == (2, 3, 4)
    assert (found["only_twin"], found["only_simulation"], found["twin_success_and_truly_visible"]) == (
        1,
        2,
        1,
    )
    assert found["mcnemar_p"] == 1.0
    assert found["failed"] == [2, 3] and found["reasons"] == {"success": 2, "budget": 1, "cannot begin": 1}
    assert found["twin_moves_of_successes"] == 5.0 and found["refused_share_of_moves"] == pytest.approx(
        3 / 20
    )
    assert found["stage_ms_mean"] == {"capture": 60.0, "policy": 4.0} and found["looks"] == 6
    assert found["simulation_contact_share_of_episodes"] == 0.25
    assert found["truly_visible_share_of_success"] == 0.5 and found["false_success"] == [1]
    low, high = found["truly_visible_share_interval_95"]
    assert (low, high) == (pytest.approx(0.0945, abs=1e-4), pytest.approx(0.9055, abs=1e-4)), (
        "Wilson's, of 1 in 2"
    )


def test_where_no_run_began_there_are_rates_and_no_means() -> None:
    cannot = episode(0, False, False, 1)
    cannot["twin"] = {"success": False, "reason": "cannot begin", "detail": "no", "steps": []}
    found = summarise_twin([cannot])
    assert (found["twin_success"], found["reasons"], found["looks"]) == (0, {"cannot begin": 1}, 0)
    means = ("twin_moves_of_successes", "simulation_moves_of_successes", "refused_share_of_moves")
    costs = ("cpu_seconds_a_run", "device_seconds_median", "truly_visible_share_of_success")
    assert all(found[name] is None for name in (*means, *costs))
    json.dumps(found, allow_nan=False)


def test_both_run_the_episodes_of_the_profiles_list(tmp_path: Path) -> None:
    profile = tmp_path / "mine.toml"
    profile.write_text('[arm]\ndriver = "mock"\n[camera]\ndriver = "mock"\n[twin]\nepisodes = "validation"\n')
    env = simulated_task(load_profile(str(profile)))
    env.reset(seed=3)
    simulated: Any = env.unwrapped
    expected = load_episode("validation", 3)
    assert torch.equal(simulated.target_position_w[0], expected.target_position)
    env.close()
    with pytest.raises(ProfileError, match="only where both are mock is there a twin"):
        compare_twin(TwinConfig(profile="iiwa14_d435", out=tmp_path / "out"))


def test_an_episode_runs_on_both_and_is_not_run_again(tmp_path: Path) -> None:
    config = TwinConfig(seed=6, episodes=1, out=tmp_path)
    lines: list[str] = []
    content = compare_twin(config, lines.append)
    assert content["episodes"] == 1 and content["reasons"] == {"success": 1}
    assert lines[0].startswith("  6  twin success")
    page = (tmp_path / "report.html").read_text()
    assert (
        "maniskill-tomato deploy run --profile mock --seed 6" in re.sub("<[^>]+>", "", page)
        and page.count("n = 1 episodes") >= 5
    )
    assert json.loads((tmp_path / "summary.json").read_text())["looks"] == content["looks"]
    stored = {path: path.read_bytes() for path in tmp_path.rglob("*.jsonl")}
    assert len(stored) == 1
    assert compare_twin(config, lines.append)["looks"] == content["looks"] and len(lines) == 1
    assert {path: path.read_bytes() for path in tmp_path.rglob("*.jsonl")} == stored
    with pytest.raises(TomatoError, match="no profile 'nothing'"):
        compare_twin(TwinConfig(profile="nothing", out=tmp_path))
