"""A robot's PC has neither ManiSkill nor SAPIEN: what runs there, and what says that it needs them."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from maniskill_tomato import cli

ROOT = Path(__file__).resolve().parents[2]

HIDE = """
from importlib.machinery import PathFinder

find = PathFinder.find_spec

def find_spec(name, path=None, target=None):
    return None if name.partition(".")[0] in ("mani_skill", "sapien") else find(name, path, target)

PathFinder.find_spec = find_spec
"""
"""A `sitecustomize` with which the simulator is not installed, in worker processes neither."""

REMEDY = "needs ManiSkill and SAPIEN, which are not installed here; `make venv KIND=full`"


def python(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    (folder / "sitecustomize.py").write_text(HIDE)
    return subprocess.run(
        [sys.executable, *words],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": f"{folder}{os.pathsep}{ROOT}"},
        capture_output=True,
        text=True,
        timeout=300,
    )


@pytest.mark.slow
def test_a_search_is_shown_without_the_simulator(tmp_path: Path) -> None:
    done = python(tmp_path, "-m", "maniskill_tomato.cli", "play", "--export", "page.html")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "page.html").stat().st_size > 100_000


def test_pictures_are_refused_with_what_installs_the_simulator(tmp_path: Path) -> None:
    done = python(tmp_path, "-m", "maniskill_tomato.cli", "dataset", "--count", "1", "--out", "pictures")
    assert done.returncode == 2
    assert done.stderr.startswith(f"error: this {REMEDY}") and done.stderr.count("\n") == 1


@pytest.mark.parametrize(("module", "words"), [("sapien.render", REMEDY), ("cv2", "this is a fault of")])
def test_a_missing_module_of_the_simulator_is_no_fault_of_the_program(
    module: str, words: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def run(argv: list[str]) -> None:
        raise ModuleNotFoundError(f"No module named {module!r}", name=module)

    monkeypatch.setattr(cli, "run", run)
    with pytest.raises(SystemExit):
        cli.main(["demonstrations"])
    told = capsys.readouterr().err
    assert words in told and ("Traceback" in told) == (words != REMEDY)


def test_a_task_of_gymnasium_says_that_it_needs_the_simulator(tmp_path: Path) -> None:
    code = "import gymnasium as gym, maniskill_tomato; gym.make('TomatoViewpoint-v1')"
    done = python(tmp_path, "-c", code)
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].startswith(
        "maniskill_tomato.errors.MissingPackageError: this " + REMEDY
    )
