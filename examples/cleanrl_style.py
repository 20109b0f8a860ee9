"""TD3 in one file over Gymnasium's vector environments: what a learner of your own needs to know of the tasks.

Gymnasium 1.x has two ways to reset a sub-environment by itself, and both are handled here (`learnable_steps`):
`same-step` resets it within the step that ends the episode, `next-step` (Gymnasium's default) in the step after.

Examples:
    python examples/cleanrl_style.py --total-timesteps 15000
    python examples/cleanrl_style.py --num-envs 2 --vectorization async --autoreset next-step
"""

import copy
import functools
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import gymnasium as gym
import numpy as np
import torch
import tyro
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import mse_loss

from maniskill_tomato.learning.rl.gymnasium_env import Array, LearnableTask, make_gymnasium_env

VectorEnv = gym.vector.VectorEnv[Array, Array, NDArray[Any]]


@dataclass(frozen=True, kw_only=True)
class Args:
    """Train TD3 and evaluate it."""

    env_id: str = "TomatoViewpointGuided-v1"
    """Id of the task."""
    seed: int = 0
    """Seed of weights, exploration and environments."""
    total_timesteps: int = 15_000
    """Environment steps over all environments."""
    num_envs: int = 2
    """Environments at once."""
    vectorization: Literal["sync", "async"] = "sync"
    """One after the other in this process, or each in a process of its own."""
    autoreset: Literal["same-step", "next-step"] = "same-step"
    """When a finished sub-environment resets itself."""
    learning_starts: int = 1000
    """Steps with random actions before the first update."""
    updates_per_step: float = 0.5
    """Updates per environment step."""
    batch_size: int = 256
    buffer_size: int = 100_000
    learning_rate: float = 1e-3
    gamma: float = 0.9
    tau: float = 0.01
    """Share by which the target networks follow."""
    policy_frequency: int = 2
    """Critic updates per update of the actor and the targets."""
    exploration_noise: float = 0.3
    """Standard deviation, in units of the largest action."""
    target_noise: float = 0.2
    """Standard deviation of the noise on target actions."""
    noise_clip: float = 0.5
    """Bound of that noise."""
    eval_episodes: int = 20
    """Evaluation episodes, from seed 1000."""


def make_task(env_id: str, gamma: float) -> LearnableTask:
    """One sub-environment, in this process or in a worker."""
    torch.set_num_threads(1)
    return make_gymnasium_env(env_id, gamma=gamma)


def make_envs(args: Args) -> VectorEnv:
    """The vector environment; workers come from a fork server, as forking a running simulator is not safe."""
    makers = [functools.partial(make_task, args.env_id, args.gamma)] * args.num_envs
    mode = AutoresetMode.SAME_STEP if args.autoreset == "same-step" else AutoresetMode.NEXT_STEP
    if args.vectorization == "async":
        return AsyncVectorEnv(makers, context="forkserver", autoreset_mode=mode)
    return SyncVectorEnv(makers, autoreset_mode=mode)


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


class Replay:
    """A ring of transitions."""

    def __init__(self, size: int, observation_dim: int, action_dim: int) -> None:
        self.observations, self.reached = torch.zeros(2, size, observation_dim)
        self.actions = torch.zeros(size, action_dim)
        self.rewards, self.terminations = torch.zeros(2, size)
        self.count = 0

    def add(self, *rows: NDArray[Any]) -> None:
        """Adds observations, actions, rewards, reached observations and terminations, one row per transition."""
        where = (self.count + np.arange(len(rows[0]))) % len(self.rewards)
        for store, values in zip(self._stores(), rows, strict=True):
            store[where] = torch.as_tensor(values, dtype=torch.float32)
        self.count += len(where)

    def sample(self, batch_size: int) -> list[Tensor]:
        """A random batch, in the order of `add`."""
        where = torch.randint(min(self.count, len(self.rewards)), (batch_size,))
        return [store[where] for store in self._stores()]

    def _stores(self) -> tuple[Tensor, ...]:
        return self.observations, self.actions, self.rewards, self.reached, self.terminations


def make_network(inputs: int, outputs: int, *last: nn.Module) -> nn.Sequential:
    """Two hidden layers of 128."""
    return nn.Sequential(
        nn.Linear(inputs, 128), nn.ReLU(), nn.Linear(128, 128), nn.ReLU(), nn.Linear(128, outputs), *last
    )


