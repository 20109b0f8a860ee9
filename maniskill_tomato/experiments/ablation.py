"""What each option of the learner is worth: a preset against itself with one option changed, over seeds and tasks."""

import dataclasses
import json
import logging
import multiprocessing
import os
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from maniskill_tomato.errors import InvalidInputError, SeedsFailedError, TomatoError
from maniskill_tomato.experiments.metrics import make_metrics, write_metrics
from maniskill_tomato.experiments.reproduction import EVALUATION_SEED
from maniskill_tomato.experiments.rollout import run_episodes
from maniskill_tomato.files import write_atomically
from maniskill_tomato.learning.rl.envs import make_env
from maniskill_tomato.learning.rl.history import TrainingCurves, load_history
from maniskill_tomato.learning.rl.presets import TrainConfig, get_preset
from maniskill_tomato.learning.rl.run import make_training_env
from maniskill_tomato.learning.rl.run_folder import clear_run
from maniskill_tomato.learning.rl.trainer import Trainer
from maniskill_tomato.policies.opening import open_policy
from maniskill_tomato.tasks import THESIS_IDS

logger = logging.getLogger(__name__)

RESULT_FILE = "result.json"

SOLVED = 0.95
WINDOW = 50
"""Training episodes over which the success that counts as solved is measured."""


@dataclass(frozen=True, kw_only=True)
class LearnerVariant:
    """A preset with one thing changed."""

    name: str
    title: str
    """What differs, for tables."""
    changes: dict[str, Any]
    """Fields of `TrainConfig` and their new values; none for the preset itself."""
    env_ids: tuple[str, ...] = THESIS_IDS
    """The tasks that it makes sense on."""


BASE = LearnerVariant(name="base", title="the preset", changes={})

VARIANTS: tuple[LearnerVariant, ...] = (
    BASE,
    LearnerVariant(name="n-step-3", title="returns over 3 steps", changes={"n_step": 3}),
    LearnerVariant(
        name="running-normalisation",
        title="observations scaled by running statistics",
        changes={"normalize_observations": "running"},
    ),
    LearnerVariant(
        name="hindsight-targets",
        title="hindsight: the other two tomatoes as targets",
        changes={"hindsight_targets": 2},
        env_ids=("TomatoViewpointSparse-v1",),  # The guided task's plant has one tomato.
    ),
    LearnerVariant(
        name="rising-threshold",
        title="success threshold rising from 0.4",
        changes={"success_threshold_start": 0.4},
    ),
    LearnerVariant(
        name="auxiliary",
        title="auxiliary heads: distance and next V_f, weights 0.1",
        changes={"aux_distance_weight": 0.1, "aux_visibility_weight": 0.1},
    ),
    LearnerVariant(
        name="categorical-critic",
        title="categorical critics, 101 atoms from -4 to 2",
        changes={"critic": "categorical", "value_range": (-4.0, 2.0)},
    ),
    LearnerVariant(
        name="noise-per-environment",
        title="a noise level for every episode",
        changes={"exploration_noise_per_env": True},
    ),
    LearnerVariant(name="no-smoothing", title="no target smoothing", changes={"target_noise": 0.0}),
    LearnerVariant(name="single-critic", title="one critic, as DDPG", changes={"twin_critics": False}),
    LearnerVariant(name="no-delay", title="no policy delay", changes={"policy_frequency": 1}),
)
"""One change each, the preset itself first."""


def choose_variants(names: Sequence[str]) -> list[LearnerVariant]:
    """The variants of these names, all of them if there are none.

    Raises:
        InvalidInputError: There is no such variant; the message lists them.
    """
    known = {variant.name: variant for variant in VARIANTS}
    for name in names:
        if name not in known:
            raise InvalidInputError.choice("a variant", name, known)
    return [known[name] for name in names] if names else list(VARIANTS)


@dataclass(frozen=True, kw_only=True)
class AblationRun:
    """One training with its evaluation."""

    env_id: str
    variant: LearnerVariant
    seed: int
    config: TrainConfig
    episodes: int
    """Evaluation episodes."""
    folder: Path
    """Where the run lies; `scripts/compare_runs.py` reads it too."""

    def finished(self) -> dict[str, Any] | None:
        """What it gave, if it was done before with these settings."""
        path = self.folder / RESULT_FILE
        if not path.is_file():
            return None
        result: dict[str, Any] = json.loads(path.read_text())
        same = TrainConfig.from_dict(result["config"]) == self.config and result["episodes"] == self.episodes
        if not same:
            raise InvalidInputError(
                f"{self.folder} holds a run of other settings; choose another --out or remove that folder"
            )
        return result


