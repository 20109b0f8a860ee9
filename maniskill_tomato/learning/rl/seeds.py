"""Several seeds of one configuration, each trained in a process and a folder of its own."""

import contextlib
import logging
import math
import multiprocessing
import os
import signal
import sys
import time
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from tqdm import tqdm

import maniskill_tomato
from maniskill_tomato.errors import InvalidInputError, TomatoError
from maniskill_tomato.files import write_json
from maniskill_tomato.folder_lock import only_writer
from maniskill_tomato.learning.interrupt import stop_on_signals
from maniskill_tomato.learning.rl.presets import TrainConfig
from maniskill_tomato.learning.rl.progress import Progress
from maniskill_tomato.learning.rl.run_folder import LOG_NAME, check_run_dir, clear_run
from maniskill_tomato.learning.rl.trainer import TrainResult, train
from maniskill_tomato.worker_pool import is_on_cluster, run_jobs, start_process

logger = logging.getLogger(__name__)

SEEDS_FILE = "seeds.json"
"""Describes the runs of a folder; `--config` repeats them and `--resume` continues them."""

POLL_SECONDS = 0.1
LINE_SECONDS = 10.0
"""How often progress is told where there is no terminal for bars."""


@dataclass(frozen=True, kw_only=True)
class SeedResult:
    """How one seed's run ended."""

    seed: int
    run_dir: Path
    steps: int
    """Environment steps taken, as far as is known."""
    episodes: int
    """Episodes finished, as far as is known."""
    success: float
    """Share of its last episodes that succeeded; NaN if none was told."""
    seconds: float
    """Training time, all parts of a continued run together; 0 if it failed."""
    stop_reason: str
    """As `TrainResult.stop_reason`, or `failed`, or `not started`."""
    error: str | None = None
    """Why it failed."""

    @property
    def policy_path(self) -> Path:
        """Where its policy is, unless it failed."""
        return self.run_dir / "policy.pt"


def train_seeds(
    env_id: str,
    config: TrainConfig,
    out: Path,
    seeds: Sequence[int],
    env_options: dict[str, Any],
    *,
    jobs: int | None = None,
    overwrite: bool = False,
    resume: bool = False,
    show_progress: bool = True,
) -> list[SeedResult]:
    """Trains every seed in `out/seed-N`; one that fails does not disturb the others.

    Ctrl-C and SIGTERM let the running seeds end as single runs do, saved, and start no more; a second one kills
    them. Should this process be killed, they end likewise.

    Args:
        env_id: Id of the task.
        config: How to learn, the same for all.
        out: Folder of the runs.
        seeds: One run each.
        env_options: Options of the task for `gymnasium.make`.
        jobs: How many at a time; by default one per processor core. A cluster decides that itself
            (`worker_pool.working_on`).
        overwrite: Remove earlier runs of these seeds from the folder.
        resume: Go on with those that were begun.
        show_progress: Whether to show where each of them is.

    Raises:
        InvalidInputError: `seeds` is empty, `jobs` is less than 1, or the folder holds runs.
        CheckpointError: Another process trains seeds in the folder.
    """
    if not seeds:
        raise InvalidInputError("give one seed or more")
    if jobs is not None and jobs < 1:
        raise InvalidInputError(f"jobs must be 1 or more, got {jobs}")
    with only_writer(out, "trains"):
        return _train_seeds(env_id, config, out, seeds, env_options, jobs, overwrite, resume, show_progress)


