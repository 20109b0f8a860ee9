"""DDPG (thesis Algorithm 2) and TD3 as one agent and the functions that update it."""

import copy
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from maniskill_tomato.errors import CheckpointError
from maniskill_tomato.learning.rl.auxiliary import AuxiliaryHeads
from maniskill_tomato.learning.rl.critic import CategoricalCritic, Critic, project
from maniskill_tomato.learning.rl.presets import OBSERVATION_CENTRE, OBSERVATION_HALF_RANGE, TrainConfig
from maniskill_tomato.learning.rl.random_shift import shifted
from maniskill_tomato.learning.rl.replay import Batch
from maniskill_tomato.policies.actor import Actor, ObservationNormalizer
from maniskill_tomato.policies.image_encoder import ImageEncoder
from maniskill_tomato.policies.trained_actor import TrainedActor
from maniskill_tomato.sensing.image_layout import ImageLayout
from maniskill_tomato.sensing.image_observation import PRIVILEGED, Observation, images_of, state_of

SMALLEST_SPREAD = 0.05
"""Observed values whose standard deviation is below this, in [m] or [rad], are scaled by this instead: what never
varied in training, such as the place of a plant that stood still, would otherwise be blown up as soon as it does."""


class RunningStatistics(nn.Module):
    """Mean and variance of everything seen so far, kept in float64 (Chan et al., 1983)."""

    count: Tensor
    mean: Tensor
    squares: Tensor

    def __init__(self, observation_dim: int) -> None:
        """Starts without a sample."""
        super().__init__()
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))
        self.register_buffer("mean", torch.zeros(observation_dim, dtype=torch.float64))
        self.register_buffer("squares", torch.zeros(observation_dim, dtype=torch.float64))

    @torch.no_grad()
    def update(self, observations: Tensor, normalizer: ObservationNormalizer) -> None:
        """Counts observations in and sets the normaliser to the mean and standard deviation of all so far.

        Args:
            observations: Shape (B, observation_dim).
            normalizer: Changed in place.
        """
        new = observations.double()
        total = self.count + len(new)
        difference = new.mean(dim=0) - self.mean
        self.squares += (new - new.mean(dim=0)).square().sum(dim=0)
        self.squares += difference.square() * self.count * len(new) / total
        self.mean += difference * len(new) / total
        self.count.copy_(total)
        normalizer.centre.copy_(self.mean)
        normalizer.half_range.copy_((self.squares / total).sqrt().clamp(min=SMALLEST_SPREAD))


@dataclass(frozen=True, kw_only=True)
class Agent:
    """Networks, their slowly following copies and their optimisers."""

    config: TrainConfig
    actor: Actor
    critics: nn.ModuleList
    """One `Critic`, or two with `twin_critics`; each a `CategoricalCritic` where it is configured."""
    target_actor: Actor
    target_critics: nn.ModuleList
    actor_optimizer: torch.optim.Optimizer
    critic_optimizer: torch.optim.Optimizer
    normalizer: ObservationNormalizer
    statistics: RunningStatistics
    """What a running normaliser follows; unused otherwise."""
    heads: AuxiliaryHeads
    """Empty unless auxiliary losses have a weight."""
    encoder: ImageEncoder | None = None
    """The eye that actor and critics share; None where no images are observed.

    The critics' loss trains it, and the actor takes its features as they are (DrQ-v2); with `asymmetric_critic` the
    critics see no images, and the actor's gradient trains it."""

    @property
    def actor_trains_encoder(self) -> bool:
        """Whether the encoder learns from the actor's gradient."""
        return self.encoder is not None and self.config.asymmetric_critic

    def observe(self, observations: Observation) -> None:
        """Lets a running normaliser follow what the environments show. Shape (B, observation_dim)."""
        if self.config.normalize_observations == "running":
            self.statistics.update(state_of(observations), self.normalizer)

    def policy(self, observations: Observation) -> Tensor:
        """The policy's actions, in units of the action scale. Shape (B, action_dim)."""
        with torch.no_grad():
            actions: Tensor = self.actor(self.actor_input(observations))
        return actions

    def actor_input(self, observations: Observation) -> Tensor:
        """What the actor sees: the state, normalised, and features of the images. Shape (B, D)."""
        state: Tensor = self.normalizer(state_of(observations))
        if self.encoder is None:
            return state
        return torch.cat((state, self.encoder(images_of(observations))), dim=-1)

    def critic_input(self, observations: Observation) -> Tensor:
        """What the critics see: the same, or with `asymmetric_critic` the task's whole state. Shape (B, D)."""
        if not self.config.asymmetric_critic:
            return self.actor_input(observations)
        assert not isinstance(observations, Tensor)
        return torch.cat((self.normalizer(state_of(observations)), observations[PRIVILEGED]), dim=-1)


