"""TD3 in one file over a Gymnasium vector environment: what a learner of your own needs to know of the tasks.

Gymnasium 1.x has two ways to reset environments by themselves, and both are handled here (`learnable_steps`):
`SameStep` resets within the step that ends the episode, `NextStep` (Gymnasium's default) in the step after.

Examples:
    python examples/cleanrl_style.py --total-timesteps 15000
    python examples/cleanrl_style.py --num-envs 64 --autoreset-mode NextStep
"""

import copy
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
import tyro
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import mse_loss

from maniskill_tomato.learning.rl.gymnasium_vec import LearnableVector, make_gymnasium_vec

Array = NDArray[np.float32]


@dataclass(frozen=True, kw_only=True)
class Args:
    """Train TD3 and evaluate it."""

    env_id: str = "TomatoViewpointGuided-v1"
    seed: int = 0
    total_timesteps: int = 15_000
    num_envs: int = 16
    autoreset_mode: Literal["SameStep", "NextStep"] = "SameStep"
    learning_starts: int = 1000
    updates_per_step: float = 0.5
    batch_size: int = 256
    buffer_size: int = 100_000
    learning_rate: float = 1e-3
    gamma: float = 0.9
    tau: float = 0.01
    policy_frequency: int = 2
    exploration_noise: float = 0.3
    target_noise: float = 0.2
    noise_clip: float = 0.5
    eval_episodes: int = 20


def learnable_steps(
    observations: Array, infos: Mapping[str, Any], done_before: NDArray[np.bool_], mode: AutoresetMode
) -> tuple[NDArray[np.bool_], Array]:
    """Which rows of a vector step are steps of the task, and the observations that those steps reached.

    With `NEXT_STEP`, the step after the end of an episode ignores its action and only resets: there is nothing to
    learn from that row. With `SAME_STEP`, every row is a step, but where an episode ended the observation is
    already the next episode's, and the one that the step reached is in `infos["final_obs"]`.

    Args:
        observations: What the vector step returned. Shape (N, observation_dim).
        infos: Its info.
        done_before: Which episodes the step before had ended. Shape (N,).
        mode: The vector environment's way to reset.

    Returns:
        A mask of shape (N,), and observations of shape (N, observation_dim).
    """
    if mode == AutoresetMode.NEXT_STEP:
        return ~done_before, observations
    reached = observations.copy()
    for row in np.flatnonzero(infos.get("_final_obs", ())):
        reached[row] = infos["final_obs"][row]
    return np.ones(len(observations), dtype=np.bool_), reached


def make_network(inputs: int, outputs: int, *last: nn.Module) -> nn.Sequential:
    """Two hidden layers of 128."""
    return nn.Sequential(
        nn.Linear(inputs, 128), nn.ReLU(), nn.Linear(128, 128), nn.ReLU(), nn.Linear(128, outputs), *last
    )


class Learner:
    """TD3 (Fujimoto et al., 2018): twin critics, smoothed target actions, delayed actor."""

    def __init__(self, args: Args, observation_dim: int, action_dim: int) -> None:
        self.args, self.updates = args, 0
        self.actor = make_network(observation_dim, action_dim, nn.Tanh())
        self.critics = nn.ModuleList(make_network(observation_dim + action_dim, 1) for _ in range(2))
        self.target_actor, self.target_critics = copy.deepcopy(self.actor), copy.deepcopy(self.critics)
        self.actor_optimizer = torch.optim.Adam(self.actor.parameters(), lr=args.learning_rate)
        self.critic_optimizer = torch.optim.Adam(self.critics.parameters(), lr=args.learning_rate)

    @torch.no_grad()
    def act(self, observations: Array) -> Array:
        """Actions without exploration."""
        actions: Array = self.actor(torch.as_tensor(observations)).numpy()
        return actions

    def update(
        self, observations: Tensor, actions: Tensor, rewards: Tensor, reached: Tensor, ends: Tensor
    ) -> None:
        """One update of the critics, every `policy_frequency`-th time also of the rest."""
        args = self.args
        with torch.no_grad():
            noise = (args.target_noise * torch.randn_like(actions)).clamp(-args.noise_clip, args.noise_clip)
            next_actions = (self.target_actor(reached) + noise).clamp(-1.0, 1.0)
            value = values(self.target_critics, reached, next_actions).amin(dim=0)
            # Only a real end is worth nothing afterwards; an episode that ran out of time goes on in truth.
            goal = rewards + args.gamma * (1.0 - ends) * value
        found = values(self.critics, observations, actions)
        self.critic_optimizer.zero_grad()
        torch.autograd.backward(2.0 * mse_loss(found, goal.expand_as(found)))
        self.critic_optimizer.step()
        self.updates += 1
        if self.updates % args.policy_frequency == 0:
            self.actor_optimizer.zero_grad()
            torch.autograd.backward(-values(self.critics, observations, self.actor(observations))[0].mean())
            self.actor_optimizer.step()
            with torch.no_grad():
                for ours, theirs in ((self.actor, self.target_actor), (self.critics, self.target_critics)):
                    for own, target in zip(ours.parameters(), theirs.parameters(), strict=True):
                        target.lerp_(own, args.tau)


