"""The training loop (Algorithm 2): act, store, update, log, keep checkpoints."""

import json
import logging
import math
import time
from dataclasses import dataclass
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor

import maniskill_tomato
from maniskill_tomato.errors import InvalidInputError, TrainingDivergedError
from maniskill_tomato.learning.agent import make_agent, update
from maniskill_tomato.learning.checkpoint import make_checkpoint, save_checkpoint, write_atomically
from maniskill_tomato.learning.envs import LearnerEnv
from maniskill_tomato.learning.exploration import make_exploration
from maniskill_tomato.learning.history import TrainingHistory
from maniskill_tomato.learning.interrupt import StopRequest, stop_on_signals
from maniskill_tomato.learning.presets import TrainConfig
from maniskill_tomato.learning.progress import TrainingLog
from maniskill_tomato.learning.replay import Batch, ReplayBuffer
from maniskill_tomato.learning.rewards import potential_reward

logger = logging.getLogger(__name__)

CHECKPOINTS_KEPT = 3


@dataclass(frozen=True, kw_only=True)
class TrainResult:
    """How a run ended."""

    run_dir: Path
    policy_path: Path
    """The final policy, for `load_policy`."""
    steps: int
    """Environment steps taken."""
    episodes: int
    """Episodes finished."""
    updates: int
    seconds: float
    """Time in the loop."""
    stop_reason: str
    """`finished`, `time budget` or the name of the signal that asked to stop."""