class Learner:
    """TD3 (Fujimoto et al., 2018): twin critics, smoothed target actions, delayed actor."""

    def __init__(self, args: Args, observation_dim: int, action_dim: int) -> None:
        self.args = args
        self.actor = make_network(observation_dim, action_dim, nn.Tanh())
        self.critics = nn.ModuleList(make_network(observation_dim + action_dim, 1) for _ in range(2))
        self.target_actor = copy.deepcopy(self.actor)
        self.target_critics = copy.deepcopy(self.critics)
        self.actor_optimizer = torch.optim.Adam(self.actor.parameters(), lr=args.learning_rate)
        self.critic_optimizer = torch.optim.Adam(self.critics.parameters(), lr=args.learning_rate)
        self.updates = 0

    def act(self, observations: Array) -> Array:
        """Actions without exploration."""
        with torch.no_grad():
            actions: Array = self.actor(torch.as_tensor(observations)).numpy()
        return actions

    def update(self, batch: list[Tensor]) -> float:
        """One update of the critics, every `policy_frequency`-th time also of the rest; returns the critics' loss."""
        args = self.args
        observations, actions, rewards, reached, terminations = batch
        with torch.no_grad():
            noise = (args.target_noise * torch.randn_like(actions)).clamp(-args.noise_clip, args.noise_clip)
            next_actions = (self.target_actor(reached) + noise).clamp(-1.0, 1.0)
            value = self._values(self.target_critics, reached, next_actions).amin(dim=0)
            # Only a real end is worth nothing afterwards; an episode that ran out of time goes on in truth.
            goal = rewards + args.gamma * (1.0 - terminations) * value
        values = self._values(self.critics, observations, actions)
        loss = 2.0 * mse_loss(values, goal.expand_as(values))
        self.critic_optimizer.zero_grad()
        torch.autograd.backward(loss)
        self.critic_optimizer.step()
        self.updates += 1
        if self.updates % args.policy_frequency == 0:
            actor_loss = -self._values(self.critics, observations, self.actor(observations))[0].mean()
            self.actor_optimizer.zero_grad()
            torch.autograd.backward(actor_loss)
            self.actor_optimizer.step()
            self._follow(self.actor, self.target_actor)
            self._follow(self.critics, self.target_critics)
        return float(loss)

    @staticmethod
    def _values(critics: nn.ModuleList, observations: Tensor, actions: Tensor) -> Tensor:
        """Shape (2, B)."""
        inputs = torch.cat((observations, actions), dim=-1)
        return torch.stack([critic(inputs).squeeze(-1) for critic in critics])

    def _follow(self, source: nn.Module, target: nn.Module) -> None:
        with torch.no_grad():
            for ours, theirs in zip(source.parameters(), target.parameters(), strict=True):
                theirs.lerp_(ours, self.args.tau)


def train(args: Args, envs: VectorEnv) -> Learner:
    """Steps the environments and learns; prints one line per tenth of the run."""
    mode = envs.metadata["autoreset_mode"]
    random = np.random.default_rng(args.seed)
    torch.manual_seed(args.seed)
    observations, _ = envs.reset(seed=args.seed)
    observation_dim, action_dim = observations.shape[1], envs.action_space.sample().shape[1]
    learner = Learner(args, observation_dim, action_dim)
    replay = Replay(args.buffer_size, observation_dim, action_dim)
    done = np.zeros(args.num_envs, dtype=np.bool_)
    step, episodes, owed, report = 0, 0, 0.0, args.total_timesteps // 10
    start = time.perf_counter()
    while step < args.total_timesteps:
        if step < args.learning_starts:
            actions = random.uniform(-1.0, 1.0, (args.num_envs, action_dim)).astype(np.float32)
        else:
            noise = random.standard_normal((args.num_envs, action_dim), np.float32)
            actions = (learner.act(observations) + args.exploration_noise * noise).clip(-1.0, 1.0)
        following, rewards, terminations, truncations, infos = envs.step(actions)
        real, reached = learnable_steps(following, infos, done, mode)
        rows = (observations, actions, rewards, reached, terminations)
        replay.add(*(values[real] for values in rows))
        done = terminations | truncations
        observations = following
        step += int(real.sum())
        episodes += int(done.sum())
        if step >= args.learning_starts and replay.count >= args.batch_size:
            owed += args.updates_per_step * int(real.sum())
            while owed >= 1.0:
                owed -= 1.0
                learner.update(replay.sample(args.batch_size))
        if report and step >= report:
            report += max(args.total_timesteps // 10, 1)
            rate = step / (time.perf_counter() - start)
            print(
                f"step {step}, {episodes} episodes, {learner.updates} updates, {rate:.0f} steps/s", flush=True
            )
    return learner


def evaluate(args: Args, learner: Learner) -> tuple[float, float]:
    """Success rate and mean steps without exploration; episode i starts from the seed 1000 + i."""
    env = make_task(args.env_id, args.gamma)
    successes, steps = 0, 0
    for episode in range(args.eval_episodes):
        observation, info = env.reset(seed=1000 + episode)
        done = False
        while not done:
            observation, _, terminated, truncated, info = env.step(learner.act(observation[None])[0])
            steps += 1
            done = terminated or truncated
        successes += bool(info["success"])
    env.close()
    return successes / args.eval_episodes, steps / args.eval_episodes


def main(args: Args) -> None:
    """Trains, evaluates, prints."""
    torch.set_num_threads(1)  # These networks are too small to gain from more.
    envs = make_envs(args)
    try:
        learner = train(args, envs)
    finally:
        envs.close()
    success, steps = evaluate(args, learner)
    print(f"success {success:.0%} of {args.eval_episodes} episodes, {steps:.1f} steps on average")


if __name__ == "__main__":
    main(tyro.cli(Args))
