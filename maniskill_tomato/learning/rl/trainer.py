"""A training run: the environments made, and the loop (Algorithm 2): act, store, update, log, keep checkpoints."""

import errno
import logging
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import torch
from torch import Tensor

from maniskill_tomato.errors import CheckpointError, InvalidInputError, TrainingDivergedError
from maniskill_tomato.files import write_tensors
from maniskill_tomato.folder_lock import only_writer
from maniskill_tomato.learning.imitation.trajectory_file import read_demonstrations
from maniskill_tomato.learning.interrupt import StopRequest, stop_on_signals
from maniskill_tomato.learning.rl.agent import begin_with, check_fits, update
from maniskill_tomato.learning.rl.checkpoint import make_checkpoint
from maniskill_tomato.learning.rl.demonstrated_reward import (
    DemonstratedReward,
    DemonstratedTransitions,
    RewardModel,
)
from maniskill_tomato.learning.rl.envs import LearnerEnv, make_learner_env
from maniskill_tomato.learning.rl.observations import columns_of, device_of, eyes_of
from maniskill_tomato.learning.rl.presets import TrainConfig
from maniskill_tomato.learning.rl.progress import Progress, TrainingLog
from maniskill_tomato.learning.rl.replay import Batch
from maniskill_tomato.learning.rl.rewards import training_reward
from maniskill_tomato.learning.rl.run_folder import (
    check_run_dir,
    checkpoint_path,
    checkpoints,
    clear_run,
    newest_good_checkpoint,
    remove_results,
    write_config,
)
from maniskill_tomato.learning.rl.training_state import TrainingState, seed_global_random_state
from maniskill_tomato.learning.rl.wandb_log import import_wandb
from maniskill_tomato.policies.trained_actor import TrainedActor, load_actor
from maniskill_tomato.sensing.image_observation import STATE, state_of
from maniskill_tomato.task_registry import find_task
from maniskill_tomato.tasks.numpy_streams import spread_seed

logger = logging.getLogger(__name__)

DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO)
"""What a system answers when it cannot take what is written."""


