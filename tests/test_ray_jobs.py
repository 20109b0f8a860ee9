"""Jobs on a Ray cluster of this machine's processes: results, errors, lost workers, and whole commands."""

import importlib
import json
import math
import os
import secrets
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from maniskill_tomato.cli import main
from maniskill_tomato.errors import ClusterError
from maniskill_tomato.ray_jobs import jobs_on_ray
from maniskill_tomato.worker_pool import is_on_cluster, run_jobs

pytest.importorskip("ray", reason="ray is not installed; it is an extra")

WORK = """
import os, signal, time
from pathlib import Path

def note(job):
    folder, number, is_killed = job
    with (Path(folder) / "done").open("a") as file:
        file.write(f"{number}\\n")
    flag = Path(folder) / f"killed-{number}"
    if is_killed and not flag.exists():
        flag.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return number ** 2

def refuse(job):
    raise FileNotFoundError(f"nothing at {job}")

def where(job):
    return os.getcwd(), os.environ["OMP_NUM_THREADS"]

def warm():
    Path("warm").open("a").write(f"{os.getpid()}\\n")

def who(job):
    return os.getpid()
"""


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """Functions in a module that workers can import, and a cluster that stays for all tests."""
    folder = tmp_path_factory.mktemp("work")
    (folder / "ray_work.py").write_text(WORK)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_AUTH_TOKEN", secrets.token_hex(32))  # Otherwise Ray leaves one in the home folder.
        patch.setenv("RAY_worker_niceness", "0")  # Its own is 15, which starves workers beside other tests.
        patch.setenv("PYTHONPATH", f"{folder}{os.pathsep}{os.environ.get('PYTHONPATH', '')}")
        patch.delenv("RAY_ADDRESS", raising=False)
        patch.syspath_prepend(str(folder))
        functions = importlib.import_module("ray_work")
        with jobs_on_ray():
            yield functions
    sys.modules.pop("ray_work", None)


def test_every_job_comes_with_its_result(work: Any) -> None:
    assert is_on_cluster()
    results = dict(run_jobs(math.factorial, range(20), 1))
    assert results == {n: math.factorial(n) for n in range(20)}
    assert os.getpid() not in dict(run_jobs(work.who, range(4), 1)).values()


def test_a_job_whose_worker_is_killed_is_done_again_and_no_other(work: Any, tmp_path: Path) -> None:
    jobs = [(str(tmp_path), number, number == 3) for number in range(8)]
    results = {job[1]: result for job, result in run_jobs(work.note, jobs, 1)}
    assert results == {n: n**2 for n in range(8)}
    done = (tmp_path / "done").read_text().split()
    assert {n: done.count(str(n)) for n in range(8)} == {**dict.fromkeys(range(8), 1), 3: 2}


def test_an_error_of_a_job_is_raised_as_it_was(work: Any) -> None:
    with pytest.raises(FileNotFoundError, match="nothing at here"):
        list(run_jobs(work.refuse, ["here"], 1))


def test_workers_stand_in_the_same_folder_with_one_thread_and_are_warmed_up_once(
    work: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert set(dict(run_jobs(work.where, range(4), 1)).values()) == {(str(tmp_path), "1")}
    workers = set(dict(run_jobs(work.who, range(12), 1, warm_up=work.warm)).values())
    warmed = [int(line) for line in (tmp_path / "warm").read_text().split()]
    assert sorted(warmed) == sorted(workers)


@pytest.mark.parametrize("address", ["127.0.0.1:1", "127.0.0.1:here", "ray://127.0.0.1:1", "127.0.0.1:99999"])
def test_no_cluster_at_the_address_is_said_in_words(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RAY_ADDRESS", address)
    with pytest.raises(ClusterError, match=f"no Ray cluster answers at RAY_ADDRESS={address}"), jobs_on_ray():
        pass


def test_one_seed_needs_no_cluster(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["train", "TomatoViewpointGuided-v1", "--ray"])
    assert stop.value.code == 2
    assert "--seeds" in capsys.readouterr().err


@pytest.mark.slow
def test_seeds_trained_on_the_cluster_are_those_trained_here(
    work: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    little = ["--total-timesteps", "200", "--exploration-steps", "50"]
    for name, more in (("here", []), ("there", ["--ray"])):
        main(["train", "TomatoViewpointGuided-v1", "--seeds", "0", "1", "--out", name, *little, *more])
    for seed in (0, 1):
        here, there = (
            torch.load(tmp_path / name / f"seed-{seed}" / "policy.pt", weights_only=True)
            for name in ("here", "there")
        )
        assert here["actor"].keys() == there["actor"].keys()
        assert all(torch.equal(weights, there["actor"][name]) for name, weights in here["actor"].items())


@pytest.mark.slow
def test_a_benchmark_on_the_cluster_has_the_same_episodes(
    work: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    common = ["benchmark", "--policies", "nbv,random_viewpoint", "--episodes", "6", "--no-pictures"]
    for name, more in (("here", ["--jobs", "1"]), ("there", ["--ray"])):
        main([*common, "--out", name, *more])
    here, there = (json.loads((tmp_path / name / "benchmark.json").read_text()) for name in ("here", "there"))
    for one, other in zip(here, there, strict=True):
        for key in ("policy", "success_rate", "mean_moves", "mean_path_m", "spl"):
            assert one[key] == other[key]
