"""Stable-Baselines3's TD3 on a viewpoint task: the package's tasks with an off-policy learner from outside.

Needs the extra `sb3`. Example:
    python examples/sb3_td3.py --env-id TomatoViewpointSparse-v1 --total-timesteps 15000
"""

from dataclasses import dataclass

import numpy as np
import torch
import tyro
from stable_baselines3 import TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import NormalActionNoise

from maniskill_tomato.learning.rl.gymnasium_env import LearnableTask, make_gymnasium_env

GAMMA = 0.9


@dataclass(frozen=True, kw_only=True)
class Args:
    """Train TD3 and evaluate it."""

    env_id: str = "TomatoViewpointGuided-v1"
    """Id of the task."""
    total_timesteps: int = 15_000
    """Environment steps."""
    learning_starts: int = 1000
    """Steps with random actions before the first update."""
    seed: int = 0
    """Seed of weights, exploration and environment."""
    eval_episodes: int = 20
    """Evaluation episodes, from seed 1000."""


def make_model(env: LearnableTask, args: Args) -> TD3:
    """The learner.

    An episode that the time limit cuts off is no reason to value its last state at 0. Stable-Baselines3 tells
    the two ends apart by `TimeLimit.truncated`, which its vector environments derive from Gymnasium's
    `truncated`, and its replay buffer then bootstraps; `handle_timeout_termination` (its default) says so.
    """
    return TD3(
        "MlpPolicy",
        Monitor(env),
        learning_rate=1e-3,
        learning_starts=args.learning_starts,
        batch_size=256,
        tau=0.01,
        gamma=GAMMA,
        train_freq=2,
        gradient_steps=1,
        action_noise=NormalActionNoise(np.zeros(6), np.full(6, 0.3)),
        replay_buffer_kwargs={"handle_timeout_termination": True},
        policy_kwargs={"net_arch": [128, 128]},
        seed=args.seed,
        device="cpu",
    )


def evaluate(
    model: BaseAlgorithm, env: LearnableTask, episodes: int, seed: int = 1000
) -> tuple[float, float]:
    """Success rate and mean steps without exploration; episode i starts from the seed `seed + i`."""
    successes, steps = 0, 0
    for episode in range(episodes):
        observation, info = env.reset(seed=seed + episode)
        done = False
        while not done:
            action, _ = model.predict(observation, deterministic=True)
            observation, _, terminated, truncated, info = env.step(action)
            steps += 1
            done = terminated or truncated
        successes += bool(info["success"])
    return successes / episodes, steps / episodes


def main(args: Args) -> None:
    """Trains, evaluates, prints."""
    torch.set_num_threads(1)  # These networks are too small to gain from more.
    env = make_gymnasium_env(args.env_id, gamma=GAMMA)
    model = make_model(env, args)
    model.learn(args.total_timesteps)
    success, steps = evaluate(model, env, args.eval_episodes)
    print(f"success {success:.0%} of {args.eval_episodes} episodes, {steps:.1f} steps on average")
    env.close()


if __name__ == "__main__":
    main(tyro.cli(Args))
