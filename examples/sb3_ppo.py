"""Stable-Baselines3's PPO on many viewpoint environments at once, all in this process.

Needs the extra `sb3`. Example:
    python examples/sb3_ppo.py --num-envs 16 --total-timesteps 100000
"""

from dataclasses import dataclass
from typing import Any

import torch
import tyro
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv, VecMonitor

from maniskill_tomato.learning.rl.gymnasium_vec import make_gymnasium_vec
from maniskill_tomato.learning.rl.sb3_vec import GymnasiumVecEnv

GAMMA = 0.9


@dataclass(frozen=True, kw_only=True)
class Args:
    """Train PPO and evaluate it."""

    env_id: str = "TomatoViewpointGuided-v1"
    """Id of the task."""
    total_timesteps: int = 60_000
    """Environment steps over all environments."""
    num_envs: int = 16
    """Environments at once."""
    n_steps: int = 64
    """Steps of a rollout in each environment."""
    seed: int = 0
    """Seed of weights, exploration and environments."""
    eval_episodes: int = 20
    """Evaluation episodes."""


def make_vec_env(env_id: str, num_envs: int) -> VecEnv:
    """`num_envs` environments in Stable-Baselines3's form."""
    env = make_gymnasium_vec(env_id, num_envs, gamma=GAMMA, autoreset_mode="SameStep")
    return VecMonitor(GymnasiumVecEnv(env))


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
    env = make_vec_env(args.env_id, args.num_envs)
    model = PPO(
        "MlpPolicy",
        env,
        n_steps=args.n_steps,
        batch_size=128,
        gamma=GAMMA,
        policy_kwargs={"net_arch": [128, 128], "log_std_init": -1.2},
        seed=args.seed,
        device="cpu",
    )
    model.learn(args.total_timesteps)
    env.close()
    test_env = make_vec_env(args.env_id, 1)
    success, steps = evaluate(model, test_env, args.eval_episodes)
    print(f"success {success:.0%} of {args.eval_episodes} episodes, {steps:.1f} steps on average")
    test_env.close()


if __name__ == "__main__":
    main(tyro.cli(Args))
