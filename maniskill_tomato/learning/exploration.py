"""Exploration: the thesis's two schemes and autoregressive noise, each with its own sample for every
environment."""

from collections.abc import Sequence
from typing import Protocol

import torch
from torch import Tensor

from maniskill_tomato.learning.presets import EPSILON_GREEDY_HIGH, EPSILON_GREEDY_LOW, TrainConfig


class Exploration(Protocol):
    """Turns what the policy would do into what is tried."""

    def explore(self, policy_actions: Tensor, step: int, episode_starts: Tensor) -> Tensor:
        """The actions to take.

        Args:
            policy_actions: In units of the action scale. Shape (N, action_dim).
            step: Environment steps taken before this one.
            episode_starts: True where this is the first step of an episode. Shape (N,).

        Returns:
            Within [-1, 1], in units of the action scale. Shape (N, action_dim).
        """
        ...

    def amount(self, step: int) -> float:
        """The schedule's value at `step`, for the logs."""
        ...


def epsilon_greedy_schedule(step: int, exploration_steps: int) -> float:
    """Probability of following the policy (Eq. 5-5): 0.3, and 0.3 / EXP more with every step, at most 1."""
    return min(0.3 + 0.3 * step / exploration_steps, 1.0)


def decaying_schedule(step: int, exploration_steps: int) -> float:
    """Factor on the noise (Eq. 5-11): 1, and 1 / EXP less with every step, at least 0."""
    return max(1.0 - step / exploration_steps, 0.0)


class EpsilonGreedy:
    """With probability 1 - epsilon a uniformly random action from Eq. 5-6 instead of the policy's (guided
    task)."""

    def __init__(
        self,
        exploration_steps: int,
        action_scale: Sequence[float],
        generator: torch.Generator | None = None,
        device: torch.device | str = "cpu",
        low: Sequence[float] = EPSILON_GREEDY_LOW,
        high: Sequence[float] = EPSILON_GREEDY_HIGH,
    ) -> None:
        scale = torch.tensor(action_scale, device=device)
        self._low = torch.tensor(low, device=device) / scale
        self._range = torch.tensor(high, device=device) / scale - self._low
        self._exploration_steps = exploration_steps
        self._generator = generator

    def amount(self, step: int) -> float:
        return epsilon_greedy_schedule(step, self._exploration_steps)

    def explore(self, policy_actions: Tensor, step: int, episode_starts: Tensor) -> Tensor:
        count, device = len(policy_actions), policy_actions.device
        explores = torch.rand(count, 1, generator=self._generator, device=device) < 1.0 - self.amount(step)
        uniform = torch.rand(policy_actions.shape, generator=self._generator, device=device)
        random_actions = self._low + uniform * self._range
        return torch.where(explores, random_actions, policy_actions).clamp_(-1.0, 1.0)


class DecayingGaussian:
    """The policy's action plus max(epsilon, 0) N(0, 0.1), where 0.1 is read as the standard deviation (sparse
    task)."""

    def __init__(
        self, exploration_steps: int, noise: float, generator: torch.Generator | None = None
    ) -> None:
        self._exploration_steps = exploration_steps
        self._noise = noise
        self._generator = generator

    def amount(self, step: int) -> float:
        return decaying_schedule(step, self._exploration_steps)

    def explore(self, policy_actions: Tensor, step: int, episode_starts: Tensor) -> Tensor:
        noise = torch.randn(policy_actions.shape, generator=self._generator, device=policy_actions.device)
        return (policy_actions + self.amount(step) * self._noise * noise).clamp_(-1.0, 1.0)


class Autoregressive:
    """Noise that remembers: n' = rho n + sqrt(1 - rho^2) sigma N(0, 1), fresh at every episode.

    Sigma falls linearly over the schedule. During the first `warmup_steps` the policy is not asked: each
    episode keeps one random direction and the noise is added to it.
    """

    def __init__(
        self,
        exploration_steps: int,
        noise: float,
        noise_end: float,
        correlation: float,
        warmup_steps: int,
        generator: torch.Generator | None = None,
    ) -> None:
        self._exploration_steps = exploration_steps
        self._noise = noise
        self._noise_end = noise_end
        self._correlation = correlation
        self._warmup_steps = warmup_steps
        self._generator = generator
        self._state: Tensor | None = None
        self._direction: Tensor | None = None

    def amount(self, step: int) -> float:
        remaining = decaying_schedule(step, self._exploration_steps)
        return self._noise_end + remaining * (self._noise - self._noise_end)

    def explore(self, policy_actions: Tensor, step: int, episode_starts: Tensor) -> Tensor:
        shape, device = policy_actions.shape, policy_actions.device
        fresh = torch.randn(shape, generator=self._generator, device=device)
        if self._state is None or self._state.shape != shape:
            self._state = fresh
        else:
            rho = self._correlation
            kept = rho * self._state + (1.0 - rho * rho) ** 0.5 * fresh
            self._state = torch.where(episode_starts[:, None], fresh, kept)
        base = self._warmup(policy_actions, episode_starts) if step < self._warmup_steps else policy_actions
        return (base + self.amount(step) * self._state).clamp_(-1.0, 1.0)

    def _warmup(self, policy_actions: Tensor, episode_starts: Tensor) -> Tensor:
        """One direction per episode, uniform within [-1, 1] on every axis."""
        fresh = (
            2.0 * torch.rand(policy_actions.shape, generator=self._generator, device=policy_actions.device)
            - 1.0
        )
        if self._direction is None or self._direction.shape != policy_actions.shape:
            self._direction = fresh
        else:
            self._direction = torch.where(episode_starts[:, None], fresh, self._direction)
        return self._direction


def make_exploration(
    config: TrainConfig, generator: torch.Generator | None = None, device: torch.device | str = "cpu"
) -> Exploration:
    """The exploration that the configuration names."""
    if config.exploration == "epsilon-greedy":
        return EpsilonGreedy(config.exploration_steps, config.action_scale, generator, device)
    if config.exploration == "decaying-gaussian":
        return DecayingGaussian(config.exploration_steps, config.exploration_noise, generator)
    return Autoregressive(
        config.exploration_steps,
        config.exploration_noise,
        config.exploration_noise_end,
        config.exploration_correlation,
        config.learning_starts,
        generator,
    )
