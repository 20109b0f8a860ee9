"""Work shared among several processes that end with the one that started them, however that ends."""

import contextlib
import multiprocessing
import multiprocessing.connection
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextvars import ContextVar
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any, Final, TypeVar

from maniskill_tomato.errors import InvalidInputError

Cluster = Callable[
    [Callable[[Any], Any], Sequence[Any], Callable[[], None] | None], Iterator[tuple[Any, Any]]
]
"""Does the jobs of `run_jobs` elsewhere: a function, the jobs, and what warms a worker up."""

_cluster: ContextVar[Cluster | None] = ContextVar("cluster", default=None)

Job = TypeVar("Job")
Result = TypeVar("Result")

ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENCV_FOR_THREADS_NUM": "1", "LP_NUM_THREADS": "1"}
"""Variables that keep numerical libraries, OpenCV and Mesa's CPU renderer from taking all cores in each process."""

GRACE_SECONDS: Final = 120.0
"""How long a process may take to save its work and end when the one that started it is gone."""


@contextlib.contextmanager
def working_on(cluster: Cluster) -> Iterator[None]:
    """Lets a cluster do the jobs of `run_jobs` meanwhile, however many processes are asked for."""
    token = _cluster.set(cluster)
    try:
        yield
    finally:
        _cluster.reset(token)


def is_on_cluster() -> bool:
    """Whether a cluster does the jobs of `run_jobs`."""
    return _cluster.get() is not None


def run_jobs(
    function: Callable[[Job], Result],
    jobs: Sequence[Job],
    processes: int,
    warm_up: Callable[[], None] | None = None,
) -> Iterator[tuple[Job, Result]]:
    """Calls a function with every job; yields each job with its result as it becomes known.

    An exception of the function is raised here and ends the other processes, as does leaving the loop early. Within
    `working_on` a cluster does the jobs.

    Args:
        function: A function of a module, since other processes must find it.
        jobs: What it is called with; they are begun in this order.
        processes: How many at a time; 1 stands for this process itself.
        warm_up: Called once in each process before its first job.

    Raises:
        InvalidInputError: `processes` is less than 1.
    """
    if processes < 1:
        raise InvalidInputError(f"the number of processes must be 1 or more, got {processes}")
    if (cluster := _cluster.get()) is not None and jobs:
        yield from cluster(function, jobs, warm_up)
        return
    if processes == 1 or not jobs:
        if jobs and warm_up is not None:
            warm_up()
        for job in jobs:
            yield job, function(job)
        return
    # A forked child would share Warp's and the simulator's state with this process.
    context = multiprocessing.get_context("spawn")
    others = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(
        min(processes, len(jobs)), mp_context=context, initializer=_start_worker, initargs=(warm_up,)
    )
    try:
        with _environment(ONE_THREAD):
            futures = {pool.submit(function, job): job for job in jobs}
        for future in as_completed(futures):
            yield futures[future], future.result()
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        for worker in set(multiprocessing.active_children()) - others:
            worker.kill()
        raise
    finally:
        pool.shutdown()


def start_process(
    function: Callable[..., None], *arguments: Any, grace: float = GRACE_SECONDS
) -> BaseProcess:
    """Calls a function in a process of its own, which gets SIGTERM when this one ends, however that ends.

    Args:
        function: A function of a module, since the process must find it.
        arguments: What it is called with.
        grace: Seconds that it then has to end by itself; after them it is ended.
    """
    process = multiprocessing.get_context("spawn").Process(
        target=_run_alone, args=(function, arguments, grace)
    )
    # Until the process has a session of its own, Ctrl-C in the terminal would reach it too.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        process.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    return process


def start_worker(
    function: Callable[..., None], *arguments: Any
) -> tuple["subprocess.Popen[bytes]", Connection]:
    """Calls a function in a new interpreter at the other end of a pipe, which closes when this process ends.

    Nothing of this process's script is run again there, other than by the processes of `multiprocessing`. The process
    computes with one thread. Ctrl-C does not reach it.

    Args:
        function: A function of a module, since the process must find it. Its first argument is the process's end of
            the pipe; it returns when receiving raises `EOFError`.
        arguments: What else it is called with.

    Returns:
        The process and this one's end of the pipe.
    """
    ours, theirs = multiprocessing.Pipe()
    paths = os.pathsep.join(path for path in sys.path if path)
    with contextlib.closing(theirs):
        process = subprocess.Popen(
            [sys.executable, "-P", "-c", f"from {__name__} import serve; serve({theirs.fileno()})"],
            stdin=subprocess.DEVNULL,
            env={**ONE_THREAD, **os.environ, "PYTHONPATH": paths},
            pass_fds=[theirs.fileno()],
            start_new_session=True,
        )
    with contextlib.suppress(BrokenPipeError):  # It ended at once, which whoever receives is told.
        ours.send((function, arguments))
    return process, ours


def serve(handle: int) -> None:
    """The work of a process of `start_worker`.

    Args:
        handle: The file descriptor of its end of the pipe.
    """
    with contextlib.closing(Connection(handle)) as connection, contextlib.suppress(EOFError, BrokenPipeError):
        function, arguments = connection.recv()
        function(connection, *arguments)


def _run_alone(function: Callable[..., None], arguments: tuple[Any, ...], grace: float) -> None:
    os.setsid()
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})

    def end() -> None:
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(grace)
        os._exit(1)

    _when_parent_ends(end)
    function(*arguments)


def _start_worker(warm_up: Callable[[], None] | None) -> None:
    import torch

    # Ctrl-C in a terminal reaches every process of it; the first one decides.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _when_parent_ends(lambda: os._exit(1))
    torch.set_num_threads(1)
    if warm_up is not None:
        warm_up()


def _when_parent_ends(act: Callable[[], None]) -> None:
    """Waits beside the work for the other end of a pipe, which the system closes even for a process that is killed."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait() -> None:
        multiprocessing.connection.wait([parent.sentinel])
        act()

    threading.Thread(target=wait, daemon=True).start()


@contextlib.contextmanager
def _environment(variables: dict[str, str]) -> Iterator[None]:
    """Environment variables for the processes that are started meanwhile, unless they have a value."""
    new = {name: value for name, value in variables.items() if name not in os.environ}
    os.environ.update(new)
    try:
        yield
    finally:
        for name in new:
            del os.environ[name]
