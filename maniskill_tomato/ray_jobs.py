"""The jobs of `worker_pool.run_jobs` on the machines of a Ray cluster (extra `ray`, docs/clusters.md)."""

import contextlib
import os
import socket
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

from maniskill_tomato.errors import ClusterError, MissingPackageError
from maniskill_tomato.worker_pool import ONE_THREAD, working_on

ADDRESS: Final = "RAY_ADDRESS"
"""Environment variable with the address of a running cluster, as Ray itself reads it."""

CONNECTION_SECONDS: Final = 10.0

_warmed_up: set[str] = set()
"""What this process, one of a cluster's workers, has done once."""


@contextlib.contextmanager
def jobs_on_ray(wanted: bool = True) -> Iterator[None]:
    """Sends the jobs of `run_jobs` to Ray meanwhile: to the cluster at `RAY_ADDRESS`, else to one of this machine.

    A job whose worker or node is lost is done again elsewhere; nothing else is. All nodes need this package in the same
    version, and the working directory under the same path, because jobs read and write files there.

    Args:
        wanted: False leaves everything as it is.

    Raises:
        MissingPackageError: Ray is not installed.
        ClusterError: No cluster answers at `RAY_ADDRESS`, or none can be started.
    """
    if not wanted:
        yield
        return
    address = os.environ.get(ADDRESS)
    if address:
        _check_answers(address)
    ray = _import_ray()
    if ray.is_initialized():
        with working_on(_run):
            yield
        return
    joined = {"address": address} if address else {"address": "local", "include_dashboard": False}
    try:
        ray.init(**joined, log_to_driver=False, logging_level="ERROR")
    except Exception as error:
        where = f"no Ray cluster answers at {ADDRESS}={address}" if address else "Ray cannot be started here"
        raise ClusterError(f"{where}: {error}") from error
    try:
        with working_on(_run):
            yield
    finally:
        ray.shutdown()


def _check_answers(address: str) -> None:
    """Asks for a connection, since Ray itself tries for minutes; `auto` and `local` name no host."""
    host, colon, port = address.removeprefix("ray://").rpartition(":")
    if not colon:
        return
    try:
        with socket.create_connection((host, int(port)), CONNECTION_SECONDS):
            pass
    except (OSError, ValueError, OverflowError) as error:
        raise ClusterError(
            f"no Ray cluster answers at {ADDRESS}={address}: {error}; `ray status` there tells whether it runs, and "
            f"without {ADDRESS} one of this machine is started"
        ) from error


def _import_ray() -> Any:
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        import ray  # pyright: ignore[reportMissingImports] # An extra of its own.
    except ImportError as error:
        raise MissingPackageError.extra("ray", "ray") from error
    return ray


def _run(
    function: Callable[[Any], Any], jobs: Sequence[Any], warm_up: Callable[[], None] | None
) -> Iterator[tuple[Any, Any]]:
    """See `run_jobs`."""
    ray = _import_ray()
    remote = ray.remote(_do).options(
        num_cpus=1, max_retries=-1, runtime_env={"env_vars": {**ONE_THREAD, "RAY_USAGE_STATS_ENABLED": "0"}}
    )
    here = str(Path.cwd())
    waiting = {remote.remote(function, job, warm_up, here): job for job in jobs}
    try:
        while waiting:
            (done,), _ = ray.wait(list(waiting), num_returns=1)
            job = waiting.pop(done)
            try:
                result = ray.get(done)
            except ray.exceptions.RayTaskError as error:
                raise error.cause from error
            except ray.exceptions.RayError as error:
                raise ClusterError(f"the cluster could not do a job: {error}") from error
            yield job, result
    finally:
        for left in waiting:
            ray.cancel(left, force=True)


def _do(function: Callable[[Any], Any], job: Any, warm_up: Callable[[], None] | None, folder: str) -> Any:
    """One job, in a worker of the cluster."""
    import torch

    if not os.path.isdir(folder):
        raise ClusterError(
            f"{os.uname().nodename} has no folder {folder}; all nodes need the same files under the same path"
        )
    os.chdir(folder)
    torch.set_num_threads(1)
    name = "" if warm_up is None else f"{warm_up.__module__}.{warm_up.__qualname__}"
    if warm_up is not None and name not in _warmed_up:
        warm_up()
        _warmed_up.add(name)
    return function(job)
