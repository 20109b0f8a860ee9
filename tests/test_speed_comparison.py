"""`scripts/benchmark.py --compare`: what got slower between two runs, on runs that are made up."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from benchmarking.comparison import (
    check_same_kind,
    compare_rates,
    comparison_text,
    read_run,
)
from maniskill_tomato.errors import InvalidInputError

ROOT = Path(__file__).resolve().parents[1]


def rates(**turns: list[float]) -> dict[str, dict[str, float]]:
    middle = {name: sorted(values)[len(values) // 2] for name, values in turns.items()}
    return {
        name: {"median": middle[name], "low": min(values), "high": max(values)}
        for name, values in turns.items()
    }


OLD = rates(yardstick=[10, 10, 10], steps=[95, 100, 105], resets=[9, 10, 11], rays=[1, 1, 1])


@pytest.mark.parametrize(
    ("turns", "verdict"),
    [
        ([75, 80, 85], "slower"),
        ([80, 84, 96], "same"),  # One turn was as quick as the old run's slowest.
        ([92, 93, 94], "same"),  # Apart, but by less than a tenth.
        ([115, 120, 125], "faster"),
    ],
)
def test_a_rate_is_slower_where_turns_and_medians_say_so(turns: list[float], verdict: str) -> None:
    new = rates(yardstick=[10, 10, 10], steps=turns)
    (change,), alone = compare_rates(OLD, new)
    assert change.verdict == verdict
    assert change.ratio == pytest.approx(sorted(turns)[1] / 100)
    assert alone == ["rays", "resets"]


def test_a_busy_machine_is_no_change() -> None:
    half = {name: [value / 2 for value in rate.values()] for name, rate in OLD.items()}
    changes, _ = compare_rates(OLD, rates(**half))
    assert {change.verdict for change in changes} == {"same"}


def test_the_text_names_what_changed_and_what_one_run_lacks() -> None:
    new = rates(yardstick=[10, 10, 10], steps=[75, 80, 85], resets=[9, 10, 11])
    lines = comparison_text(*compare_rates(OLD, new)).splitlines()
    assert lines == [
        "slower   0.80 x  steps",
        "1 of 2 rates are the same within the noise",
        "in one run only: rays",
    ]


@pytest.mark.parametrize(
    "content",
    [
        "[]",
        "{}",
        '{"machine": {"processor": "a"}, "rates": {}}',
        '{"machine": {"processor": "a"}, "rates": {"yardstick": {"median": 0, "low": 0, "high": 0}}}',
        '{"machine": {}, "rates": {"yardstick": {"median": 1, "low": 1, "high": 1}}}',
        "\x00",
    ],
)
def test_what_is_no_run_is_refused(tmp_path: Path, content: str) -> None:
    path = tmp_path / "old.json"
    path.write_text(content)
    with pytest.raises(InvalidInputError, match=r"old\.json"):
        read_run(path)


def test_runs_of_different_machines_are_not_compared(tmp_path: Path) -> None:
    run: dict[str, Any] = {"machine": {"processor": "a", "accelerator": None}, "rates": OLD}
    path = tmp_path / "old.json"
    path.write_text(json.dumps(run))
    old = read_run(path)
    check_same_kind(old, {"processor": "a", "accelerator": None})
    with pytest.raises(InvalidInputError, match="processor 'a', here 'b'"):
        check_same_kind(old, {"processor": "b", "accelerator": None})
    with pytest.raises(InvalidInputError, match="accelerator None, here 'H'"):
        check_same_kind(old, {"processor": "a", "accelerator": "H"})


@pytest.mark.slow
def test_the_script_measures_compares_and_fails_where_a_rate_fell(tmp_path: Path) -> None:
    script = [sys.executable, "-W", "ignore", str(ROOT / "scripts" / "benchmark.py")]
    little = ["--repeats", "2", "--envs", "1", "--memory-steps", "50", "--memory-vector-steps", "640"]
    little += ["--memory-resets", "5", "--look-episodes", "1"]
    first = tmp_path / "first.json"
    subprocess.run([*script, *little, "--out", str(first)], check=True, capture_output=True, timeout=900)
    run = json.loads(first.read_text())
    for rate in run["rates"].values():
        rate.update({key: value * 10 for key, value in rate.items()})
    run["rates"]["yardstick"] = {key: value / 10 for key, value in run["rates"]["yardstick"].items()}
    older = tmp_path / "older.json"
    older.write_text(json.dumps(run))
    options = [*little, "--out", str(tmp_path / "second.json"), "--compare", str(older)]
    second = subprocess.run([*script, *options], check=False, capture_output=True, text=True, timeout=900)
    assert second.returncode == 1
    assert "slower" in second.stdout
    assert "guided/steps" in second.stdout.rpartition("\n}")[2]


@pytest.mark.slow
def test_rivals_write_tables_of_what_is_installed(tmp_path: Path) -> None:
    script = [sys.executable, "-W", "ignore", str(ROOT / "scripts" / "benchmark.py"), "--rivals"]
    little = ["--repeats", "1", "--envs", "1", "--poses", "200", "--out", str(tmp_path / "rivals.json")]
    subprocess.run([*script, *little], check=True, capture_output=True, timeout=900)
    rows = json.loads((tmp_path / "rivals.json").read_text())["inverse_kinematics"]
    ours = {row["solver"]: row for row in rows if row["solver"].startswith("ours")}
    assert all(row["solved"] == 1.0 and row["narrow_solved"] == 1.0 for row in ours.values())
    assert all(row["largest_error_m"] < 1e-9 for row in ours.values())
    table = (tmp_path / "rivals.md").read_text()
    assert "| mink | 200 |" in table
    assert table.count("\n## ") + table.startswith("## ") == 3
