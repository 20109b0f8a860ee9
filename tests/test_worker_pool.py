"""Work in several processes: results, errors, and processes that end with the one that started them."""

import math
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from process_watch import is_running, until

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.worker_pool import run_jobs


@pytest.mark.parametrize("processes", [1, 2])
def test_every_job_comes_with_its_result(processes: int) -> None:
    results = dict(run_jobs(math.factorial, range(8), processes))
    assert results == {n: math.prod(range(1, n + 1)) for n in range(8)}


def test_one_process_is_this_one_and_is_warmed_up_before_its_first_job() -> None:
    calls: list[str] = []

    def job(name: str) -> int:
        calls.append(name)
        return os.getpid()

    results = list(run_jobs(job, ["a", "b"], 1, warm_up=lambda: calls.append("warm")))
    assert results == [("a", os.getpid()), ("b", os.getpid())]
    assert calls == ["warm", "a", "b"]


def test_a_job_that_fails_raises_here_and_leaves_no_process(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        list(run_jobs(os.listdir, [str(tmp_path / "missing"), *[str(tmp_path)] * 4], 2))
    assert until(lambda: not multiprocessing.active_children())


def test_a_loop_that_is_left_ends_the_jobs_that_are_running(tmp_path: Path) -> None:
    jobs = run_jobs(time.sleep, [0.0, 3600.0, 3600.0], 2)
    assert next(jobs) == (0.0, None)
    jobs.close()  # type: ignore[attr-defined]
    assert until(lambda: not multiprocessing.active_children())


def test_no_process_at_all_is_refused() -> None:
    with pytest.raises(InvalidInputError, match="1 or more, got 0"):
        next(run_jobs(math.factorial, [1], 0))


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="reads the states of processes from /proc")
def test_workers_end_when_the_process_that_started_them_is_killed(tmp_path: Path) -> None:
    script = (
        "import functools, multiprocessing, sys, tempfile, threading, time\n"
        "from maniskill_tomato.worker_pool import run_jobs\n"
        "def tell():\n"
        "    while len(multiprocessing.active_children()) < 2: time.sleep(0.05)\n"
        "    print(*[p.pid for p in multiprocessing.active_children()], flush=True)\n"
        "threading.Thread(target=tell).start()\n"
        "warm_up = functools.partial(tempfile.mkdtemp, dir=sys.argv[1])\n"
        "list(run_jobs(time.sleep, [3600.0, 3600.0], 2, warm_up=warm_up))\n"
    )
    command = [sys.executable, "-c", script, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        workers = [int(pid) for pid in parent.stdout.readline().split()]
        assert len(workers) == 2
        try:
            # Each makes a folder before its first job.
            assert until(lambda: len(list(tmp_path.iterdir())) == 2)
            assert all(is_running(pid) for pid in workers)
        finally:
            parent.send_signal(signal.SIGKILL)
    assert until(lambda: not any(is_running(pid) for pid in workers))


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="reads the states of processes from /proc")
@pytest.mark.parametrize("deaf", [False, True])
def test_a_process_ends_when_the_one_that_started_it_is_killed(tmp_path: Path, deaf: bool) -> None:
    """Also one that does not hear SIGTERM."""
    script = (
        "import signal, sys, time\n"
        "from maniskill_tomato.worker_pool import start_process\n"
        f"function, argument = {'signal.sigwait, [signal.SIGUSR1]' if deaf else 'time.sleep, 3600.0'}\n"
        "if function is signal.sigwait: signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGTERM])\n"
        "print(start_process(function, argument, grace=0.5).pid, flush=True)\n"
        "time.sleep(3600)\n"
    )
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        child = int(parent.stdout.readline())
        assert until(lambda: is_running(child))
        parent.send_signal(signal.SIGKILL)
    assert until(lambda: not is_running(child))
