"""Training and judging a variant of a thesis experiment over several seeds; finished parts are kept."""

import json
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.experiments.metrics import summarise
from maniskill_tomato.experiments.rollout import Episode, run_episodes
from maniskill_tomato.experiments.statistics import mean_interval
from maniskill_tomato.experiments.thesis_experiments import Evaluation, Experiment, Variant
from maniskill_tomato.files import write_atomically
from maniskill_tomato.learning.rl.agent import make_actor, make_normalizer
from maniskill_tomato.learning.rl.envs import LearnerEnv, make_env, make_learner_env
from maniskill_tomato.learning.rl.history import load_history
from maniskill_tomato.learning.rl.presets import TrainConfig
from maniskill_tomato.learning.rl.run_folder import clear_run
from maniskill_tomato.learning.rl.trainer import Trainer
from maniskill_tomato.policies.trained_actor import TrainedActor, load_actor
from maniskill_tomato.robot.inverse_kinematics import Reach

logger = logging.getLogger(__name__)

SATURATED = 0.95
"""An actor output of this size or more counts as saturated: tanh's slope there is below 0.1."""

EVALUATION_SEED = 1000
"""Seed of the first evaluation episode; no training uses it."""

LAST_EPISODES = 50
"""Training episodes whose success says how the training ended."""


class RunStoppedError(KeyboardInterrupt):
    """A signal ended the training; what was finished before stays."""


