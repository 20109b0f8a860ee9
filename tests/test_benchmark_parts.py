"""`scripts/benchmark.py --parts`: each in its own process, what it found kept however it ends."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import benchmark
from benchmarking.parts import LIMITS, STARTING, profile_tables, run_part, run_parts
from maniskill_tomato.errors import InvalidInputError

ROOT = Path(__file__).resolve().parents[1]
LITTLE: dict[str, Any] = {"device": "cpu", "envs": [1], "shells": 2, "seconds": 0.02}


def test_a_part_that_fails_keeps_what_it_found_and_the_next_is_done() -> None:
    results = dict(run_parts(["vector", "kernels"], {**LITTLE, "envs": [2, 0]}, limits_scale=5.0))
    assert results["vector"]["guided_2"]["steps_per_s"] > 0
    assert results["vector"]["guided_2"]["synchronisations_a_step"] == 1
    assert "InvalidInputError: num_envs must be" in results["vector"]["error"]
    assert "error" not in results["kernels"] and results["kernels"]["general_first_step_s"] > 0


def test_a_part_that_takes_too_long_is_ended() -> None:
    findings = run_part("kernels", LITTLE, limit=0.2 - STARTING)
    assert "took longer than its" in findings["error"]


def test_all_parts_together_take_about_eight_minutes_on_a_gpu() -> None:
    assert sum(limit for name, limit in LIMITS.items() if name != "profiles") <= 8.5 * 60


@pytest.mark.parametrize(
    ("options", "what"),
    [
        ({"parts": ("shell",), "compare": Path("old.json")}, "not with --parts"),
        ({"parts": ("shell",), "rivals": True}, "not with --parts"),
        ({"parts": ("shell",), "shells": 0}, "shells must be at least 1"),
        ({"limits_scale": 0.0}, "limits_scale must be above 0"),
        ({"envs": (4, 0)}, "envs must be numbers from 1"),
    ],
)
def test_options_that_do_not_go_together_are_refused_at_once(options: dict[str, Any], what: str) -> None:
    with pytest.raises(InvalidInputError, match=what):
        benchmark.Args(**options)


def test_profiles_of_the_same_stages_share_a_table() -> None:
    one = {"path": "a step", "ms": 2.0, "shares": {"rays": 0.75, "the rest": 0.25}}
    two = {"path": "ten steps", "ms": 1234.0, "shares": {"rays": 0.5, "the rest": 0.5}}
    other = {"path": "a look", "ms": 0.5, "shares": {"the rest": 1.0}}
    assert profile_tables({"steps": [one], "others": [other, two], "seconds": 3.0}).split("\n") == [
        "| part | a step: 2 ms | ten steps: 1.23e+03 ms |",
        "|---|---|---|",
        "| rays | 75% | 50% |",
        "| the rest | 25% | 50% |",
        "",
        "| part | a look: 0.5 ms |",
        "|---|---|",
        "| the rest | 100% |",
        "",
    ]


@pytest.mark.slow
@pytest.mark.render
def test_one_command_tells_everything_that_a_cpu_can_tell(tmp_path: Path) -> None:
    """With `--device cuda` the same is asked of a GPU; the tests it runs are left out here."""
    out = tmp_path / "parts.json"
    parts = [name for name in LIMITS if name not in ("tests", "profiles")]
    options = ["--envs", "1", "8", "--shells", "2", "--part-seconds", "0.2", "--limits-scale", "6"]
    script = [sys.executable, "-W", "ignore", str(ROOT / "scripts" / "benchmark.py"), "--parts", *parts]
    done = subprocess.run([*script, *options, "--out", str(out)], capture_output=True, text=True, timeout=580)
    run = json.loads(out.read_text())
    assert done.returncode == 0 and run["failed"] == [], done.stderr
    assert list(run["parts"]) == parts
    assert run["machine"]["processor"] and run["machine"]["accelerator"] is None
    assert set(run["parts"]["vector"]) == {"guided_1", "guided_8", "general_1", "general_8", "seconds"}
    assert run["parts"]["agreement"]["same_episodes"] == {
        "TomatoViewpointGuided-v1": 1.0,
        "TomatoViewpoint-v1": 1.0,
    }
    assert run["parts"]["rendering"]["general"]["shapes"]["depth"] == [2, 128, 128, 1]
    assert run["parts"]["fast-td3"]["training"]["updates"] > 0