def plan(
    preset: str,
    variants: Sequence[LearnerVariant],
    env_ids: Sequence[str],
    seeds: Sequence[int],
    out: Path,
    episodes: int = 100,
    total_timesteps: int | None = None,
) -> list[AblationRun]:
    """All runs, seed by seed, so that an early look compares every variant.

    Raises:
        InvalidInputError: A preset, task or seed cannot be used, or a variant does not fit the preset.
    """
    if not seeds or len(set(seeds)) != len(seeds) or min(seeds) < 0:
        raise InvalidInputError(
            f"seeds must be one or more different numbers of 0 or more, got {tuple(seeds)}"
        )
    if episodes < 1:
        raise InvalidInputError(f"episodes must be 1 or more, got {episodes}")
    for env_id in env_ids:
        if env_id not in THESIS_IDS:
            raise InvalidInputError.choice("a task", env_id, THESIS_IDS)
    base = get_preset(preset)
    if total_timesteps is not None:
        base = dataclasses.replace(base, total_timesteps=total_timesteps)
    return [
        AblationRun(
            env_id=env_id,
            variant=variant,
            seed=seed,
            config=dataclasses.replace(base, **variant.changes),
            episodes=episodes,
            folder=out / env_id / variant.name / f"seed-{seed}",
        )
        for seed in seeds
        for env_id in env_ids
        for variant in variants
        if env_id in variant.env_ids
    ]


def execute(run: AblationRun) -> dict[str, Any] | None:
    """Trains, judges the policy, and keeps the result, unless that is there already; None if it was stopped.

    A training that was stopped begins again, so that its processor time is that of all its steps.
    """
    done = run.finished()
    if done is not None:
        return done
    clear_run(run.folder)
    env = make_training_env(run.env_id, run.config, {})
    try:
        trainer = Trainer(env, run.env_id, run.config, run.folder, run.seed, show_progress=False)
        before = time.process_time()
        trained = trainer.run()
        cpu_seconds = time.process_time() - before
    finally:
        env.close()
    if trained.stop_reason != "finished":
        return None
    judge = make_env(run.env_id)
    try:
        threshold = float(judge.unwrapped.task.full_visibility)  # type: ignore[attr-defined]
        begun = time.perf_counter()
        episodes = run_episodes(judge, open_policy(trained.policy_path), run.episodes, EVALUATION_SEED)
        wall = time.perf_counter() - begun
    finally:
        judge.close()
    metrics = make_metrics(
        run.env_id,
        episodes,
        seed=EVALUATION_SEED,
        success_threshold=threshold,
        policy={"path": str(trained.policy_path), "steps": trained.steps},
        wall_seconds=wall,
    )
    write_metrics(run.folder / "metrics.json", metrics)
    result = {
        "env_id": run.env_id,
        "variant": run.variant.name,
        "seed": run.seed,
        "episodes": run.episodes,
        "success_rate": metrics["success_rate"],
        "mean_steps": metrics["mean_steps"],
        "training_steps": trained.steps,
        "updates": trained.updates,
        "training_seconds": round(trained.seconds, 2),
        "training_cpu_seconds": round(cpu_seconds, 2),
        "steps_to_solved": steps_to_solved(load_history(run.folder), run.config.learning_starts),
        "config": run.config.to_dict(),
    }
    write_atomically(run.folder / RESULT_FILE, (json.dumps(result, indent=2) + "\n").encode())
    return result


def execute_all(runs: Sequence[AblationRun], jobs: int) -> Iterator[tuple[AblationRun, dict[str, Any]]]:
    """Runs them in `jobs` processes; yields them as they end.

    Raises:
        InvalidInputError: `jobs` is not positive, or a folder holds a run of other settings.
        SeedsFailedError: Some failed; the others are done by then.
        KeyboardInterrupt: One of them was stopped; those that ended before stay.
    """
    if jobs < 1:
        raise InvalidInputError(f"jobs must be 1 or more, got {jobs}")
    waiting = []
    for run in runs:
        done = run.finished()
        if done is None:
            waiting.append(run)
        else:
            yield run, done
    # The processes read this when they load their numerical libraries.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    context = multiprocessing.get_context("spawn")
    failed: list[str] = []
    with ProcessPoolExecutor(jobs, mp_context=context, initializer=_warm_up) as pool:
        futures = {pool.submit(execute, run): run for run in waiting}
        try:
            for future in as_completed(futures):
                run = futures[future]
                try:
                    result = future.result()
                except TomatoError as error:
                    logger.error("%s failed: %s", run.folder, error)
                    failed.append(str(run.folder))
                    continue
                if result is None:
                    raise KeyboardInterrupt
                yield run, result
        finally:
            pool.shutdown(wait=True, cancel_futures=True)
    if failed:
        raise SeedsFailedError(f"{len(failed)} of {len(runs)} runs failed: {', '.join(failed)}")


def _warm_up() -> None:
    """Loads the simulator and compiles its kernels, which no run shall be charged for."""
    torch.set_num_threads(1)
    for env_id in THESIS_IDS:
        env = make_env(env_id)
        env.reset(seed=0)
        env.close()


def steps_to_solved(history: TrainingCurves, learning_starts: int) -> int | None:
    """Environment steps after which 95 % of the last 50 training episodes succeeded; None if that never came.

    Exploration is part of them, and so are episodes led by it; only those that ended after learning started count.
    """
    learned = history.episodes["end_step"] > learning_starts
    success, ends = history.episodes["success"][learned], history.episodes["end_step"][learned]
    if len(success) < WINDOW:
        return None
    sums = np.concatenate(([0.0], np.cumsum(success)))
    shares = (sums[WINDOW:] - sums[:-WINDOW]) / WINDOW
    solved = np.flatnonzero(shares >= SOLVED - 1e-9)
    return int(ends[solved[0] + WINDOW - 1]) if len(solved) else None