@dataclass(frozen=True, kw_only=True)
class TrainResult:
    """How a run ended."""

    run_dir: Path
    policy_path: Path
    """The final policy, for `load_actor`."""
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
        env_options: dict[str, Any] | None = None,
        resume: bool = False,
        report: Callable[[Progress], None] | None = None,
        reward_model: RewardModel | None = None,
    ) -> None:
        """Prepares a run; nothing is stepped or written yet.

        Args:
            env: The environment; the caller closes it.
            env_id: Its id, kept in the checkpoints.
            config: How to learn.
            run_dir: Folder of the run; it must not hold another one.
            seed: Seed of the environment, the weights, the replay and the exploration.
            show_progress: Whether to draw a progress bar.
            env_options: The options that `env` was made with, kept in `config.json`.
            resume: Go on with the run in `run_dir` from its newest checkpoint, bit for bit as if it had never
                stopped.
            report: Called about twice a second with where the run is.
            reward_model: Judges in place of the task; by default the one that `config.reward_from` asks for.

        Raises:
            InvalidInputError: `run_dir` already holds a run and `resume` is off, or holds none and it is on,
                `config` does not fit `env`, or it asks for Weights & Biases and that is not installed.
        """
        observation_space, action_space = env.single_observation_space, env.single_action_space
        columns = columns_of(observation_space)
        if not isinstance(action_space, gym.spaces.Box):
            raise InvalidInputError(f"training needs a Box of actions, got {action_space}")
        (action_dim,) = action_space.shape
        ((observation_dim,), _) = columns[STATE if STATE in columns else ""]
        if len(config.action_scale) != action_dim:
            raise InvalidInputError(
                f"action_scale must have {action_dim} values, one per action of {env_id}, got "
                f"{len(config.action_scale)}; the presets called general-... are for the general tasks"
            )
        if config.wandb_project is not None:
            import_wandb(config.wandb_project)
        self._given: TrainedActor | None = None
        if config.initial_policy is not None and not resume:
            self._given = load_actor(config.initial_policy, env_id=env_id)
            check_fits(self._given, config, observation_dim)
        self._reward_model = reward_model
        self._shown: DemonstratedTransitions | None = None
        if config.reward_from is not None:
            demonstrations = read_demonstrations(Path(config.reward_from), env_id)
            self._shown = DemonstratedTransitions(demonstrations, config)
            self._shown.check_fits(observation_dim, action_dim)
            self._reward_model = reward_model or DemonstratedReward(demonstrations, config, seed)
        if not resume:
            check_run_dir(run_dir)
        elif not (run_dir / "config.json").is_file():
            raise InvalidInputError(f"{run_dir} holds no run to continue (no config.json)")
        if config.too_short():
            logger.warning(
                "nothing will be learned: %s steps end before learning_starts (%s) or before a batch of %s is there",
                config.total_timesteps,
                config.learning_starts,
                config.batch_size,
            )
        self._env = env
        self._env_id = env_id
        self._config = config
        self._run_dir = run_dir
        self._seed = seed
        self._show_progress = show_progress
        self._env_options = env_options or {}
        self._resume = resume
        self._report = report
        self._dims = observation_dim, action_dim
        self._action_bounds = torch.as_tensor(action_space.low), torch.as_tensor(action_space.high)
        self._checkpoint_step = 0
        self._start = self._checkpoint_time = time.perf_counter()

    def run(self) -> TrainResult:
        """Trains until the configured end, a signal or an error.

        Ctrl-C and SIGTERM end the run after the present step with everything saved; a second one stops at
        once. However it ends, `resume` goes on from its newest checkpoint.

        Raises:
            InvalidInputError: The environment does not tell what an option needs; nothing was written.
            TrainingDivergedError: A loss, reward, action or weight is not finite; the last good checkpoint stays.
            CheckpointError: The disk does not take a file, another process trains in the folder, or there is
                nothing to go on from. What was saved before stays.
        """
        with only_writer(self._run_dir, "trains"):
            try:
                return self._run()
            except OSError as error:
                if error.errno not in DISK_ERRORS:
                    raise
                raise CheckpointError(
                    f"cannot write to {self._run_dir}: {error.strerror or error}; the last checkpoint, of step "
                    f"{self._checkpoint_step}, is kept. Free some space and go on with --resume {self._run_dir}"
                ) from error

    def _run(self) -> TrainResult:
        torch.set_num_threads(self._config.torch_threads)
        seed_global_random_state(self._seed)
        saved = self._saved_run()
        seeds = spread_seed(self._seed, self._env.num_envs)
        observations, info = self._env.reset(seed=self._seed if len(seeds) == 1 else seeds)
        self._state = state = TrainingState(
            self._env,
            self._config,
            self._dims,
            self._seed,
            observations,
            info,
            self._run_dir,
            self._reward_model,
        )
        write_config(self._run_dir, self._env_id, self._seed, self._env_options, self._config.to_dict())
        self._scale = torch.tensor(self._config.action_scale, device=device_of(observations))
        if self._shown is not None:
            self._shown.to(self._scale.device)
        self._start = self._checkpoint_time = time.perf_counter()
        if self._given is not None:
            begin_with(state.agent, self._given)
        if saved is not None:
            state.restore(saved)
            self._checkpoint_step = state.step
            self._start -= saved["counters"]["seconds"]
            state.history.save(self._run_dir)
            logger.info("%s goes on from step %d", self._run_dir, state.step)
        log_state = None if saved is None else saved["run"]["log"]
        done = (state.step, state.episodes)
        with (
            stop_on_signals() as stop,
            TrainingLog(
                self._run_dir, self._config, self._show_progress, self._start, self._report, log_state, done
            ) as log,
        ):
            self._log = log
            reason = self._loop(stop)
            seconds = time.perf_counter() - self._start
            policy_path = self._save()
            log.tell(state.step, state.history)
        logger.info("training ended (%s) after %d steps; policy in %s", reason, state.step, policy_path)
        return TrainResult(
            run_dir=self._run_dir,
            policy_path=policy_path,
            steps=state.step,
            episodes=state.episodes,
            updates=state.updates,
            seconds=seconds,
            stop_reason=reason,
        )

    def _loop(self, stop: StopRequest) -> str:
        """Steps until the end; returns why it ended."""
        state = self._state
        while (reason := stop.reason or self._end_reason()) is None:
            observations = state.observations
            state.agent.observe(observations)
            actions = state.exploration.explore(
                state.agent.policy(observations), state_of(observations), state.step, state.episode_starts
            )
            self._check_finite(action=actions)
            next_observations, rewards, terminations, truncations, info = self._env.step(
                actions * self._scale
            )
            dones = terminations | truncations
            state.step += self._env.num_envs
            # At the end of an episode `next_observations` is already the start of the next one.
            step_info = info.get("final_info", info)
            reached = info.get("final_obs", next_observations)
            learned = torch.zeros_like(rewards)
            if state.reward_model is None:
                learned = training_reward(
                    self._config, rewards, terminations, state.visible_fraction, step_info
                )
            self._check_finite(reward=learned, observation=state_of(reached))
            batch = Batch(observations, actions, learned, reached, terminations.float())
            state.experience.add(batch, step_info, info)
            losses = self._learn()
            if losses:
                state.history.add_loss(losses["qf1_loss"])
            finished = state.history.add_step(
                state.step,
                rewards.tolist(),
                step_info["visible_fraction"].tolist(),
                step_info["success"].tolist(),
                dones.tolist(),
            )
            state.episodes += len(finished)
            amount = state.exploration.amount(state.step)
            self._log.step(state.step, losses, amount, finished, state.history)
            state.observations, state.episode_starts = next_observations, dones
            state.visible_fraction = info["visible_fraction"]
            if self._checkpoint_is_due():
                self._save_periodic()
        return reason

    def _checkpoint_is_due(self) -> bool:
        if self._state.step - self._checkpoint_step >= self._config.checkpoint_every:
            return True
        longest = self._config.checkpoint_seconds
        return longest is not None and time.perf_counter() - self._checkpoint_time >= longest

    def _end_reason(self) -> str | None:
        config = self._config
        if config.total_timesteps is not None and self._state.step >= config.total_timesteps:
            return "finished"
        if config.total_episodes is not None and self._state.episodes >= config.total_episodes:
            return "finished"
        if config.max_minutes is not None and time.perf_counter() - self._start >= 60.0 * config.max_minutes:
            return "time budget"
        return None

    def _learn(self) -> dict[str, float]:
        """The updates owed for this step; their logs averaged, empty before learning starts."""
        config, state = self._config, self._state
        if state.step < config.learning_starts or len(state.replay) < config.batch_size:
            return {}
        state.updates_owed += config.updates_per_step * self._env.num_envs
        sums: dict[str, float] = {}
        counts: dict[str, int] = {}
        while state.updates_owed >= 1.0:
            state.updates_owed -= 1.0
            batch = state.replay.sample(config.batch_size, state.generator)
            logs = {}
            if state.reward_model is not None:
                logs = state.reward_model.update(batch, state.agent.normalizer, state.generator)
                if self._shown is not None:
                    batch = self._shown.beside(batch, state.generator)
                batch = state.reward_model.judge(batch, state.agent.normalizer)
            logs |= update(state.agent, batch, state.updates, state.generator)
            state.updates += 1
            for name, value in logs.items():
                sums[name] = sums.get(name, 0.0) + float(value)
                counts[name] = counts.get(name, 0) + 1
        means = {name: total / counts[name] for name, total in sums.items()}
        if not all(math.isfinite(value) for value in means.values()):
            raise self._diverged(", ".join(f"{name} {value:g}" for name, value in means.items()))
        return means

    def _check_finite(self, **tensors: Tensor) -> None:
        for name, values in tensors.items():
            if not bool(values.isfinite().all()):
                raise self._diverged(f"{name} {values.flatten()[:8].tolist()}")

    def _diverged(self, listed: str) -> TrainingDivergedError:
        return TrainingDivergedError(
            f"training diverged at step {self._state.step}: {listed}. Lower the learning rates or check the "
            f"rewards; the checkpoints in {self._run_dir / 'checkpoints'} are from before"
        )

    def _counters(self) -> dict[str, int | float]:
        return {
            "steps": self._state.step,
            "episodes": self._state.episodes,
            "updates": self._state.updates,
            "seconds": time.perf_counter() - self._start,
            "seed": self._seed,
        }

    def _saved_run(self) -> dict[str, Any] | None:
        """The checkpoint to go on from, or None for a run that begins."""
        if not self._resume:
            return None
        saved = newest_good_checkpoint(self._run_dir, self._env_id, self._seed, self._config.to_dict())
        if saved is None:
            logger.info("%s was stopped before its first checkpoint; it begins again", self._run_dir)
            remove_results(self._run_dir)
        elif saved["run"]["torch_version"] != torch.__version__:
            logger.warning(
                "the run was begun with torch %s; with torch %s its last digits may differ",
                saved["run"]["torch_version"],
                torch.__version__,
            )
        return saved

    def _save_periodic(self) -> None:
        """Writes a checkpoint of the present step, drops the oldest, writes the history."""
        state = self._state
        eye = () if state.agent.encoder is None else state.agent.encoder.parameters()
        weights = (*state.agent.actor.parameters(), *state.agent.critics.parameters(), *eye)
        self._check_finite(weights=torch.cat([w.detach().flatten() for w in weights]))
        data = make_checkpoint(
            state.agent,
            self._env_id,
            self._action_bounds,
            self._counters(),
            run=state.run_state(self._log.state_dict()),
            env_options=self._env_options,
        )
        write_tensors(checkpoint_path(self._run_dir, state.step), data)
        for old in checkpoints(self._run_dir)[: -self._config.checkpoints_kept]:
            old.unlink()
        state.history.save(self._run_dir)
        self._checkpoint_step, self._checkpoint_time = state.step, time.perf_counter()

    def _save(self) -> Path:
        """The last checkpoint, and beside it the policy alone."""
        self._save_periodic()
        path = self._run_dir / "policy.pt"
        counters = self._counters()
        data = make_checkpoint(
            self._state.agent,
            self._env_id,
            self._action_bounds,
            counters,
            with_training_state=False,
            env_options=self._env_options,
        )
        write_tensors(path, data)
        return path


