"""Trains PPO (Stable-Baselines3) on a task as the on-policy comparison and evaluates it like every other policy.

Actions, observations and reward are those of the `td3` preset, for the general tasks of `general-td3`, so that only the
algorithm differs. Every seed gets a
run folder with config.json, episodes.csv, history.npz, tensorboard/, ppo.pt, eval/metrics.json, and the policy as
policy.onnx and policy.json, which `maniskill-tomato eval` takes.

Examples:
    python scripts/train_ppo.py TomatoViewpointGuided-v1 --seeds 0 1 2 --out runs/ppo-guided
    python scripts/train_ppo.py TomatoViewpointSparse-v1 --config.total-timesteps 60000 --out runs/ppo-sparse
    python scripts/train_ppo.py TomatoViewpoint-v1 --out runs/ppo-general
"""

import dataclasses
import json
import logging
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, SupportsFloat

import gymnasium as gym
import torch
import tyro
from stable_baselines3 import PPO
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import Tensor, nn
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

import maniskill_tomato
from maniskill_tomato.errors import TomatoError
from maniskill_tomato.experiments.evaluation import evaluate_run
from maniskill_tomato.experiments.training_runs import load_run
from maniskill_tomato.files import write_atomically
from maniskill_tomato.learning.interrupt import stop_on_signals
from maniskill_tomato.learning.rl.checkpoint import save_checkpoint
from maniskill_tomato.learning.rl.export import DenseActor, export_actor
from maniskill_tomato.learning.rl.gymnasium_env import Array, make_gymnasium_env, normalize_observation
from maniskill_tomato.learning.rl.history import TrainingHistory
from maniskill_tomato.learning.rl.presets import OBSERVATION_CENTRE, OBSERVATION_HALF_RANGE, get_preset
from maniskill_tomato.learning.rl.run_folder import check_run_dir
from maniskill_tomato.policies.actor import ObservationNormalizer
from maniskill_tomato.tasks import GENERAL_IDS, TASK_IDS

SPS_EVERY = 100
"""Environment steps between two points of charts/SPS."""

TD3 = get_preset("td3")


@dataclass(frozen=True, kw_only=True)
class PPOConfig:
    """How PPO learns; what it shares with the `td3` preset has that preset's value."""

    algorithm: Literal["PPO"] = "PPO"
    total_timesteps: int = 15_000
    """Environment steps; a multiple of n_steps, or a few more are taken."""
    reward: Literal["task", "potential"] = TD3.reward
    """Learn from the task's reward, or from success with V_f as a potential."""
    step_cost: float = TD3.step_cost
    """What each step costs with the potential reward."""
    gamma: float = TD3.gamma
    """Discount factor."""
    gae_lambda: float = 0.95
    """Decay of the advantage estimate."""
    n_steps: int = 500
    """Steps of a rollout."""
    batch_size: int = 100
    """Transitions per minibatch."""
    n_epochs: int = 10
    """Passes over a rollout."""
    learning_rate: float = 3e-4
    """Adam step size."""
    clip_range: float = 0.2
    """Bound on the change of the probability ratio."""
    log_std_init: float = -1.2
    """Logarithm of the first standard deviation, in units of the action scale: 0.3, as the td3 preset's noise."""
    hidden: tuple[int, ...] = TD3.actor_hidden
    """Width of the hidden layers of actor and critic."""
    action_scale: tuple[float, ...] = TD3.action_scale
    """The action that an output of 1 stands for, in [m] and [rad]."""

    def to_dict(self) -> dict[str, Any]:
        """The fields, ready for JSON."""
        return {k: list(v) if isinstance(v, tuple) else v for k, v in dataclasses.asdict(self).items()}


GENERAL_TD3 = get_preset("general-td3")

GENERAL = PPOConfig(
    total_timesteps=60_000,
    reward=GENERAL_TD3.reward,
    gamma=GENERAL_TD3.gamma,
    n_steps=1000,
    batch_size=250,
    log_std_init=-0.7,
    hidden=GENERAL_TD3.actor_hidden,
    action_scale=GENERAL_TD3.action_scale,
)
"""For the general tasks: longer rollouts over many plants, and a first standard deviation of 0.5."""


class Recorder(gym.Wrapper[Array, Array, Array, Array]):
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


class PPOPolicy:
    """The trained actor as the evaluation wants it: the task's observations in, the task's actions out."""

    def __init__(self, policy: ActorCriticPolicy, action_scale: Sequence[float]) -> None:
        self._policy = policy
        self._scale = torch.tensor(action_scale)

    def act(self, observations: Tensor) -> Tensor:
        """The most likely actions. Shape (B, action_dim)."""
        actions, _ = self._policy.predict(normalize_observation(observations.numpy()), deterministic=True)
        return torch.from_numpy(actions) * self._scale


def train(env_id: str, config: PPOConfig, run_dir: Path, seed: int, progress: bool) -> PPOPolicy | None:
    """Trains one seed in `run_dir`; None if somebody asked to stop before the end."""
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
    env = Recorder(task, run_dir)
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
    write_atomically(run_dir / "config.json", (json.dumps(content, indent=2) + "\n").encode())
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
    save_checkpoint(
        run_dir / "ppo.pt", {**content, "counters": counters, "policy": model.policy.state_dict()}
    )
    env.close()
    policy = PPOPolicy(model.policy, config.action_scale)
    export_actor(dense_actor(model.policy, policy, content, counters), run_dir / "policy.onnx")
    return policy if stop.reason is None else None


def dense_actor(
    policy: ActorCriticPolicy, acting: PPOPolicy, run: dict[str, Any], counters: dict[str, Any]
) -> DenseActor:
    """The parts of a policy for its export; `run` is the content of config.json."""
    layers = [layer for layer in policy.mlp_extractor.policy_net if isinstance(layer, nn.Linear)]
    general = run["env_id"] in GENERAL_IDS
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


@dataclass(frozen=True, kw_only=True)
class Args:
    """Train PPO with one or more seeds, one after the other, and evaluate each."""

    env_id: Annotated[
        str, tyro.conf.Positional, tyro.conf.arg(metavar="ENV_ID", help=f"One of {', '.join(TASK_IDS)}.")
    ]
    """Id of the task."""
    out: Path
    """Folder that gets a run folder seed-N for every seed."""
    seeds: tuple[int, ...] = (0,)
    """Seeds of the training runs."""
    episodes: int = 100
    """Evaluation episodes."""
    eval_seed: int = 1000
    """Seed of the first evaluation episode; the others follow."""
    progress: bool = True
    """Draw progress bars."""
    config: PPOConfig = PPOConfig()
    """How to learn."""


def main(args: Args) -> None:
    """Trains and evaluates every seed; a signal ends the present run and starts no other."""
    for seed in args.seeds:
        run_dir = args.out / f"seed-{seed}"
        policy = train(args.env_id, args.config, run_dir, seed, args.progress)
        if policy is None:
            print(f"stopped; {run_dir} holds what was learned so far")
            return
        metrics = evaluate_run(load_run(run_dir), args.episodes, args.eval_seed).metrics
        print(
            f"{run_dir}: success {metrics['success_rate']:.0%} of {args.episodes}, {metrics['mean_steps']:.1f} steps"
        )


if __name__ == "__main__":
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    try:
        asked_general = any(word in GENERAL_IDS for word in sys.argv)
        default = Args(
            env_id=tyro.MISSING, out=tyro.MISSING, config=GENERAL if asked_general else PPOConfig()
        )
        main(tyro.cli(Args, default=default))
    except TomatoError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
