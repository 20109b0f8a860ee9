"""`scripts/compare_twin.py`: the twin beside the simulated task."""

import importlib.util
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

SCRIPT = Path(__file__).parents[2] / "scripts" / "compare_twin.py"


def script() -> Any:
    spec = importlib.util.spec_from_file_location("compare_twin", SCRIPT)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


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
    found = script().summary(
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


def test_the_script_runs_an_episode_on_both_and_goes_on_where_it_was(tmp_path: Path) -> None:
    command = [sys.executable, str(SCRIPT), "--seed", "6", "--episodes", "1", "--out", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=500)
    assert done.returncode == 0, done.stderr
    content = json.loads((tmp_path / "summary.json").read_text())
    assert content["episodes"] == 1 and content["reasons"] == {"success": 1}
    kept = (tmp_path / "episodes.json").read_bytes()
    again = subprocess.run(command, capture_output=True, text=True, timeout=500)
    assert again.returncode == 0 and (tmp_path / "episodes.json").read_bytes() == kept
    wrong = subprocess.run([*command, "--profile", "nothing"], capture_output=True, text=True, timeout=500)
    assert wrong.returncode == 2 and wrong.stderr.startswith("error: no profile 'nothing'")