def make_normalizer(config: TrainConfig, observation_dim: int) -> ObservationNormalizer:
    """The normaliser that the configuration asks for; a running one starts as the identity."""
    if config.normalize_observations == "fixed":
        return ObservationNormalizer(OBSERVATION_CENTRE, OBSERVATION_HALF_RANGE)
    return ObservationNormalizer.identity(observation_dim)


def make_actor(config: TrainConfig, observation_dim: int, action_dim: int) -> Actor:
    """A freshly initialised actor of the configured size."""
    return Actor(observation_dim, action_dim, config.actor_hidden, config.actor_output_init)


def make_critic(config: TrainConfig, observation_dim: int, action_dim: int) -> Critic:
    """A freshly initialised critic of the configured size and kind."""
    dims = (observation_dim, action_dim, config.critic_hidden, config.critic_action_layer)
    if config.critic == "categorical":
        return CategoricalCritic(*dims, config.value_atoms, config.value_range)
    return Critic(*dims)


def make_encoder(config: TrainConfig) -> ImageEncoder | None:
    """A freshly initialised encoder of the configured images; None without images."""
    images = ImageLayout.parse(config.obs_mode, config.image_size)
    return None if images is None else ImageEncoder(images, config.frame_stack, config.image_features)


def make_agent(
    config: TrainConfig,
    observation_dim: int,
    action_dim: int,
    device: torch.device | str = "cpu",
    *,
    privileged_dim: int = 0,
) -> Agent:
    """A freshly initialised agent; the weights come from torch's global random state.

    Args:
        config: How it learns.
        observation_dim: Number of observed values, those of images left out.
        action_dim: Number of actions.
        device: Where the networks are.
        privileged_dim: Number of values that only critics see, with `asymmetric_critic`.
    """
    encoder = make_encoder(config)
    features = 0 if encoder is None else encoder.features
    beside = privileged_dim if config.asymmetric_critic else features
    actor = make_actor(config, observation_dim + features, action_dim).to(device)
    critics = nn.ModuleList(
        make_critic(config, observation_dim + beside, action_dim)
        for _ in range(2 if config.twin_critics else 1)
    ).to(device)
    heads = AuxiliaryHeads(config, observation_dim).to(device)
    actor_parameters, critic_parameters = (
        _trained(actor, heads.distance),
        _trained(critics, heads.visible_fraction),
    )
    if encoder is not None:
        encoder = encoder.to(device)
        (actor_parameters if config.asymmetric_critic else critic_parameters).extend(encoder.parameters())
    return Agent(
        encoder=encoder,
        config=config,
        actor=actor,
        critics=critics,
        target_actor=copy.deepcopy(actor).requires_grad_(False),
        target_critics=copy.deepcopy(critics).requires_grad_(False),
        actor_optimizer=torch.optim.Adam(actor_parameters, lr=config.actor_learning_rate, fused=True),
        critic_optimizer=torch.optim.Adam(critic_parameters, lr=config.critic_learning_rate, fused=True),
        normalizer=make_normalizer(config, observation_dim).to(device),
        statistics=RunningStatistics(observation_dim).to(device),
        heads=heads,
    )


def check_fits(policy: TrainedActor, config: TrainConfig, observation_dim: int) -> None:
    """Refuses a policy that the configured actor cannot take over.

    Raises:
        CheckpointError: Its observations, its layers, its normaliser or its action scale are other ones.
        InvalidInputError: It was trained with options that this version does not know.
    """
    given_config = TrainConfig.from_dict(policy.config)
    for name, given, wanted in (
        ("observation length", policy.observation_dim, observation_dim),
        ("obs_mode", given_config.obs_mode, config.obs_mode),
        ("image_size", tuple(given_config.image_size), tuple(config.image_size)),
        ("frame_stack", given_config.frame_stack, config.frame_stack),
        ("image_features", given_config.image_features, config.image_features),
        ("actor_hidden", tuple(given_config.actor_hidden), tuple(config.actor_hidden)),
        ("normalize_observations", given_config.normalize_observations, config.normalize_observations),
        ("action_scale", tuple(given_config.action_scale), tuple(config.action_scale)),
    ):
        if given != wanted:
            raise CheckpointError(
                f"initial_policy has {name} {given}, but the run is configured for {wanted}; give the same"
            )


