"""Trainings with their evaluations, several at a time; finished parts are kept."""

import logging
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from maniskill_tomato.errors import SeedsFailedError, TomatoError
from maniskill_tomato.experiments.episode_record import EpisodeRecord
from maniskill_tomato.experiments.metrics import make_metrics, summarise, totals
from maniskill_tomato.experiments.plots import moving_average
from maniskill_tomato.experiments.result_store import ResultStore
from maniskill_tomato.experiments.rollout import run_episode
from maniskill_tomato.experiments.variants import Evaluation, Variant
from maniskill_tomato.files import write_json
from maniskill_tomato.learning.rl.envs import LearnerEnv, make_env
from maniskill_tomato.learning.rl.history import TrainingCurves, load_history
from maniskill_tomato.learning.rl.presets import TrainConfig
from maniskill_tomato.learning.rl.run_folder import clear_run
from maniskill_tomato.learning.rl.trainer import Trainer, make_training_env
from maniskill_tomato.policies.trained_actor import TrainedActor, load_actor
from maniskill_tomato.robot.inverse_kinematics import Reach
from maniskill_tomato.tasks import THESIS_IDS
from maniskill_tomato.worker_pool import run_jobs

logger = logging.getLogger(__name__)

EVALUATION_SEED = 1000
"""Seed of the first evaluation episode; no training uses it."""

LAST_EPISODES = 50
"""Training episodes whose success says how the training ended."""

SATURATED = 0.95
"""An actor output of this size or more counts as saturated: tanh's slope there is below 0.1."""

SOLVED = 0.95
WINDOW = 50
"""Training episodes over which the success that counts as solved is measured."""

EVALUATIONS = "evaluations"
TRAINING = "training"


class StudyStoppedError(KeyboardInterrupt):
    """A signal ended a training; what was finished before stays."""


