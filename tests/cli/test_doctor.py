"""`doctor` says what is there, what is missing and what is broken, whatever state the environment is in."""

import os
import shutil
import subprocess
import sys
from collections import namedtuple
from pathlib import Path

import pytest

from maniskill_tomato.cli.doctor_command import check_disk

ROOT = Path(__file__).resolve().parents[2]

Usage = namedtuple("Usage", "total used free")


def doctor(*options: str, first: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """Runs it with a folder in which Python looks for packages first."""
    return subprocess.run(
        [sys.executable, "-m", "maniskill_tomato.cli", "doctor", *options],
        capture_output=True,
        text=True,
        cwd=first,
        env={**os.environ, "PYTHONPATH": f"{first}{os.pathsep}{ROOT}", **environment},
        timeout=300,
        check=False,
    )


def test_a_second_wheel_of_cv2_is_a_problem_with_the_command_that_mends_it(tmp_path: Path) -> None:
    wheel = tmp_path / "opencv_python-4.0.0.dist-info"
    wheel.mkdir()
    (wheel / "METADATA").write_text("Metadata-Version: 2.1\nName: opencv-python\nVersion: 4.0.0\n")
    done = doctor("--packages", first=tmp_path)
    lines = done.stdout.splitlines()
    (at,) = (k for k, line in enumerate(lines) if line.startswith("problem"))
    assert "opencv-python 4.0.0, opencv-python-headless" in lines[at] and "make venv" in lines[at + 1]
    assert done.returncode == 1 and done.stderr == "error: 1 problem; the lines above say what to do\n"


def test_a_package_that_does_not_load_is_one_line_and_the_other_checks_go_on(tmp_path: Path) -> None:
    (tmp_path / "mani_skill").mkdir()
    (tmp_path / "mani_skill" / "__init__.py").write_text("raise RuntimeError('cut off in the middle')\n")
    done = doctor("--packages", first=tmp_path)
    assert "maniskill: RuntimeError: cut off in the middle" in done.stdout and "Traceback" not in done.stderr
    assert "ok       torch " in done.stdout and done.returncode == 1


def test_a_folder_for_kernels_that_cannot_be_written_is_a_problem(tmp_path: Path) -> None:
    done = doctor(first=tmp_path, WARP_CACHE_PATH=f"{os.devnull}/kernels")
    assert f"problem  warp cannot keep its kernels in {os.devnull}/kernels" in done.stdout
    assert "set WARP_CACHE_PATH" in done.stdout and "ok       cv2 from opencv-python-headless" in done.stdout
    assert done.returncode == 1


def test_a_disk_that_is_nearly_full_is_a_problem(monkeypatch: pytest.MonkeyPatch) -> None:
    for free, state in ((3 * 10**8, "problem"), (3 * 10**9, "ok")):
        monkeypatch.setattr(shutil, "disk_usage", lambda path, free=free: Usage(10**11, 10**11 - free, free))
        finding = check_disk()
        assert finding.state == state and f"{free / 1e9:.1f} GB free in {Path.cwd()}" in finding.words