def begin_with(agent: Agent, policy: TrainedActor) -> None:
    """Gives the agent's actor, target actor and normaliser the weights of a policy that fits."""
    agent.actor.load_state_dict(policy.actor.state_dict())
    agent.target_actor.load_state_dict(policy.actor.state_dict())
    agent.normalizer.load_state_dict(policy.normalizer.state_dict())
    if agent.encoder is not None and policy.encoder is not None:
        agent.encoder.load_state_dict(policy.encoder.state_dict())


@torch.no_grad()
def td_targets(agent: Agent, batch: Batch, generator: torch.Generator | None = None) -> Tensor:
    """What the critics should say: y = r, plus gamma Q'(s', mu'(s')) unless the episode terminated.

    A time limit is no termination: those transitions bootstrap. With two critics Q' is the smaller one; with
    `target_noise` above zero the target action is smoothed by clipped Gaussian noise (TD3).

    Returns:
        Shape (B,).
    """
    next_observations, next_actions = _target_actions(agent, batch, generator)
    values = torch.stack([critic(next_observations, next_actions) for critic in agent.target_critics])
    return batch.rewards + _discounts(agent, batch) * values.amin(dim=0)


@torch.no_grad()
def distribution_targets(agent: Agent, batch: Batch, generator: torch.Generator | None = None) -> Tensor:
    """The same for categorical critics: the distribution of r + gamma Z'(s', mu'(s')) over their atoms.

    With two critics Z' is the one with the smaller mean, row by row (FastTD3).

    Returns:
        Rows that add up to 1. Shape (B, atoms).
    """
    next_observations, next_actions = _target_actions(agent, batch, generator)
    chosen, smallest, atoms = None, None, None
    for critic in agent.target_critics:
        assert isinstance(critic, CategoricalCritic)
        probabilities = critic.logits(next_observations, next_actions).softmax(dim=-1)
        means, atoms = critic.mean(probabilities), critic.atoms
        if chosen is None or smallest is None:
            chosen, smallest = probabilities, means
        else:
            chosen = torch.where((means < smallest)[:, None], probabilities, chosen)
    assert chosen is not None and atoms is not None
    return project(chosen, atoms, batch.rewards, _discounts(agent, batch))


def _target_actions(agent: Agent, batch: Batch, generator: torch.Generator | None) -> tuple[Tensor, Tensor]:
    """s' as the critics see it, and what the target actor does there, smoothed where configured."""
    config = agent.config
    seen = agent.actor_input(batch.next_observations)
    next_observations = agent.critic_input(batch.next_observations) if config.asymmetric_critic else seen
    next_actions = agent.target_actor(seen)
    if config.target_noise > 0.0:
        noise = torch.randn(next_actions.shape, generator=generator, device=next_actions.device)
        noise = (noise * config.target_noise).clamp_(-config.target_noise_clip, config.target_noise_clip)
        next_actions = (next_actions + noise).clamp_(-1.0, 1.0)
    return next_observations, next_actions


def _discounts(agent: Agent, batch: Batch) -> Tensor:
    """What the value after a transition counts: gamma, and 0 after a termination. Shape (B,)."""
    return agent.config.gamma * (1.0 - batch.terminations)