def values(critics: nn.ModuleList, observations: Tensor, actions: Tensor) -> Tensor:
    """Shape (2, B)."""
    inputs = torch.cat((observations, actions), dim=-1)
    return torch.stack([critic(inputs).squeeze(-1) for critic in critics])


def train(args: Args, envs: LearnableVector) -> Learner:
    """Steps the environments and learns; prints one line per tenth of the run."""
    random = np.random.default_rng(args.seed)
    torch.manual_seed(args.seed)
    observations, _ = envs.reset(seed=args.seed)
    (n, dim), (_, action_dim) = observations.shape, envs.action_space.sample().shape
    learner = Learner(args, dim, action_dim)
    replay = [torch.zeros(args.buffer_size, *shape) for shape in ((dim,), (action_dim,), (), (dim,), ())]
    done = np.zeros(n, dtype=np.bool_)
    step, episodes, owed, start = 0, 0, 0.0, time.perf_counter()
    while step < args.total_timesteps:
        actions = random.uniform(-1.0, 1.0, (n, action_dim)).astype(np.float32)
        if step >= args.learning_starts:
            # It fades, so that the policy learns to do without: what succeeds with noise may stand still without it.
            amount = args.exploration_noise * (1.0 - 0.9 * step / args.total_timesteps)
            noise = amount * random.standard_normal((n, action_dim), np.float32)
            actions = (learner.act(observations) + noise).clip(-1.0, 1.0)
        following, rewards, terminations, truncations, infos = envs.step(actions)
        real, reached = learnable_steps(following, infos, done, envs.metadata["autoreset_mode"])
        where = (step + np.arange(real.sum())) % args.buffer_size
        for store, rows in zip(replay, (observations, actions, rewards, reached, terminations), strict=True):
            store[where] = torch.as_tensor(rows[real], dtype=torch.float32)
        observations, done = following, terminations | truncations
        before, step = step, step + int(real.sum())
        episodes += int(done.sum())
        owed += args.updates_per_step * (step - before) if before >= args.learning_starts else 0.0
        while owed >= 1.0:
            owed -= 1.0
            batch = torch.randint(min(step, args.buffer_size), (args.batch_size,))
            learner.update(*(store[batch] for store in replay))
        if 10 * step // args.total_timesteps > 10 * before // args.total_timesteps:
            rate = step / (time.perf_counter() - start)
            print(
                f"step {step}, {episodes} episodes, {learner.updates} updates, {rate:.0f} steps/s", flush=True
            )
    return learner


def evaluate(args: Args, learner: Learner) -> tuple[float, float]:
    """Success rate and mean steps without exploration, all episodes at once; episode i starts from seed 1000 + i."""
    envs = make_gymnasium_vec(args.env_id, args.eval_episodes, autoreset_mode="SameStep")
    observations, _ = envs.reset(seed=1000)
    successes, steps = 0, 0
    running = np.ones(args.eval_episodes, dtype=np.bool_)
    while running.any():
        observations, _, terminations, truncations, infos = envs.step(learner.act(observations))
        steps += int(running.sum())
        ended = running & (terminations | truncations)
        successes += int(infos["final_info"]["success"][ended].sum()) if ended.any() else 0
        running &= ~ended
    return successes / args.eval_episodes, steps / args.eval_episodes


def main(args: Args) -> None:
    """Trains, evaluates, prints."""
    torch.set_num_threads(1)  # These networks are too small to gain from more.
    envs = make_gymnasium_vec(
        args.env_id, args.num_envs, gamma=args.gamma, autoreset_mode=args.autoreset_mode
    )
    success, steps = evaluate(args, train(args, envs))
    print(f"success {success:.0%} of {args.eval_episodes} episodes, {steps:.1f} steps on average")


if __name__ == "__main__":
    main(tyro.cli(Args))