class Trainer:
    """Trains one agent in one environment and keeps what happened in `run_dir`."""

    def __init__(
        self,
        env: LearnerEnv,
        env_id: str,
        config: TrainConfig,
        run_dir: Path,
        seed: int = 0,
        show_progress: bool = True,
    ) -> None:
        """Prepares a run; nothing is stepped or written yet.

        Args:
            env: The environment; the caller closes it.
            env_id: Its id, kept in the checkpoints.
            config: How to learn.
            run_dir: Folder of the run; it must not hold another one.
            seed: Seed of the environment, the weights, the replay and the exploration.
            show_progress: Whether to draw a progress bar.

        Raises:
            InvalidInputError: `run_dir` already holds a run, or `config` does not fit `env`.
        """
        observation_space, action_space = env.single_observation_space, env.single_action_space
        if not isinstance(observation_space, gym.spaces.Box) or not isinstance(action_space, gym.spaces.Box):
            raise InvalidInputError(f"training needs Box spaces, got {observation_space} and {action_space}")
        (action_dim,) = action_space.shape
        if len(config.action_scale) != action_dim:
            raise InvalidInputError(
                f"action_scale must have {action_dim} values, one per action, got {len(config.action_scale)}"
            )
        if (run_dir / "config.json").exists():
            raise InvalidInputError(
                f"{run_dir} already holds a run; choose another --out or pass --overwrite"
            )
        self._env = env
        self._env_id = env_id
        self._config = config
        self._run_dir = run_dir
        self._seed = seed
        self._show_progress = show_progress
        self._dims = observation_space.shape[0], action_dim
        self._action_bounds = torch.as_tensor(action_space.low), torch.as_tensor(action_space.high)
        self._step = 0
        self._updates = 0
        self._updates_owed = 0.0
        self._episodes = 0
        self._checkpoint_step = 0
        self._start = time.perf_counter()

    def run(self) -> TrainResult:
        """Trains until the configured end, a signal or an error.

        Ctrl-C and SIGTERM end the run after the present step with everything saved; a second one stops at
        once.

        Raises:
            TrainingDivergedError: The critic's loss is not finite; the last good checkpoint stays.
            CheckpointError: The disk does not take the checkpoint.
        """
        torch.set_num_threads(self._config.torch_threads)
        torch.manual_seed(self._seed)
        np.random.seed(self._seed % 2**32)
        observations, info = self._env.reset(seed=self._seed)
        self._prepare(observations)
        self._write_config()
        self._start = time.perf_counter()
        with (
            stop_on_signals() as stop,
            TrainingLog(self._run_dir, self._config, self._show_progress) as log,
        ):
            reason = self._loop(observations, info["visible_fraction"], log, stop)
        seconds = time.perf_counter() - self._start
        policy_path = self._save()
        logger.info("training ended (%s) after %d steps; policy in %s", reason, self._step, policy_path)
        return TrainResult(
            run_dir=self._run_dir,
            policy_path=policy_path,
            steps=self._step,
            episodes=self._episodes,
            updates=self._updates,
            seconds=seconds,
            stop_reason=reason,
        )

    def _prepare(self, observations: Tensor) -> None:
        device = observations.device
        config = self._config
        self._agent = make_agent(config, *self._dims, device)
        self._replay = ReplayBuffer(config.buffer_size, *self._dims, device)
        self._generator = torch.Generator(device=device).manual_seed(self._seed)
        self._exploration = make_exploration(config, self._generator, device)
        self._scale = torch.tensor(config.action_scale, device=device)
        self._history = TrainingHistory(self._env.num_envs)

    def _loop(
        self, observations: Tensor, visible_fraction: Tensor, log: TrainingLog, stop: StopRequest
    ) -> str:
        """Steps until the end; returns why it ended."""
        episode_starts = torch.ones(self._env.num_envs, dtype=torch.bool, device=observations.device)
        while (reason := stop.reason or self._end_reason()) is None:
            actions = self._exploration.explore(
                self._agent.policy(observations), observations, self._step, episode_starts
            )
            next_observations, rewards, terminations, truncations, info = self._env.step(
                actions * self._scale
            )
            dones = terminations | truncations
            self._step += self._env.num_envs
            # At the end of an episode `next_observations` is already the start of the next one.
            step_info = info.get("final_info", info)
            reached = info["final_observation"] if "final_observation" in info else next_observations
            learned = self._learned_reward(rewards, terminations, visible_fraction, step_info)
            self._replay.add(Batch(observations, actions, learned, reached, terminations.float()))
            losses = self._learn()
            if losses:
                self._history.add_loss(losses["qf1_loss"])
            finished = self._history.add_step(
                self._step,
                rewards.tolist(),
                step_info["visible_fraction"].tolist(),
                step_info["success"].tolist(),
                dones.tolist(),
            )
            self._episodes += len(finished)
            log.step(self._step, losses, self._exploration.amount(self._step), finished, self._history)
            observations, episode_starts = next_observations, dones
            visible_fraction = info["visible_fraction"]
            if self._step - self._checkpoint_step >= self._config.checkpoint_every:
                self._save_periodic()
        return reason

    def _learned_reward(
        self,
        rewards: Tensor,
        terminations: Tensor,
        previous_visible_fraction: Tensor,
        info: dict[str, Tensor],
    ) -> Tensor:
        """The reward that goes into the replay buffer. Shape (num_envs,)."""
        if self._config.reward == "task":
            return rewards
        return potential_reward(
            info["visible_fraction"],
            previous_visible_fraction,
            info["success"],
            terminations,
            info["reward_penalty"],
            gamma=self._config.gamma,
            step_cost=self._config.step_cost,
        )

    def _end_reason(self) -> str | None:
        config = self._config
        if config.total_timesteps is not None and self._step >= config.total_timesteps:
            return "finished"
        if config.total_episodes is not None and self._episodes >= config.total_episodes:
            return "finished"
        if config.max_minutes is not None and time.perf_counter() - self._start >= 60.0 * config.max_minutes:
            return "time budget"
        return None

    def _learn(self) -> dict[str, float]:
        """The updates owed for this step; their logs averaged, empty before learning starts."""
        config = self._config
        if self._step < config.learning_starts or len(self._replay) < config.batch_size:
            return {}
        self._updates_owed += config.updates_per_step * self._env.num_envs
        sums: dict[str, float] = {}
        counts: dict[str, int] = {}
        while self._updates_owed >= 1.0:
            self._updates_owed -= 1.0
            batch = self._replay.sample(config.batch_size, self._generator)
            logs = update(self._agent, batch, self._updates, self._generator)
            self._updates += 1
            for name, value in logs.items():
                sums[name] = sums.get(name, 0.0) + float(value)
                counts[name] = counts.get(name, 0) + 1
        means = {name: total / counts[name] for name, total in sums.items()}
        if not all(math.isfinite(value) for value in means.values()):
            listed = ", ".join(f"{name} {value:g}" for name, value in means.items())
            raise TrainingDivergedError(
                f"training diverged at step {self._step}: {listed}. Lower the learning rates or check the "
                f"rewards; the checkpoints in {self._run_dir / 'checkpoints'} are from before"
            )
        return means

    def _counters(self) -> dict[str, int | float]:
        return {
            "steps": self._step,
            "episodes": self._episodes,
            "updates": self._updates,
            "seconds": time.perf_counter() - self._start,
            "seed": self._seed,
        }

    def _save_periodic(self) -> None:
        """Writes a checkpoint of the present step, drops the oldest, writes the history."""
        folder = self._run_dir / "checkpoints"
        data = make_checkpoint(self._agent, self._env_id, self._action_bounds, self._counters())
        save_checkpoint(folder / f"step_{self._step:09d}.pt", data)
        for old in sorted(folder.glob("step_*.pt"))[:-CHECKPOINTS_KEPT]:
            old.unlink()
        self._history.save(self._run_dir)
        self._checkpoint_step = self._step

    def _save(self) -> Path:
        """The last checkpoint, and beside it the policy alone."""
        self._save_periodic()
        path = self._run_dir / "policy.pt"
        counters = self._counters()
        data = make_checkpoint(
            self._agent, self._env_id, self._action_bounds, counters, with_training_state=False
        )
        save_checkpoint(path, data)
        return path

    def _write_config(self) -> None:
        content = {
            "env_id": self._env_id,
            "seed": self._seed,
            "package_version": maniskill_tomato.__version__,
            "config": self._config.to_dict(),
        }
        write_atomically(self._run_dir / "config.json", (json.dumps(content, indent=2) + "\n").encode())


def check_run_dir(run_dir: Path) -> None:
    """Accepts a folder for a new run.

    Raises:
        InvalidInputError: It already holds a run, or is a file.
    """
    if run_dir.exists() and not run_dir.is_dir():
        raise InvalidInputError(f"{run_dir} is a file; choose another --out")
    if (run_dir / "config.json").exists():
        raise InvalidInputError(f"{run_dir} already holds a run; choose another --out or pass --overwrite")


def clear_run(run_dir: Path) -> None:
    """Removes what an earlier run wrote into `run_dir`, and nothing else."""
    if not (run_dir / "config.json").is_file():
        return
    for name in ("config.json", "episodes.csv", "history.npz", "policy.pt"):
        (run_dir / name).unlink(missing_ok=True)
    for pattern in ("checkpoints/step_*.pt", "tensorboard/events.out.tfevents.*"):
        for path in run_dir.glob(pattern):
            path.unlink()
