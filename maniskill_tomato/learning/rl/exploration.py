"""Exploration: the thesis's two schemes, look-at goals and correlated noise, sampled for every environment."""

from collections.abc import Sequence
from typing import Protocol

import torch
from torch import Tensor

from maniskill_tomato.learning.rl.presets import TrainConfig
from maniskill_tomato.policies.layout import EPSILON_GREEDY_HIGH, EPSILON_GREEDY_LOW
from maniskill_tomato.robot.iiwa14 import BASE_TO_SHOULDER, WRIST_TO_EE

GOAL_DISTANCE = (0.25, 0.6)
"""Distances of look-at goals from the target, in [m]; nearer the D435 sees no depth."""

GOAL_DRAWS = 16

WRIST_REACH = (0.45, 0.8)
"""Distances of the wrist's centre from the shoulder that the arm reaches with a margin, in [m]; it can at
most reach 0.82."""

GOAL_TOLERANCE = 0.25
"""A goal is reached when every component is this near, in units of the action scale."""


class Exploration(Protocol):
    """Turns what the policy would do into what is tried."""

    def explore(
        self, policy_actions: Tensor, observations: Tensor, step: int, episode_starts: Tensor
    ) -> Tensor:
        """The actions to take.

        Args:
            policy_actions: In units of the action scale. Shape (N, action_dim).
            observations: What the policy saw, in the environment's units. Shape (N, observation_dim).
            step: Environment steps taken before this one.
            episode_starts: True where this is the first step of an episode. Shape (N,).

        Returns:
            Within [-1, 1], in units of the action scale. Shape (N, action_dim).
        """
        ...

    def amount(self, step: int) -> float:
        """The schedule's value at `step`, or the mean noise level of the environments, for the logs."""
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

    def explore(
        self, policy_actions: Tensor, observations: Tensor, step: int, episode_starts: Tensor
    ) -> Tensor:
        count, device = len(policy_actions), policy_actions.device
        explores = torch.rand(count, 1, generator=self._generator, device=device) < 1.0 - self.amount(step)
        uniform = torch.rand(policy_actions.shape, generator=self._generator, device=device)
        random_actions = self._low + uniform * self._range
        return torch.where(explores, random_actions, policy_actions).clamp_(-1.0, 1.0)


def draw_noise_levels(
    levels: Tensor | None,
    episode_starts: Tensor,
    low: float,
    high: float,
    generator: torch.Generator | None = None,
) -> Tensor:
    """Noise levels of every environment, drawn anew where an episode starts, uniformly between `low` and `high`.

    Some environments then explore boldly and others refine, at any time of the training (FastTD3, Seo et al., 2025).

    Args:
        levels: Those so far, or None. Shape (N, 1).
        episode_starts: True where an episode starts. Shape (N,).
        low: Smallest level.
        high: Largest level.
        generator: Source of the draws.

    Returns:
        Shape (N, 1).
    """
    uniform = torch.rand(len(episode_starts), 1, generator=generator, device=episode_starts.device)
    drawn = low + (high - low) * uniform
    if levels is None or len(levels) != len(drawn):
        return drawn
    return torch.where(episode_starts[:, None], drawn, levels)


class _Noise:
    """Gaussian noise on actions; its level falls linearly from `noise` to `noise_end`, or is each environment's own."""

    def __init__(
        self,
        exploration_steps: int,
        noise: float,
        noise_end: float,
        generator: torch.Generator | None,
        noise_per_env: bool,
    ) -> None:
        self._exploration_steps = exploration_steps
        self._noise = noise
        self._noise_end = noise_end
        self._noise_per_env = noise_per_env
        self._generator = generator
        self._levels: Tensor | None = None

    def amount(self, step: int) -> float:
        if self._noise_per_env:
            return 0.5 * (self._noise + self._noise_end)
        remaining = decaying_schedule(step, self._exploration_steps)
        return self._noise_end + remaining * (self._noise - self._noise_end)

    def _level(self, step: int, episode_starts: Tensor) -> float | Tensor:
        """Standard deviation of the noise at a step, or those of the environments, of shape (N, 1)."""
        if not self._noise_per_env:
            return self.amount(step)
        self._levels = draw_noise_levels(
            self._levels, episode_starts, self._noise_end, self._noise, self._generator
        )
        return self._levels

    def _draw(self, actions: Tensor) -> Tensor:
        return torch.randn(actions.shape, generator=self._generator, device=actions.device)