def train(
    env_id: str,
    config: TrainConfig,
    run_dir: Path,
    seed: int,
    env_options: dict[str, Any],
    *,
    overwrite: bool = False,
    resume: bool = False,
    show_progress: bool = True,
    report: Callable[[Progress], None] | None = None,
) -> TrainResult:
    """Trains in `run_dir`.

    Args:
        env_id: Id of the task.
        config: How to learn.
        run_dir: Folder of the run.
        seed: Seed of everything that is random.
        env_options: Options of the task for `gymnasium.make`.
        overwrite: Remove an earlier run from the folder.
        resume: Go on with the run in the folder.
        show_progress: Whether to draw a progress bar.
        report: Called about twice a second with where the run is.

    Raises:
        InvalidInputError: The id, an option or the folder cannot be used.
        CheckpointError: The run cannot be saved or continued.
        TrainingDivergedError: Something is not finite any more.
    """
    find_task(env_id)
    if overwrite:
        clear_run(run_dir)
    if not resume:
        check_run_dir(run_dir)
    env = make_training_env(env_id, config, env_options)
    try:
        trainer = Trainer(
            env,
            env_id,
            config,
            run_dir,
            seed,
            show_progress,
            env_options=env_options,
            resume=resume,
            report=report,
        )
        return trainer.run()
    finally:
        env.close()


def make_training_env(env_id: str, config: TrainConfig, env_options: dict[str, Any]) -> LearnerEnv:
    """The environments that a configuration trains in, telling what its hindsight needs.

    Raises:
        InvalidInputError: The id or an option cannot be used.
    """
    needed = {"other_targets": config.hindsight_targets} if config.hindsight_targets else {}
    eyes = eyes_of(config)
    return make_learner_env(env_id, config.num_envs, eyes=eyes, **{**needed, **env_options})