def _train_seeds(
    env_id: str,
    config: TrainConfig,
    out: Path,
    seeds: Sequence[int],
    env_options: dict[str, Any],
    jobs: int | None,
    overwrite: bool,
    resume: bool,
    show_progress: bool,
) -> list[SeedResult]:
    if (out / "config.json").exists():
        raise InvalidInputError(f"{out} holds a single run; choose another --out for several seeds")
    folders = {seed: out / f"seed-{seed}" for seed in seeds}
    for folder in folders.values():
        if overwrite:
            clear_run(folder)
        if not resume:
            check_run_dir(folder)
    content = {
        "env_id": env_id,
        "seeds": list(seeds),
        "package_version": maniskill_tomato.__version__,
        "env_options": env_options,
        "config": config.to_dict(),
    }
    write_json(out / SEEDS_FILE, content)
    if is_on_cluster():
        runs = [SeedRun(seed, folder, env_id, config, env_options) for seed, folder in folders.items()]
        return sorted(
            (result for _, result in run_jobs(train_alone, runs, len(runs))),
            key=lambda r: seeds.index(r.seed),
        )
    waiting = deque(
        _Worker(seed, folder, env_id, config, env_options, resume) for seed, folder in folders.items()
    )
    workers = list(waiting)
    at_once = min(len(workers), jobs or len(os.sched_getaffinity(0)))
    display = _Display(workers, config, show_progress)
    try:
        with stop_on_signals() as stop:
            asked = False
            while (waiting and stop.reason is None) or any(w.running for w in workers):
                while waiting and stop.reason is None and sum(w.running for w in workers) < at_once:
                    waiting.popleft().start()
                if stop.reason is not None and not asked:
                    asked = True
                    for worker in workers:
                        worker.ask_to_stop()
                display.refresh()
                time.sleep(POLL_SECONDS)
    finally:
        display.close()
        for worker in workers:
            worker.kill()
    return [worker.result() for worker in workers]


@dataclass(frozen=True)
class SeedRun:
    """One seed's run, for a worker of a cluster."""

    seed: int
    run_dir: Path
    env_id: str
    config: TrainConfig
    env_options: dict[str, Any]


def train_alone(run: SeedRun) -> SeedResult:
    """Trains, and says everything into the run's log; goes on with what a worker that was lost has left there."""
    run.run_dir.mkdir(parents=True, exist_ok=True)
    package = logging.getLogger("maniskill_tomato")
    told: list[Progress] = []
    end: TrainResult | None = None
    error = None
    with _logging_to(package, run.run_dir / LOG_NAME):
        try:
            end = train(
                run.env_id,
                run.config,
                run.run_dir,
                run.seed,
                run.env_options,
                resume=(run.run_dir / "config.json").is_file(),
                show_progress=False,
                report=told.append,
            )
        except TomatoError as failure:
            package.error("error: %s", failure)
            error = str(failure)
    last = told[-1] if told else None
    known = end or last
    return SeedResult(
        seed=run.seed,
        run_dir=run.run_dir,
        steps=0 if known is None else known.steps,
        episodes=0 if known is None else known.episodes,
        success=math.nan if last is None else last.success,
        seconds=0.0 if end is None else end.seconds,
        stop_reason="failed" if end is None else end.stop_reason,
        error=error,
    )


@contextlib.contextmanager
def _logging_to(source: logging.Logger, path: Path) -> Iterator[None]:
    """Adds what a logger says to a file meanwhile."""
    handler = logging.FileHandler(path)
    level = source.level
    source.addHandler(handler)
    source.setLevel(logging.INFO)
    try:
        yield
    finally:
        source.setLevel(level)
        source.removeHandler(handler)
        handler.close()


def summary_table(results: Sequence[SeedResult]) -> str:
    """One line per seed: how it ended, how long it took, its recent success, and where its policy or its log is."""
    lines = [f"{'seed':>6}  {'ended':<12} {'steps':>8} {'episodes':>8} {'seconds':>8} {'success':>7}  result"]
    for r in results:
        success = "-" if math.isnan(r.success) else f"{r.success:.0%}"
        where = r.error or ("" if r.stop_reason == "not started" else r.policy_path)
        lines.append(
            f"{r.seed:>6}  {r.stop_reason:<12} {r.steps:>8} {r.episodes:>8} {r.seconds:>8.0f} {success:>7}  {where}"
        )
    return "\n".join(lines)