class DecayingGaussian(_Noise):
    """The policy's action plus max(epsilon, 0) N(0, 0.1), where 0.1 is read as the standard deviation (sparse
    task); or with noise of each environment's own level."""

    def __init__(
        self,
        exploration_steps: int,
        noise: float,
        generator: torch.Generator | None = None,
        noise_end: float = 0.0,
        noise_per_env: bool = False,
    ) -> None:
        super().__init__(exploration_steps, noise, noise_end, generator, noise_per_env)

    def amount(self, step: int) -> float:
        """Epsilon, which the thesis plots, instead of the standard deviation."""
        return (
            super().amount(step) if self._noise_per_env else decaying_schedule(step, self._exploration_steps)
        )

    def explore(
        self, policy_actions: Tensor, observations: Tensor, step: int, episode_starts: Tensor
    ) -> Tensor:
        noise = self._draw(policy_actions)
        level = self._level(step, episode_starts) * (1.0 if self._noise_per_env else self._noise)
        return (policy_actions + level * noise).clamp_(-1.0, 1.0)


class CorrelatedNoise(_Noise):
    """The policy's action plus noise that remembers the step before, so that a wrong way is kept for some steps.

    The noise is a stationary autoregressive process, n' = c n + sqrt(1 - c^2) sigma e with e ~ N(0, 1), begun anew with
    every episode. It does what the Ornstein-Uhlenbeck noise of DDPG does (Lillicrap et al., 2016), with a spread that
    does not depend on c.
    """

    def __init__(
        self,
        exploration_steps: int,
        noise: float,
        noise_end: float,
        correlation: float,
        generator: torch.Generator | None = None,
        noise_per_env: bool = False,
    ) -> None:
        super().__init__(exploration_steps, noise, noise_end, generator, noise_per_env)
        self._correlation = correlation
        self._state: Tensor | None = None

    def explore(
        self, policy_actions: Tensor, observations: Tensor, step: int, episode_starts: Tensor
    ) -> Tensor:
        fresh = self._draw(policy_actions)
        if self._state is None or self._state.shape != fresh.shape:
            self._state = fresh
        else:
            c = self._correlation
            kept = c * self._state + (1.0 - c * c) ** 0.5 * fresh
            self._state = torch.where(episode_starts[:, None], fresh, kept)
        return (policy_actions + self._level(step, episode_starts) * self._state).clamp_(-1.0, 1.0)


class LookAtGoals(_Noise):
    """Some episodes walk between random viewpoints that look at the target; the others follow the policy with
    noise.

    A random walk in six dimensions soon looks away from the target and then learns nothing about views of it.
    So an episode is, with a probability that falls linearly from 1 to `goal_share`, led through goals:
    positions around the target on the robot's side, at the distances of `GOAL_DISTANCE`, with the tool axis
    towards the target. Only the observation is used for it. Gaussian noise, falling linearly from `noise` to
    `noise_end` or of each environment's own level between the two, is added to both kinds.
    """

    def __init__(
        self,
        exploration_steps: int,
        noise: float,
        noise_end: float,
        goal_share: float,
        action_scale: Sequence[float],
        warmup_steps: int,
        generator: torch.Generator | None = None,
        device: torch.device | str = "cpu",
        noise_per_env: bool = False,
    ) -> None:
        super().__init__(exploration_steps, noise, noise_end, generator, noise_per_env)
        self._goal_share = goal_share
        self._warmup_steps = warmup_steps
        self._scale = torch.tensor(action_scale, device=device)
        self._led: Tensor | None = None
        self._goals = torch.zeros(0, 6, device=device)

    def goal_share(self, step: int) -> float:
        """Probability that an episode which starts at `step` is led: 1 in the warm-up, then falling
        linearly."""
        if step < self._warmup_steps:
            return 1.0
        remaining = decaying_schedule(step, self._exploration_steps)
        return self._goal_share + remaining * (1.0 - self._goal_share)

    def explore(
        self, policy_actions: Tensor, observations: Tensor, step: int, episode_starts: Tensor
    ) -> Tensor:
        count, device = len(policy_actions), policy_actions.device
        drawn = torch.rand(count, generator=self._generator, device=device) < self.goal_share(step)
        goals = draw_look_at_goals(observations[:, 6:9], self._generator)
        if self._led is None or len(self._led) != count:
            self._led, self._goals = drawn, goals
        else:
            self._led = torch.where(episode_starts, drawn, self._led)
            arrived = (((self._goals - observations[:, :6]) / self._scale).abs() < GOAL_TOLERANCE).all(dim=-1)
            self._goals = torch.where((episode_starts | arrived)[:, None], goals, self._goals)
        towards = ((self._goals - observations[:, :6]) / self._scale).clamp_(-1.0, 1.0)
        base = torch.where(self._led[:, None], towards, policy_actions)
        noise = self._draw(base)
        return (base + self._level(step, episode_starts) * noise).clamp_(-1.0, 1.0)


