"""Commands that are killed at random moments end as unbroken ones: `scripts/check_kills.py`, with few kills."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.slow
@pytest.mark.parametrize("command", ["train", "benchmark", "detect", "inspect"])
def test_killed_commands_end_as_unbroken_ones(tmp_path: Path, command: str) -> None:
    check(tmp_path, command)


@pytest.mark.slow
@pytest.mark.render
def test_a_data_set_whose_rendering_was_killed_ends_as_an_unbroken_one(tmp_path: Path) -> None:
    check(tmp_path, "dataset")


def check(folder: Path, command: str) -> None:
    arguments = ["--commands", command, "--kills", "3", "--seed", "1", "--out", str(folder / "kills.json")]
    result = subprocess.run(
        [sys.executable, str(ROOT / "scripts" / "check_kills.py"), *arguments],
        capture_output=True,
        text=True,
        timeout=590,
    )
    assert result.returncode == 0, result.stdout + result.stderr
    outcome = json.loads((folder / "kills.json").read_text())["commands"][command]
    assert (outcome["kills"], outcome["differing"], outcome["left_running"]) == (3, [], 0)