class _Worker:
    """A seed's process and what it said last."""

    def __init__(self, seed: int, run_dir: Path, *training: Any) -> None:
        self.seed = seed
        self.run_dir = run_dir
        self.progress: Progress | None = None
        self._training = training
        self._end: TrainResult | str | None = None
        self._process: BaseProcess | None = None

    @property
    def running(self) -> bool:
        return self._process is not None and self._process.is_alive()

    def start(self) -> None:
        self._messages, sending = multiprocessing.Pipe(duplex=False)
        self._process = start_process(_train_seed, sending, self.seed, self.run_dir, *self._training)
        sending.close()

    def listen(self) -> None:
        """Takes what the process has said since the last time."""
        with contextlib.suppress(EOFError, OSError):  # It has ended.
            while self._process is not None and self._messages.poll():
                message = self._messages.recv()
                if isinstance(message, Progress):
                    self.progress = message
                else:
                    self._end = message

    def ask_to_stop(self) -> None:
        if self._process is not None:
            self._process.terminate()

    def kill(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.join()

    def result(self) -> SeedResult:
        self.listen()
        end, progress = self._end, self.progress
        status = None if self._process is None else self._process.exitcode
        reason, error = "not started", None
        if isinstance(end, TrainResult):
            reason = end.stop_reason
        elif status == -signal.SIGTERM:  # Stopped before its training had begun.
            reason = "SIGTERM"
        elif status is not None:
            reason = "failed"
            cause = f"by {signal.Signals(-status).name}" if status < 0 else f"with status {status}"
            error = end or f"ended {cause}; see {self.run_dir / LOG_NAME}"
        known = end if isinstance(end, TrainResult) else progress
        return SeedResult(
            seed=self.seed,
            run_dir=self.run_dir,
            steps=0 if known is None else known.steps,
            episodes=0 if known is None else known.episodes,
            success=math.nan if progress is None else progress.success,
            seconds=end.seconds if isinstance(end, TrainResult) else 0.0,
            stop_reason=reason,
            error=error,
        )


def _train_seed(
    messages: Connection,
    seed: int,
    run_dir: Path,
    env_id: str,
    config: TrainConfig,
    env_options: dict[str, Any],
    resume: bool,
) -> None:
    """Trains in a process of its own, which says everything into the run's log and sends where it is."""
    run_dir.mkdir(parents=True, exist_ok=True)
    with (run_dir / LOG_NAME).open("a") as log:
        for stream in (sys.stdout, sys.stderr):
            os.dup2(log.fileno(), stream.fileno())
    logging.basicConfig(level=logging.WARNING, format="%(message)s", stream=sys.stderr)
    logging.getLogger("maniskill_tomato").setLevel(logging.INFO)

    def send(message: object) -> None:
        with contextlib.suppress(BrokenPipeError):  # The end of the other process stops the run.
            messages.send(message)

    resume = resume and (run_dir / "config.json").is_file()
    try:
        send(
            train(env_id, config, run_dir, seed, env_options, resume=resume, show_progress=False, report=send)
        )
    except TomatoError as error:
        logger.error("error: %s", error)
        send(str(error))
        raise SystemExit(2) from None


class _Display:
    """A bar for every seed on a terminal, a line now and then elsewhere."""

    def __init__(self, workers: Sequence[_Worker], config: TrainConfig, show: bool) -> None:
        self._workers = workers
        self._key = "episodes" if config.total_timesteps is None and config.total_episodes else "steps"
        self._total = config.total_episodes if self._key == "episodes" else config.total_timesteps
        self._lines = show and not sys.stderr.isatty()
        self._last_line = time.monotonic()
        self._bars = [
            tqdm(
                total=self._total,
                unit=self._key.removesuffix("s"),
                desc=f"seed {w.seed}",
                position=i,
                dynamic_ncols=True,
            )
            for i, w in enumerate(workers)
            if show and not self._lines
        ]

    def refresh(self) -> None:
        for worker in self._workers:
            worker.listen()
        for bar, worker in zip(self._bars, self._workers, strict=False):
            if worker.progress is not None and bar.n != self._done(worker):
                bar.n = self._done(worker)
                success = worker.progress.success
                bar.set_postfix_str("" if math.isnan(success) else f"success {success:.0%}", refresh=False)
                bar.refresh()
        if self._lines and time.monotonic() - self._last_line >= LINE_SECONDS:
            self._last_line = time.monotonic()
            logger.info("%s", ", ".join(self._where(worker) for worker in self._workers))

    def _done(self, worker: _Worker) -> int:
        return 0 if worker.progress is None else int(getattr(worker.progress, self._key))

    def _where(self, worker: _Worker) -> str:
        of = f" of {self._total}" if self._total else ""
        return f"seed {worker.seed}: {self._done(worker)}{of} {self._key}"

    def close(self) -> None:
        self.refresh()
        for bar in self._bars:
            bar.close()
