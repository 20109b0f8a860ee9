"""DDPG (thesis Algorithm 2) and TD3 as one agent and the functions that update it."""

import copy
from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from maniskill_tomato.learning.networks import Actor, Critic, ObservationNormalizer
from maniskill_tomato.learning.presets import OBSERVATION_CENTRE, OBSERVATION_HALF_RANGE, TrainConfig
from maniskill_tomato.learning.replay import Batch


@dataclass(frozen=True, kw_only=True)
class Agent:
    """Networks, their slowly following copies and their optimisers."""

    config: TrainConfig
    actor: Actor
    critics: nn.ModuleList
    """One `Critic`, or two with `twin_critics`."""
    target_actor: Actor
    target_critics: nn.ModuleList
    actor_optimizer: torch.optim.Optimizer
    critic_optimizer: torch.optim.Optimizer
    normalizer: ObservationNormalizer

    def policy(self, observations: Tensor) -> Tensor:
        """The policy's actions, in units of the action scale. Shape (B, action_dim)."""
        with torch.no_grad():
            actions: Tensor = self.actor(self.normalizer(observations))
        return actions


def make_normalizer(config: TrainConfig, observation_dim: int) -> ObservationNormalizer:
    """The normaliser that the configuration asks for."""
    if config.normalize_observations:
        return ObservationNormalizer(OBSERVATION_CENTRE, OBSERVATION_HALF_RANGE)
    return ObservationNormalizer.identity(observation_dim)


def make_actor(config: TrainConfig, observation_dim: int, action_dim: int) -> Actor:
    """A freshly initialised actor of the configured size."""
    return Actor(observation_dim, action_dim, config.actor_hidden, config.actor_output_init)


def make_agent(
    config: TrainConfig, observation_dim: int, action_dim: int, device: torch.device | str = "cpu"
) -> Agent:
    """A freshly initialised agent; the weights come from torch's global random state."""
    actor = make_actor(config, observation_dim, action_dim).to(device)
    critics = nn.ModuleList(
        Critic(observation_dim, action_dim, config.critic_hidden, config.critic_action_layer)
        for _ in range(2 if config.twin_critics else 1)
    ).to(device)
    return Agent(
        config=config,
        actor=actor,
        critics=critics,
        target_actor=copy.deepcopy(actor).requires_grad_(False),
        target_critics=copy.deepcopy(critics).requires_grad_(False),
        actor_optimizer=torch.optim.Adam(actor.parameters(), lr=config.actor_learning_rate, fused=True),
        critic_optimizer=torch.optim.Adam(critics.parameters(), lr=config.critic_learning_rate, fused=True),
        normalizer=make_normalizer(config, observation_dim).to(device),
    )


@torch.no_grad()
def td_targets(agent: Agent, batch: Batch, generator: torch.Generator | None = None) -> Tensor:
    """What the critics should say: y = r, plus gamma Q'(s', mu'(s')) unless the episode terminated.

    A time limit is no termination: those transitions bootstrap. With two critics Q' is the smaller one; with
    `target_noise` above zero the target action is smoothed by clipped Gaussian noise (TD3).

    Returns:
        Shape (B,).
    """
    config = agent.config
    next_observations = agent.normalizer(batch.next_observations)
    next_actions = agent.target_actor(next_observations)
    if config.target_noise > 0.0:
        noise = torch.randn(next_actions.shape, generator=generator, device=next_actions.device)
        noise = (noise * config.target_noise).clamp_(-config.target_noise_clip, config.target_noise_clip)
        next_actions = (next_actions + noise).clamp_(-1.0, 1.0)
    values = torch.stack([critic(next_observations, next_actions) for critic in agent.target_critics])
    return batch.rewards + config.gamma * (1.0 - batch.terminations) * values.amin(dim=0)


def update_critic(agent: Agent, batch: Batch, generator: torch.Generator | None = None) -> dict[str, Tensor]:
    """One Adam step on the critics' loss L = mean (y - Q(s, a))^2, summed over the critics.

    Returns:
        `qf_loss` (the sum), `qf1_loss`, `qf1_values` and, with two critics, `qf2_loss`, `qf2_values`:
        scalars.
    """
    targets = td_targets(agent, batch, generator)
    observations = agent.normalizer(batch.observations)
    total = torch.zeros((), device=targets.device)
    logs: dict[str, Tensor] = {}
    for index, critic in enumerate(agent.critics, start=1):
        values = critic(observations, batch.actions)
        loss = torch.nn.functional.mse_loss(values, targets)
        total = total + loss
        logs[f"qf{index}_loss"] = loss.detach()
        logs[f"qf{index}_values"] = values.detach().mean()
    _step(agent.critic_optimizer, total, list(agent.critics.parameters()))
    logs["qf_loss"] = total.detach()
    return logs


def update_actor(agent: Agent, observations: Tensor) -> dict[str, Tensor]:
    """One Adam step up the sampled policy gradient of Q(s, mu(s)); the critics stay as they are.

    Args:
        agent: The agent; its first critic judges.
        observations: Unnormalised observations. Shape (B, observation_dim).

    Returns:
        `actor_loss`: minus the mean value, plus the penalty on saturated outputs where one is configured. A
        scalar.
    """
    normalized = agent.normalizer(observations)
    pre_activation = agent.actor.pre_activation(normalized)
    loss = -agent.critics[0](normalized, torch.tanh(pre_activation)).mean()
    if agent.config.pre_tanh_penalty > 0.0:
        loss = loss + agent.config.pre_tanh_penalty * pre_activation.square().mean()
    _step(agent.actor_optimizer, loss, list(agent.actor.parameters()))
    return {"actor_loss": loss.detach()}


def update_targets(agent: Agent) -> None:
    """Moves the target networks by the fraction tau towards the trained ones."""
    polyak_update(agent.critics.parameters(), agent.target_critics.parameters(), agent.config.tau)
    polyak_update(agent.actor.parameters(), agent.target_actor.parameters(), agent.config.tau)


def update(
    agent: Agent, batch: Batch, index: int, generator: torch.Generator | None = None
) -> dict[str, Tensor]:
    """One update in the order of Algorithm 2: critic, actor, targets.

    Args:
        agent: The agent, changed in place.
        batch: Transitions from the replay buffer.
        index: How many updates came before; the actor and the targets move on every `policy_frequency`-th
            only.
        generator: Source of the target noise.

    Returns:
        The logs of `update_critic` and, where it ran, `update_actor`.
    """
    logs = update_critic(agent, batch, generator)
    if index % agent.config.policy_frequency == 0:
        logs |= update_actor(agent, batch.observations)
        update_targets(agent)
    return logs


@torch.no_grad()
def polyak_update(source: Iterable[Tensor], target: Iterable[Tensor], tau: float) -> None:
    """target <- tau * source + (1 - tau) * target, in place."""
    for s, t in zip(source, target, strict=True):
        t.lerp_(s, tau)


def _step(optimizer: torch.optim.Optimizer, loss: Tensor, parameters: list[nn.Parameter]) -> None:
    """One optimiser step on `loss`; gradients of other parameters in the graph are neither computed nor
    kept."""
    for parameter, gradient in zip(parameters, torch.autograd.grad(loss, parameters), strict=True):
        parameter.grad = gradient
    optimizer.step()