class ReachCounter:
    """A `LearnerEnv` that counts how often each `Reach` was the outcome of a step."""

    def __init__(self, env: LearnerEnv) -> None:
        self._env = env
        self.num_envs = env.num_envs
        self.counts = np.zeros(len(Reach), dtype=np.int64)
        """Steps per value of `Reach`. Shape (3,)."""

    @property
    def single_observation_space(self) -> gym.Space[Any]:
        return self._env.single_observation_space

    @property
    def single_action_space(self) -> gym.Space[Any]:
        return self._env.single_action_space

    def reset(self, *, seed: int | list[int] | None = None) -> tuple[Tensor, dict[str, Any]]:
        return self._env.reset(seed=seed)

    def step(self, actions: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        outcome = self._env.step(actions)
        info = outcome[4]
        reached = info.get("final_info", info)["reachability"]
        self.counts += np.bincount(reached.cpu().numpy(), minlength=len(Reach))
        return outcome

    def close(self) -> None:
        self._env.close()


@dataclass(frozen=True, kw_only=True)
class Reproduction:
    """One variant of one experiment, in one folder with a sub-folder per seed."""

    experiment: Experiment
    variant: Variant
    folder: Path
    evaluation_episodes: int = 100
    """Episodes of each evaluation; the first six are the thesis's."""
    training_episodes: int | None = None
    """Another length of the training than the variant's, for trials."""
    show_progress: bool = True

    @property
    def config(self) -> TrainConfig:
        """How it learns."""
        config = self.variant.config(self.experiment)
        if self.training_episodes is None:
            return config
        return TrainConfig.from_dict({**config.to_dict(), "total_episodes": self.training_episodes})

    def seed_folder(self, seed: int) -> Path:
        """Where everything about a seed lies."""
        return self.folder / f"seed_{seed}"

    def run_seed(self, seed: int, evaluations: Sequence[Evaluation]) -> dict[str, Any]:
        """Trains with `seed` and judges the policy, unless that has been done; returns what `summary.json`
        holds.

        Raises:
            InvalidInputError: The folder holds a run of other settings.
            RunStoppedError: A signal ended the training.
        """
        training = self._train(seed)
        results: dict[str, Any] = {}
        policy = load_actor(self.seed_folder(seed) / "training" / "policy.pt", env_id=self.experiment.env_id)
        for evaluation in evaluations:
            episodes = self._evaluate(seed, policy, evaluation)
            result = {k: v for k, v in summarise(episodes).items() if k != "per_episode"}
            result["saturated_output_share"] = saturated_share(policy, episodes)
            results[evaluation.name] = result
        summary = {"seed": seed, "training": training, "evaluations": results}
        content = json.dumps(summary, indent=2, allow_nan=False) + "\n"
        write_atomically(self.seed_folder(seed) / "summary.json", content.encode())
        return summary

    def _train(self, seed: int) -> dict[str, Any]:
        """The figures of the training, which is run unless they are there already."""
        path = self.seed_folder(seed) / "training.json"
        config = self.config
        if path.is_file():
            record: dict[str, Any] = json.loads(path.read_text())
            if TrainConfig.from_dict(record["config"]) != config:
                raise InvalidInputError(
                    f"{path.parent} holds a run of other settings; choose another --out or remove that folder"
                )
            return {k: v for k, v in record.items() if k != "config"}
        run_dir = path.parent / "training"
        clear_run(run_dir)
        logger.info("training %s %s, seed %d", self.experiment.name, self.variant.name, seed)
        env = ReachCounter(make_learner_env(self.experiment.env_id))
        try:
            result = Trainer(env, self.experiment.env_id, config, run_dir, seed, self.show_progress).run()
        finally:
            env.close()
        if result.stop_reason != "finished":
            raise RunStoppedError
        success = load_history(run_dir).episodes["success"]
        figures = {
            "steps": result.steps,
            "episodes": result.episodes,
            "seconds": round(result.seconds, 2),
            "success_rate": float(success.mean()),
            "success_rate_last": float(success[-LAST_EPISODES:].mean()),
            "unreachable_step_share": float(env.counts[Reach.UNREACHABLE] / env.counts.sum()),
        }
        content = json.dumps({**figures, "config": config.to_dict()}, indent=2) + "\n"
        write_atomically(path, content.encode())
        return figures

    def _evaluate(self, seed: int, policy: TrainedActor, evaluation: Evaluation) -> list[Episode]:
        """The episodes of one evaluation, which are run unless enough of them are there already."""
        path = self.episodes_path(seed, evaluation)
        if path.is_file() and len(episodes := load_episodes(path)) >= self.evaluation_episodes:
            return episodes[: self.evaluation_episodes]
        env = make_env(self.experiment.env_id, **evaluation.env_options)
        try:
            episodes = run_episodes(
                env, policy, self.evaluation_episodes, EVALUATION_SEED, self.show_progress
            )
        finally:
            env.close()
        save_episodes(path, episodes)
        return episodes

    def episodes_path(self, seed: int, evaluation: Evaluation) -> Path:
        """The file with the episodes of one evaluation."""
        return self.seed_folder(seed) / f"episodes_{evaluation.name}.npz"


def saturated_share(policy: TrainedActor, episodes: Sequence[Episode]) -> float:
    """Share of the actor's outputs, at the views that it acted from, that are `SATURATED` or more in size."""
    observations = np.concatenate(
        [np.hstack((e.viewpoints[:-1], np.tile(e.target, (e.steps, 1)))) for e in episodes]
    )
    with torch.no_grad():
        outputs = policy.actor(policy.normalizer(torch.as_tensor(observations, dtype=torch.float32)))
    return float((outputs.abs() >= SATURATED).float().mean())


def untrained_first_steps(env_id: str, config: TrainConfig, actors: int) -> dict[str, float]:
    """What freshly initialised actors do first: each of `actors` takes one step from a start of its own.

    Returns:
        `mean_move_m` (length of the position increment), `mean_output` and `saturated_output_share` of the
        actor, `unreachable_share` and `neighbour_share` of the poses asked for.
    """
    env = make_env(env_id)
    outputs: list[Tensor] = []
    reached: list[int] = []
    scale = torch.tensor(config.action_scale)
    try:
        for seed in range(actors):
            torch.manual_seed(seed)
            observations, _ = env.reset(seed=seed)
            actor = make_actor(config, observations.shape[1], len(scale))
            with torch.no_grad():
                output = actor(make_normalizer(config, observations.shape[1])(observations))
            info = env.step(output * scale)[4]
            outputs.append(output[0])
            reached.append(int(info["reachability"]))
    finally:
        env.close()
    values = torch.stack(outputs)
    return {
        "mean_move_m": float((values * scale)[:, :3].norm(dim=-1).mean()),
        "mean_output": float(values.abs().mean()),
        "saturated_output_share": float((values.abs() >= SATURATED).float().mean()),
        "unreachable_share": reached.count(Reach.UNREACHABLE) / actors,
        "neighbour_share": reached.count(Reach.NEIGHBOUR) / actors,
    }


def save_episodes(path: Path, episodes: Sequence[Episode]) -> None:
    """Writes episodes so that `load_episodes` gives them back."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.tmp.npz")
    arrays: dict[str, Any] = {
        name: np.array([getattr(e, name) for e in episodes])
        for name in ("seed", "success", "steps", "target")
    }
    for name in ("viewpoints", "visible_fraction", "rewards", "reachability", "in_forbidden_zone"):
        arrays[name] = np.concatenate([getattr(e, name) for e in episodes])
    np.savez_compressed(temporary, **arrays)
    temporary.replace(path)


def load_episodes(path: Path) -> list[Episode]:
    """Reads what `save_episodes` wrote."""
    with np.load(path, allow_pickle=False) as file:
        data: dict[str, NDArray[Any]] = {name: file[name] for name in file.files}
    step_ends = np.cumsum(data["steps"])
    view_ends = np.cumsum(data["steps"] + 1)
    episodes: list[Episode] = []
    for i, steps in enumerate(data["steps"]):
        step = slice(step_ends[i] - steps, step_ends[i])
        view = slice(view_ends[i] - steps - 1, view_ends[i])
        episodes.append(
            Episode(
                seed=int(data["seed"][i]),
                success=bool(data["success"][i]),
                viewpoints=data["viewpoints"][view],
                target=data["target"][i],
                visible_fraction=data["visible_fraction"][view],
                rewards=data["rewards"][step],
                reachability=data["reachability"][step],
                in_forbidden_zone=data["in_forbidden_zone"][step],
            )
        )
    return episodes


def success_threshold(env_id: str) -> float:
    """V_f above which the task counts the target as fully visible."""
    env = make_env(env_id)
    try:
        return float(cast(Any, env.unwrapped).task.full_visibility)
    finally:
        env.close()


TABLE_HEADER = (
    "| variant | success at the training pose, mean over seeds (95 % interval) | per seed | mean steps | "
    "unreachable steps, training / evaluation | saturated outputs | training steps | first action unreachable |\n"
    "|---|---|---|---|---|---|---|---|"
)


def table_row(title: str, summaries: Sequence[dict[str, Any]], untrained: dict[str, float]) -> str:
    """One row of the ablation table, for Markdown."""
    results = [s["evaluations"]["training-pose"] for s in summaries]
    rates = [r["success_rate"] for r in results]
    low, high = mean_interval(rates)
    trained = [s["training"] for s in summaries]
    return (
        f"| {title} | {np.mean(rates):.0%} ({low:.0%} to {high:.0%}) "
        f"| {', '.join(f'{100 * r:.0f}' for r in rates)} "
        f"| {np.mean([r['mean_steps'] for r in results]):.1f} "
        f"| {np.mean([t['unreachable_step_share'] for t in trained]):.0%} / "
        f"{np.mean([r['unreachable_step_share'] for r in results]):.0%} "
        f"| {np.mean([r['saturated_output_share'] for r in results]):.0%} "
        f"| {np.mean([t['steps'] for t in trained]):.0f} "
        f"| {untrained['unreachable_share']:.0%} |"
    )
