"""`make venv`: the sorts of environment, what is said before anything is downloaded, and what another sort does."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent

pytestmark = pytest.mark.skipif(
    not (ROOT / "scripts" / "setup_env.sh").is_file(), reason="the tests run outside a checkout"
)


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A checkout without code, in a folder whose name has a space and an umlaut."""
    folder = tmp_path / "grüne Tomaten"
    (folder / "scripts").mkdir(parents=True)
    for name in ("Makefile", "scripts/setup_env.sh", "scripts/preamble.sh"):
        shutil.copy2(ROOT / name, folder / name)
    for name in (
        "pyproject.toml",
        "constraints.txt",
        "overrides.txt",
        "overrides-cpu.txt",
        "overrides-robot.txt",
    ):
        (folder / name).touch()
    return folder


def install(checkout: Path, sort: str) -> Path:
    """Puts an environment there whose programs write down what they were asked; returns what they write to."""
    programs = checkout / ".venv" / "bin"
    programs.mkdir(parents=True)
    (programs / "python").symlink_to(sys.executable)
    asked = checkout / "asked"
    for name in ("uv", "maniskill-tomato"):
        program = programs / name
        program.write_text(
            f'#!/bin/bash\necho "{name} $*" >>"{asked}"\n[[ -z ${{NO_CPU_BUILDS:-}} || $* != *--torch-backend* ]]\n'
        )
        program.chmod(0o755)
    (checkout / ".venv" / ".installed-kind").write_text(f"{sort}\n")
    (checkout / ".venv" / ".installed-from").write_text(f"{checkout}\n")
    return asked


def run(checkout: Path, *command: str, **environment: str) -> subprocess.CompletedProcess[str]:
    cleared = {key: value for key, value in os.environ.items() if key not in ("TORCH", "KIND", "PYTHON")}
    return subprocess.run(
        command, cwd=checkout, env={**cleared, **environment}, capture_output=True, text=True, timeout=60
    )


def plan(checkout: Path, **environment: str) -> str:
    done = run(checkout, "bash", "scripts/setup_env.sh", "--dry-run", **environment)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_size_of_every_sort_is_said_and_the_smaller_sorts_are_smaller(checkout: Path) -> None:
    def disk(**sort: str) -> float:
        return float(plan(checkout, **sort).split("GB to download, ")[1].split(" GB of disk")[0])

    assert disk() == disk(TORCH="cuda", KIND="full")
    assert disk(TORCH="cpu", KIND="robot") < disk(TORCH="cpu") < disk(KIND="robot") < disk()
    assert not (checkout / ".venv").exists()


@pytest.mark.parametrize(
    ("variable", "allowed"), [("TORCH", "Give cuda or cpu."), ("KIND", "Give full or robot.")]
)
def test_an_unknown_sort_is_refused_with_those_that_exist(
    checkout: Path, variable: str, allowed: str
) -> None:
    install(checkout, "cpu full")
    done = run(checkout, "make", "venv", f"{variable}=cup")
    assert done.returncode != 0 and f"{variable}=cup is unknown" in done.stderr and allowed in done.stderr
    assert (checkout / ".venv" / "bin" / "uv").is_file()


def test_an_environment_stays_what_it_is_until_another_sort_is_asked_for(checkout: Path) -> None:
    install(checkout, "cpu robot")
    assert "TORCH=cpu KIND=robot" in plan(checkout) and "anew" not in plan(checkout)
    assert "anew: it has TORCH=cpu KIND=robot, not TORCH=cuda KIND=robot" in plan(checkout, TORCH="cuda")
    for same in ((), ("TORCH=cpu",), ("KIND=robot", "TORCH=cpu")):
        assert "setup_env" not in run(checkout, "make", "-n", "demo", *same).stdout
    for other in ("TORCH=cuda", "KIND=full"):
        assert "scripts/setup_env.sh" in run(checkout, "make", "-n", "demo", other).stdout


def test_targets_for_development_are_refused_on_a_robots_pc_with_the_remedy(checkout: Path) -> None:
    install(checkout, "cuda robot")
    done = run(checkout, "make", "test")
    assert done.returncode != 0 and "make venv KIND=full installs them" in done.stderr
    assert run(checkout, "make", "demo").returncode == 0


def test_torch_for_the_cpu_comes_from_its_own_builds_where_they_can_be_reached(checkout: Path) -> None:
    asked = install(checkout, "cpu full")
    done = run(checkout, "bash", "scripts/setup_env.sh")
    assert done.returncode == 0, done.stderr
    assert "cannot be reached" not in done.stdout
    installing = asked.read_text().splitlines()[1]
    assert installing.endswith("--torch-backend cpu") and "overrides-cpu.txt" not in installing


def test_where_the_builds_for_the_cpu_cannot_be_reached_a_sentence_says_what_is_taken(checkout: Path) -> None:
    asked = install(checkout, "cpu robot")
    done = run(checkout, "bash", "scripts/setup_env.sh", NO_CPU_BUILDS="1")
    assert done.returncode == 0, done.stderr
    assert "builds for the CPU cannot be reached from here, so its usual build is taken" in done.stdout
    installing = asked.read_text().splitlines()[1]
    assert "--torch-backend" not in installing and "--override overrides-cpu.txt" in installing
    assert "--override overrides-robot.txt" in installing and "[perception,deploy,hardware]" in installing
    assert (checkout / ".venv" / ".installed-kind").read_text() == "cpu robot\n"