def draw_look_at_goals(targets: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """Random viewpoints (x, y, z, roll 0, pitch, yaw) that look at `targets` from the robot's side.

    Directions are uniform on the half sphere with x < 0, distances uniform in `GOAL_DISTANCE`, redrawn up to
    `GOAL_DRAWS` times until the goal is outside the zone that the thesis forbids and the arm can probably
    reach it: the centre of its wrist lies between `WRIST_REACH` of its shoulder.

    Args:
        targets: Target positions in the world frame, in [m]. Shape (N, 3).
        generator: Source of the draws.

    Returns:
        In [m] and [rad], world frame. Shape (N, 6).
    """
    shape, device = (GOAL_DRAWS, *targets.shape), targets.device
    directions = torch.randn(shape, generator=generator, device=device)
    directions[..., 0] = -directions[..., 0].abs()
    directions = directions / directions.norm(dim=-1, keepdim=True).clamp(min=1e-6)
    near, far = GOAL_DISTANCE
    distances = near + (far - near) * torch.rand((*shape[:2], 1), generator=generator, device=device)
    positions = targets + distances * directions
    looks = -directions
    wrists = positions - WRIST_TO_EE * looks - torch.tensor((0.0, 0.0, BASE_TO_SHOULDER), device=device)
    reach = wrists.norm(dim=-1)
    allowed = (positions[..., 0] <= 0.7) & (positions[..., 2] >= 0.25)
    good = allowed & (reach > WRIST_REACH[0]) & (reach < WRIST_REACH[1])
    first = good.int().argmax(dim=0)
    rows = torch.arange(len(targets), device=device)
    position, look = positions[first, rows], looks[first, rows]
    # With roll 0 the tool's z axis is (sin pitch cos yaw, sin pitch sin yaw, cos pitch).
    pitch = torch.arccos(look[:, 2].clamp(-1.0, 1.0))
    yaw = torch.atan2(look[:, 1], look[:, 0])
    return torch.cat((position, torch.stack((torch.zeros_like(pitch), pitch, yaw), dim=-1)), dim=-1)


def make_exploration(
    config: TrainConfig, generator: torch.Generator | None = None, device: torch.device | str = "cpu"
) -> Exploration:
    """The exploration that the configuration names."""
    steps, per_env = config.exploration_steps, config.exploration_noise_per_env
    start, end = config.exploration_noise, config.exploration_noise_end
    if config.exploration == "epsilon-greedy":
        return EpsilonGreedy(steps, config.action_scale, generator, device)
    if config.exploration == "decaying-gaussian":
        return DecayingGaussian(steps, start, generator, end, per_env)
    if config.exploration == "correlated":
        return CorrelatedNoise(steps, start, end, config.exploration_correlation, generator, per_env)
    return LookAtGoals(
        steps,
        start,
        end,
        config.exploration_goal_share,
        config.action_scale,
        config.learning_starts,
        generator,
        device,
        per_env,
    )