def update_critic(agent: Agent, batch: Batch, generator: torch.Generator | None = None) -> dict[str, Tensor]:
    """One Adam step on the critics' loss, summed over the critics.

    It is L = mean (y - Q(s, a))^2 or, for categorical critics, the mean cross-entropy with the target distribution;
    plus, where it has a weight, the error of the predicted V_f.

    Returns:
        `qf_loss` (the sum), `qf1_loss`, `qf1_values` and, with two critics, `qf2_loss`, `qf2_values`;
        `aux_visibility_loss`, a sum too, where it has a weight: scalars.
    """
    categorical = agent.config.critic == "categorical"
    targets = (distribution_targets if categorical else td_targets)(agent, batch, generator)
    observations = agent.critic_input(batch.observations)
    total = torch.zeros((), device=targets.device)
    auxiliary = torch.zeros((), device=targets.device)
    logs: dict[str, Tensor] = {}
    for index, critic in enumerate(agent.critics):
        assert isinstance(critic, Critic)
        features = critic.features(observations, batch.actions)
        output: Tensor = critic.output(features)
        if isinstance(critic, CategoricalCritic):
            logarithms = output.log_softmax(dim=-1)
            loss = -(targets * logarithms).sum(dim=-1).mean()
            values = critic.mean(logarithms.detach().exp())
        else:
            values = output.squeeze(-1)
            loss = torch.nn.functional.mse_loss(values, targets)
        total = total + loss
        logs[f"qf{index + 1}_loss"] = loss.detach()
        logs[f"qf{index + 1}_values"] = values.detach().mean()
        if agent.heads.visible_fraction is not None:
            auxiliary = auxiliary + agent.heads.visibility_loss(index, features, batch)
    logs["qf_loss"] = total.detach()
    if agent.heads.visible_fraction is not None:
        logs["aux_visibility_loss"] = auxiliary.detach()
        total = total + agent.config.aux_visibility_weight * auxiliary
    learns = _trained(agent.critics, agent.heads.visible_fraction)
    if agent.encoder is not None and not agent.actor_trains_encoder:
        learns += agent.encoder.parameters()
    _step(agent.critic_optimizer, total, learns)
    return logs


def update_actor(agent: Agent, observations: Observation) -> dict[str, Tensor]:
    """One Adam step up the sampled policy gradient of Q(s, mu(s)); the critics stay as they are.

    Args:
        agent: The agent; its first critic judges.
        observations: Not normalised. Shape (B, observation_dim), or with images.

    Returns:
        `actor_loss`: minus the mean value, plus the penalty on saturated outputs where one is configured;
        `aux_distance_loss` where it has a weight. Scalars.
    """
    with torch.set_grad_enabled(agent.actor_trains_encoder):
        seen = agent.actor_input(observations)
    judged = agent.critic_input(observations) if agent.config.asymmetric_critic else seen
    features = agent.actor.features(seen)
    pre_activation = agent.actor.output(features)
    loss = -agent.critics[0](judged, torch.tanh(pre_activation)).mean()
    if agent.config.pre_tanh_penalty > 0.0:
        loss = loss + agent.config.pre_tanh_penalty * pre_activation.square().mean()
    logs = {"actor_loss": loss.detach()}
    if agent.heads.distance is not None:
        distance_loss = agent.heads.distance_loss(features, state_of(observations))
        logs["aux_distance_loss"] = distance_loss.detach()
        loss = loss + agent.config.aux_distance_weight * distance_loss
    learns = _trained(agent.actor, agent.heads.distance)
    if agent.encoder is not None and agent.actor_trains_encoder:
        learns += agent.encoder.parameters()
    _step(agent.actor_optimizer, loss, learns)
    return logs


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
            only, the actor after `actor_starts` of them.
        generator: Source of the target noise.

    Returns:
        The logs of `update_critic` and, where it ran, `update_actor`.
    """
    batch = _augmented(agent.config, batch, generator)
    logs = update_critic(agent, batch, generator)
    if index >= agent.config.actor_starts and index % agent.config.policy_frequency == 0:
        logs |= update_actor(agent, batch.observations)
    if index % agent.config.policy_frequency == 0:
        update_targets(agent)
    return logs


def _augmented(config: TrainConfig, batch: Batch, generator: torch.Generator | None) -> Batch:
    """The batch with randomly shifted images, those before and after a step apart."""
    changed: dict[str, Any] = {}
    for name in ("observations", "next_observations"):
        observations: Observation = getattr(batch, name)
        if not isinstance(observations, Tensor):
            moved = shifted(images_of(observations), config.image_shift, generator)
            changed[name] = {**observations, **moved}
    return batch._replace(**changed)


@torch.no_grad()
def polyak_update(source: Iterable[Tensor], target: Iterable[Tensor], tau: float) -> None:
    """target <- tau * source + (1 - tau) * target, in place."""
    for s, t in zip(source, target, strict=True):
        t.lerp_(s, tau)


def _trained(network: nn.Module, head: nn.Module | None) -> list[nn.Parameter]:
    """The parameters of a network and of a head on it."""
    return [*network.parameters(), *(() if head is None else head.parameters())]


def _step(optimizer: torch.optim.Optimizer, loss: Tensor, parameters: list[nn.Parameter]) -> None:
    """One optimiser step on `loss`; gradients of other parameters in the graph are neither computed nor
    kept."""
    for parameter, gradient in zip(parameters, torch.autograd.grad(loss, parameters), strict=True):
        parameter.grad = gradient
    optimizer.step()