class ReachCounter:
    """A `LearnerEnv` that counts how often each `Reach` was the outcome of a step."""

    def __init__(self, env: LearnerEnv) -> None:
        self._env = env
        self.counts = np.zeros(len(Reach), dtype=np.int64)
        """Steps per value of `Reach`. Shape (3,)."""

    def __getattr__(self, name: str) -> Any:
        return getattr(self._env, name)

    def step(self, actions: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        outcome = self._env.step(actions)
        info = outcome[4]
        reached = info.get("final_info", info)["reachability"]
        self.counts += np.bincount(reached.cpu().numpy(), minlength=len(Reach))
        return outcome


@dataclass(frozen=True, kw_only=True)
class Trial:
    """One training and where its policy is judged."""

    env_id: str
    variant: Variant
    config: TrainConfig
    seed: int
    folder: Path
    """A run folder, which `maniskill-tomato compare` reads too, with the results of the trial."""
    evaluations: tuple[Evaluation, ...]
    """The first gives the run's metrics.json."""
    episodes: int
    """Of each evaluation."""
    env_options: dict[str, Any] = field(default_factory=dict)
    """Options of the task in the training; each evaluation has its own."""
    show_progress: bool = False

    def store(self) -> ResultStore:
        """Where its results are kept.

        Raises:
            InvalidInputError: The folder holds a trial of other settings.
        """
        facts = {"env_id": self.env_id, "config": self.config.to_dict()}
        return ResultStore(
            self.folder, {**facts, "env_options": self.env_options} if self.env_options else facts
        )

    def records(self, evaluation: Evaluation) -> list[EpisodeRecord]:
        """The finished episodes of an evaluation."""
        return self.store().episodes(EVALUATIONS, evaluation.name, self._numbers)

    def policy(self) -> TrainedActor:
        """The trained policy."""
        return load_actor(self.folder / "policy.pt", env_id=self.env_id)

    def result(self) -> dict[str, Any] | None:
        """The figures of the training and of each evaluation; None unless all is done."""
        store = self.store()
        training = store.read(TRAINING, "figures").get(self.seed)
        if training is None or any(self._missing(store, evaluation) for evaluation in self.evaluations):
            return None
        policy = self.policy()
        results = {}
        for evaluation in self.evaluations:
            records = store.episodes(EVALUATIONS, evaluation.name, self._numbers)
            results[evaluation.name] = {
                **totals(summarise(records)),
                "saturated_output_share": saturated_share(policy, records),
            }
        return {"seed": self.seed, "training": training, "evaluations": results}

    def run(self) -> dict[str, Any]:
        """Trains and judges the policy, unless that has been done; returns its `result`.

        A training that was stopped begins again, so that its processor time is that of all its steps.

        Raises:
            InvalidInputError: The folder holds a trial of other settings.
            StudyStoppedError: A signal ended the training.
        """
        store = self.store()
        if self.seed not in store.read(TRAINING, "figures"):
            store.add(TRAINING, "figures", {self.seed: self._train()})
        for evaluation in self.evaluations:
            self._evaluate(store, evaluation)
        result = self.result()
        assert result is not None
        return result

    @property
    def _numbers(self) -> range:
        return range(EVALUATION_SEED, EVALUATION_SEED + self.episodes)

    def _missing(self, store: ResultStore, evaluation: Evaluation) -> list[int]:
        return store.missing(EVALUATIONS, evaluation.name, self._numbers)

    def _evaluate(self, store: ResultStore, evaluation: Evaluation) -> None:
        """Runs the episodes that are missing; those of the first evaluation give metrics.json."""
        missing = self._missing(store, evaluation)
        if not missing:
            return
        start = time.perf_counter()
        policy = self.policy()
        env: Any = make_env(self.env_id, **evaluation.env_options)
        try:
            threshold = float(env.unwrapped.task.full_visibility)
            episodes = [run_episode(env, policy, number) for number in missing]
        finally:
            env.close()
        store.add_episodes(EVALUATIONS, evaluation.name, episodes)
        if evaluation is self.evaluations[0]:
            metrics = make_metrics(
                self.env_id,
                store.episodes(EVALUATIONS, evaluation.name, self._numbers),
                seed=EVALUATION_SEED,
                success_threshold=threshold,
                policy={"path": str(self.folder / "policy.pt"), **policy.describe()},
                wall_seconds=time.perf_counter() - start,
            )
            write_json(self.folder / "metrics.json", metrics)

    def _train(self) -> dict[str, Any]:
        """Trains, and gives the figures of the training."""
        clear_run(self.folder)
        logger.info("training %s on %s, seed %d", self.variant.name, self.env_id, self.seed)
        counter = ReachCounter(make_training_env(self.env_id, self.config, self.env_options))
        env = cast(LearnerEnv, counter)
        try:
            trainer = Trainer(
                env,
                self.env_id,
                self.config,
                self.folder,
                self.seed,
                self.show_progress,
                env_options=self.env_options,
            )
            before = time.process_time()
            trained = trainer.run()
            cpu_seconds = time.process_time() - before
        finally:
            env.close()
        if trained.stop_reason != "finished":
            raise StudyStoppedError
        history = load_history(self.folder)
        success = history.episodes["success"]
        return {
            "steps": trained.steps,
            "episodes": trained.episodes,
            "updates": trained.updates,
            "seconds": round(trained.seconds, 2),
            "cpu_seconds": round(cpu_seconds, 2),
            "success_rate": float(success.mean()),
            "success_rate_last": float(success[-LAST_EPISODES:].mean()),
            "unreachable_step_share": float(counter.counts[Reach.UNREACHABLE] / counter.counts.sum()),
            "steps_to_solved": steps_to_solved(history, self.config.learning_starts),
        }


def run_trials(trials: Sequence[Trial], processes: int) -> Iterator[tuple[Trial, dict[str, Any]]]:
    """Runs them in several processes; yields each with its result as they end, those done before first.

    Raises:
        InvalidInputError: A folder holds a trial of other settings.
        SeedsFailedError: Some failed; the others are done by then.
        KeyboardInterrupt: One of them was stopped; those that ended before stay.
    """
    waiting = []
    for trial in trials:
        if (done := trial.result()) is not None:
            yield trial, done
        else:
            waiting.append(trial)
    failed: list[str] = []
    for trial, result in run_jobs(_run_trial, waiting, processes, warm_up=_warm_up):
        if isinstance(result, str):
            logger.error("%s failed: %s", trial.folder, result)
            failed.append(str(trial.folder))
        else:
            yield trial, result
    if failed:
        raise SeedsFailedError(f"{len(failed)} of {len(trials)} runs failed: {', '.join(failed)}")


def saturated_share(policy: TrainedActor, episodes: Sequence[EpisodeRecord]) -> float:
    """Share of the actor's outputs, at the views that it acted from, that are `SATURATED` or more in size."""
    observations = np.concatenate([np.hstack((e.viewpoints[:-1], e.target[:-1])) for e in episodes])
    with torch.no_grad():
        outputs = policy.actor(policy.normalizer(torch.as_tensor(observations, dtype=torch.float32)))
    return float((outputs.abs() >= SATURATED).float().mean())


def steps_to_solved(history: TrainingCurves, learning_starts: int) -> int | None:
    """Environment steps after which 95 % of the last 50 training episodes succeeded; None if that never came.

    Exploration is part of them, and so are episodes led by it; only those that ended after learning started count.
    """
    learned = history.episodes["end_step"] > learning_starts
    success, ends = history.episodes["success"][learned], history.episodes["end_step"][learned]
    if len(success) < WINDOW:
        return None
    solved = np.flatnonzero(moving_average(success, WINDOW) >= SOLVED - 1e-9)
    return int(ends[solved[0] + WINDOW - 1]) if len(solved) else None


def _run_trial(trial: Trial) -> dict[str, Any] | str:
    """Its result, or why it failed."""
    try:
        return trial.run()
    except TomatoError as error:
        return str(error)


def _warm_up() -> None:
    """Loads the simulator and compiles its kernels, which no training shall be charged for."""
    torch.set_num_threads(1)
    for env_id in THESIS_IDS:
        env = make_env(env_id)
        env.reset(seed=0)
        env.close()
