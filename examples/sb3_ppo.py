"""Stable-Baselines3's PPO on several viewpoint environments at once, in one process or in one process each.

Needs the extra `sb3`. Example:
    python examples/sb3_ppo.py --num-envs 2 --subprocesses --total-timesteps 15000
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import torch
import tyro
from stable_baselines3 import PPO
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

from maniskill_tomato.learning.rl.gymnasium_env import Array, make_gymnasium_env

GAMMA = 0.9


@dataclass(frozen=True, kw_only=True)
class Args:
    """Train PPO and evaluate it."""

    env_id: str = "TomatoViewpointGuided-v1"
    """Id of the task."""
    total_timesteps: int = 15_000
    """Environment steps over all environments."""
    num_envs: int = 2
    """Environments at once."""
    subprocesses: bool = False
    """Give each environment a process of its own."""
    n_steps: int = 250
    """Steps of a rollout in each environment."""
    seed: int = 0
    """Seed of weights, exploration and environments."""
    eval_episodes: int = 20
    """Evaluation episodes."""


def make_monitored(env_id: str) -> Monitor[Array, Array]:
    """One environment; at the top level of the module, so that another process can import it."""
    torch.set_num_threads(1)
    return Monitor(make_gymnasium_env(env_id, gamma=GAMMA))


def make_vec_env(args: Args, count: int) -> VecEnv:
    """`count` environments; `forkserver`, because a forked copy of a running simulator is not safe."""
    makers: list[Callable[[], gym.Env[Any, Any]]] = [functools.partial(make_monitored, args.env_id)] * count
    if args.subprocesses and count > 1:
        return SubprocVecEnv(makers, start_method="forkserver")
    return DummyVecEnv(makers)


def evaluate(model: PPO, env: VecEnv, episodes: int) -> tuple[float, float]:
    """Success rate and mean steps of `episodes` episodes without exploration, one environment."""
    env.seed(1000)
    observations: Any = env.reset()
    successes, steps, finished = 0, 0, 0
    while finished < episodes:
        actions, _ = model.predict(observations, deterministic=True)
        observations, _, dones, infos = env.step(actions)
        steps += 1
        if dones[0]:  # The observation is already the next episode's; the info is still of this step.
            finished += 1
            successes += bool(infos[0]["success"])
    return successes / episodes, steps / episodes


def main(args: Args) -> None:
    """Trains, evaluates, prints."""
    torch.set_num_threads(1)  # These networks are too small to gain from more.
    env = make_vec_env(args, args.num_envs)
    model = PPO(
        "MlpPolicy",
        env,
        n_steps=args.n_steps,
        batch_size=100,
        gamma=GAMMA,
        policy_kwargs={"net_arch": [128, 128], "log_std_init": -1.2},
        seed=args.seed,
        device="cpu",
    )
    model.learn(args.total_timesteps)
    env.close()
    test_env = make_vec_env(args, 1)
    success, steps = evaluate(model, test_env, args.eval_episodes)
    print(f"success {success:.0%} of {args.eval_episodes} episodes, {steps:.1f} steps on average")
    test_env.close()


if __name__ == "__main__":
    main(tyro.cli(Args))
