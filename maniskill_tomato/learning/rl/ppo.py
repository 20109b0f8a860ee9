"""PPO (Stable-Baselines3) as the on-policy comparison, needs the extra `sb3`.

Actions, observations and reward are those of the preset `td3`, for the general tasks of `general-td3`, so that only the
algorithm differs.
"""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, SupportsFloat

import gymnasium as gym
import torch
from torch import Tensor, nn
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

import maniskill_tomato
from maniskill_tomato.errors import MissingPackageError
from maniskill_tomato.files import write_json, write_tensors
from maniskill_tomato.folder_lock import only_writer
from maniskill_tomato.learning.interrupt import stop_on_signals
from maniskill_tomato.learning.rl.dense_actor import DenseActor
from maniskill_tomato.learning.rl.export import export_actor
from maniskill_tomato.learning.rl.gymnasium_env import Array, make_gymnasium_env, normalize_observation
from maniskill_tomato.learning.rl.history import TrainingHistory
from maniskill_tomato.learning.rl.ppo_config import PpoConfig
from maniskill_tomato.learning.rl.presets import OBSERVATION_CENTRE, OBSERVATION_HALF_RANGE
from maniskill_tomato.learning.rl.run_folder import check_run_dir
from maniskill_tomato.policies.actor import ObservationNormalizer
from maniskill_tomato.task_registry import GENERAL_IDS, base_of

try:
    from stable_baselines3 import PPO
    from stable_baselines3.common.logger import Logger
    from stable_baselines3.common.policies import ActorCriticPolicy
except ImportError as error:
    raise MissingPackageError.extra("stable-baselines3", "sb3") from error

SPS_EVERY = 100
"""Environment steps between two points of charts/SPS."""


class HistoryWrapper(gym.Wrapper[Array, Array, Array, Array]):
    """Keeps the history of the training, and TensorBoard's charts."""

    def __init__(self, env: gym.Env[Array, Array], run_dir: Path) -> None:
        super().__init__(env)
        self.history = TrainingHistory(1)
        self.steps = 0
        self._folder = run_dir / "tensorboard"
        self._writer: SummaryWriter | None = None
        self._start = 0.0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        if self._writer is None:  # Only now, so that the clock of the event file starts with the training.
            self._writer = SummaryWriter(str(self._folder))
            self._start = time.perf_counter()
        return self.env.reset(seed=seed, options=options)

    def step(self, action: Array) -> tuple[Array, SupportsFloat, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        self.steps += 1
        finished = self.history.add_step(
            self.steps,
            [info["task_reward"]],
            [info["visible_fraction"]],
            [info["success"]],
            [terminated or truncated],
        )
        if self._writer is not None:
            for record in finished:
                self._writer.add_scalar("charts/episodic_return", record.episodic_return, self.steps)
                self._writer.add_scalar("charts/episodic_length", record.steps, self.steps)
                self._writer.add_scalar("charts/success", float(record.success), self.steps)
            if self.steps % SPS_EVERY == 0:
                rate = self.steps / (time.perf_counter() - self._start)
                self._writer.add_scalar("charts/SPS", rate, self.steps)
        return observation, reward, terminated, truncated, info

    def close(self) -> None:
        if self._writer is not None:
            self._writer.close()
        super().close()


class PpoPolicy:
    """The trained actor as the evaluation wants it: the task's observations in, the task's actions out."""

    def __init__(self, policy: ActorCriticPolicy, action_scale: Sequence[float]) -> None:
        self._policy = policy
        self._scale = torch.tensor(action_scale)

    def act(self, observations: Tensor) -> Tensor:
        """The most likely actions. Shape (B, action_dim)."""
        actions, _ = self._policy.predict(normalize_observation(observations.numpy()), deterministic=True)
        return torch.from_numpy(actions) * self._scale


def train_ppo(env_id: str, config: PpoConfig, run_dir: Path, seed: int, progress: bool) -> bool:
    """Trains one seed.

    Args:
        env_id: The task.
        config: How to learn.
        run_dir: Folder of config.json, episodes.csv, history.npz, tensorboard/, ppo.pt and the policy as policy.onnx
            and policy.json.
        seed: Of everything that is random.
        progress: Draw a bar.

    Returns:
        Whether it trained to the end; False if somebody asked to stop.

    Raises:
        InvalidInputError: The folder holds a run.
        CheckpointError: Another process trains in the folder, or it cannot be made.
    """
    with only_writer(run_dir, "trains"):
        return _train(env_id, config, run_dir, seed, progress)


def _train(env_id: str, config: PpoConfig, run_dir: Path, seed: int, progress: bool) -> bool:
    check_run_dir(run_dir)
    torch.set_num_threads(1)
    content = {
        "env_id": env_id,
        "seed": seed,
        "package_version": maniskill_tomato.__version__,
        "config": config.to_dict(),
    }
    task = make_gymnasium_env(
        env_id,
        action_scale=config.action_scale,
        reward=config.reward,
        gamma=config.gamma,
        step_cost=config.step_cost,
    )
    env = HistoryWrapper(task, run_dir)
    model = PPO(
        "MlpPolicy",
        env,
        learning_rate=config.learning_rate,
        n_steps=config.n_steps,
        batch_size=config.batch_size,
        n_epochs=config.n_epochs,
        gamma=config.gamma,
        gae_lambda=config.gae_lambda,
        clip_range=config.clip_range,
        policy_kwargs={"net_arch": list(config.hidden), "log_std_init": config.log_std_init},
        seed=seed,
        device="cpu",
    )
    model.set_logger(Logger(None, []))  # Its default is a folder among the system's temporary files.
    write_json(run_dir / "config.json", content)
    start = time.perf_counter()
    with (
        stop_on_signals() as stop,
        tqdm(total=config.total_timesteps, desc=f"PPO, seed {seed}", disable=not progress) as bar,
    ):

        def after_step(local: dict[str, Any], glob: dict[str, Any]) -> bool:
            bar.update()
            return stop.reason is None

        model.learn(config.total_timesteps, callback=after_step)
    seconds = time.perf_counter() - start
    env.history.save(run_dir)
    counters = {"steps": env.steps, "episodes": len(env.history.episodes), "seconds": seconds, "seed": seed}
    write_tensors(run_dir / "ppo.pt", {**content, "counters": counters, "policy": model.policy.state_dict()})
    env.close()
    policy = PpoPolicy(model.policy, config.action_scale)
    export_actor(dense_actor(model.policy, policy, content, counters), run_dir / "policy.onnx")
    return stop.reason is None


def dense_actor(
    policy: ActorCriticPolicy, acting: PpoPolicy, run: dict[str, Any], counters: dict[str, Any]
) -> DenseActor:
    """The parts of a policy for its export; `run` is the content of config.json."""
    layers = [layer for layer in policy.mlp_extractor.policy_net if isinstance(layer, nn.Linear)]
    general = base_of(run["env_id"]) in GENERAL_IDS
    actions = len(run["config"]["action_scale"])
    return DenseActor(
        act=acting.act,
        normalizer=ObservationNormalizer.identity(layers[0].in_features)
        if general
        else ObservationNormalizer(OBSERVATION_CENTRE, OBSERVATION_HALF_RANGE),
        normalizer_kind="none" if general else "fixed",
        layers=[*layers, policy.action_net],
        activation="Tanh",
        output="Clip",
        action_scale=torch.tensor(run["config"]["action_scale"]),
        action_low=-torch.ones(actions),
        action_high=torch.ones(actions),
        env_id=run["env_id"],
        env_options={},
        package_version=run["package_version"],
        algorithm="PPO",
        counters=counters,
        config=run["config"],
    )
