"""The reward that is learned from demonstrations: how much a view looks like a demonstrated one.

A discriminator D tells demonstrated views from those of the learner, and is trained beside it (GAIL, Ho & Ermon, 2016;
off-policy as Discriminator-Actor-Critic, Kostrikov et al., 2019). The reward of a view is log D - log(1 - D), the
discriminator's logit (AIRL, Fu et al., 2018), of the present discriminator, whenever a transition is drawn.

Each batch of the learner holds demonstrated moves beside its own (`DemonstratedTransitions`), as in DDPG from
Demonstrations (Vecerik et al., 2017), with rewards of the same discriminator. Without them the critics know nothing of
views that the learner does not reach by itself, however much these are worth.

Where an episode ends for good, the view is taken to stay for ever. This goes for demonstrations and learner, reward and
discriminator alike, so that neither ending early nor going on earns anything by itself: a reward that is the same for
all views makes all policies equal.
"""

from typing import Any, Protocol

import torch
from torch import Tensor, nn
from torch.nn import functional

from maniskill_tomato.errors import CheckpointError, InvalidInputError
from maniskill_tomato.learning.imitation.trajectory_file import DemonstratedMoves
from maniskill_tomato.learning.rl.replay import Batch
from maniskill_tomato.learning.rl.train_config import TrainConfig
from maniskill_tomato.policies.actor import ObservationNormalizer

GRADIENT_PENALTY = 10.0
"""Weight of the gradient penalty (Gulrajani et al., 2017), as in Discriminator-Actor-Critic."""


DEMONSTRATED_SHARE = 0.25
"""Demonstrated moves in a batch over the learner's own; they are drawn beside the batch that is configured."""


class RewardModel(Protocol):
    """What judges transitions in place of the task."""

    def to(self, device: torch.device) -> None:
        """Moves to where the transitions are."""

    def update(
        self, batch: Batch, normalizer: ObservationNormalizer, generator: torch.Generator | None
    ) -> dict[str, Tensor]:
        """Learns from transitions of the learner; returns scalars to log."""
        ...

    def judge(self, batch: Batch, normalizer: ObservationNormalizer) -> Batch:
        """The transitions with the present rewards in place of theirs."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """Everything that changes, for `load_state_dict`."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Takes back what `state_dict` gave."""
        ...


def stays(terminations: Tensor, gamma: float) -> Tensor:
    """How much a view counts: 1 where the episode goes on, 1 + gamma + gamma^2 + ... where it ended for good.

    Args:
        terminations: 1.0 where it ended. Shape (B,).
        gamma: Discount factor.
    """
    return 1.0 + terminations * gamma / (1.0 - gamma)


def gradient_penalty(network: nn.Module, some: Tensor, others: Tensor, mix: Tensor) -> Tensor:
    """Mean squared distance to 1 of the norm of the network's gradient between pairs of inputs (WGAN-GP); a scalar.

    Args:
        network: Inputs (B, D) to (B, 1).
        some: Shape (B, D).
        others: Shape (B, D).
        mix: How far from `others` to `some` the gradient is taken, in [0, 1]. Shape (B, 1).
    """
    between = torch.lerp(others, some, mix).detach().requires_grad_()
    (gradient,) = torch.autograd.grad(network(between).sum(), between, create_graph=True)
    penalty: Tensor = (gradient.norm(dim=-1) - 1.0).square().mean()
    return penalty


class DemonstratedTransitions:
    """Demonstrated moves as a learner's transitions, whose rewards a `RewardModel` is to say."""

    def __init__(self, demonstrations: DemonstratedMoves, config: TrainConfig) -> None:
        """Takes over the moves.

        Args:
            demonstrations: What is shown.
            config: Of the learner.
        """
        count = len(demonstrations.actions)
        scale = torch.tensor(config.action_scale)
        fits = demonstrations.actions.shape[1] == len(scale)
        self._transitions = Batch(
            demonstrations.observations,
            (demonstrations.actions / scale).clamp(-1.0, 1.0) if fits else demonstrations.actions,
            torch.zeros(count),
            demonstrations.views,
            demonstrations.terminations,
        )

    def check_fits(self, observation_dim: int, action_dim: int) -> None:
        """Accepts the observations and actions of an environment.

        Raises:
            InvalidInputError: Those of the demonstrations have another length.
        """
        shown = self._transitions
        for name, values, wanted in (
            ("observations", shown.observations, observation_dim),
            ("actions", shown.actions, action_dim),
        ):
            if values.shape[1] != wanted:
                raise InvalidInputError(
                    f"the demonstrations have {name} of {values.shape[1]} values, and the task has {wanted}; record "
                    "them with the options of the training"
                )

    def to(self, device: torch.device) -> None:
        """Moves to where the learner's transitions are."""
        self._transitions = Batch(*(part.to(device) for part in self._transitions[:5]))

    def beside(self, batch: Batch, generator: torch.Generator | None) -> Batch:
        """A batch with demonstrated moves, a quarter as many, behind its own transitions."""
        count = round(DEMONSTRATED_SHARE * len(batch.rewards))
        drawn = torch.randint(
            len(self._transitions.rewards), (count,), generator=generator, device=batch.rewards.device
        )
        shown = self._transitions
        return Batch(
            torch.cat((batch.observations, shown.observations[drawn])),
            torch.cat((batch.actions, shown.actions[drawn])),
            torch.cat((batch.rewards, shown.rewards[drawn])),
            torch.cat((batch.next_observations, shown.next_observations[drawn])),
            torch.cat((batch.terminations, shown.terminations[drawn])),
        )


class DemonstratedReward:
    """A discriminator of views with its optimiser; it has the width and the step size of the critics."""

    def __init__(self, demonstrations: DemonstratedMoves, config: TrainConfig, seed: int) -> None:
        """Begins without knowledge.

        Args:
            demonstrations: What is to be imitated.
            config: Of the learner.
            seed: Of the first weights.
        """
        self._demonstrations = demonstrations
        self._views, self._terminations = demonstrations.views, demonstrations.terminations
        self._gamma = config.gamma
        widths = (demonstrations.views.shape[1], *config.critic_hidden)
        layers: list[nn.Module] = []
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            for before, after in zip(widths, widths[1:], strict=False):
                layers += [nn.Linear(before, after), nn.Tanh()]
            self.network = nn.Sequential(*layers, nn.Linear(widths[-1], 1))
        self._optimizer = torch.optim.Adam(
            self.network.parameters(), lr=config.critic_learning_rate, fused=True
        )

    def to(self, device: torch.device) -> None:
        """See `RewardModel.to`."""
        self.network.to(device)
        self._views, self._terminations = self._views.to(device), self._terminations.to(device)

    @torch.no_grad()
    def reward(self, views: Tensor, normalizer: ObservationNormalizer) -> Tensor:
        """The reward of views, times 1 - gamma, so that values are of the size of the logit.

        Args:
            views: Observations, not normalised. Shape (B, D).
            normalizer: As the actor sees them.

        Returns:
            Shape (B,).
        """
        logits: Tensor = self.network(normalizer(views))
        return (1.0 - self._gamma) * logits[:, 0]

    def judge(self, batch: Batch, normalizer: ObservationNormalizer) -> Batch:
        """See `RewardModel.judge`."""
        rewards = self.reward(batch.next_observations, normalizer)
        return batch._replace(rewards=rewards * stays(batch.terminations, self._gamma))

    def update(
        self, batch: Batch, normalizer: ObservationNormalizer, generator: torch.Generator | None
    ) -> dict[str, Tensor]:
        """One Adam step on the discriminator's cross-entropy and its gradient penalty.

        Returns:
            `reward_loss`, both together, and the mean logits `demonstrated_views` and `own_views`: scalars.
        """
        count, device = len(batch.rewards), batch.rewards.device
        drawn = torch.randint(len(self._views), (count,), generator=generator, device=device)
        mix = torch.rand(count, 1, generator=generator, device=device)
        demonstrated, own = normalizer(self._views[drawn]), normalizer(batch.next_observations)
        demonstrated_logits, own_logits = self.network(torch.cat((demonstrated, own)))[:, 0].split(count)
        demonstrated_weight = stays(self._terminations[drawn], self._gamma)
        own_weight = stays(batch.terminations, self._gamma)
        loss = (
            _weighted_mean(functional.softplus(-demonstrated_logits), demonstrated_weight)
            + _weighted_mean(functional.softplus(own_logits), own_weight)
            + GRADIENT_PENALTY * gradient_penalty(self.network, demonstrated, own, mix)
        )
        self._optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        self._optimizer.step()
        return {
            "reward_loss": loss.detach(),
            "demonstrated_views": demonstrated_logits.detach().mean(),
            "own_views": own_logits.detach().mean(),
        }

    def state_dict(self) -> dict[str, Any]:
        """See `RewardModel.state_dict`; the demonstrations themselves stay in their file."""
        return {
            "demonstrations": self._demonstrations.digest,
            "network": self.network.state_dict(),
            "optimizer": self._optimizer.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """See `RewardModel.load_state_dict`.

        Raises:
            CheckpointError: The demonstrations are not those that the run began with.
        """
        if state["demonstrations"] != self._demonstrations.digest:
            raise CheckpointError(
                "the demonstrations are not those that this run began with; put back the file that reward_from names"
            )
        self.network.load_state_dict(state["network"])
        self._optimizer.load_state_dict(state["optimizer"])


def _weighted_mean(values: Tensor, weights: Tensor) -> Tensor:
    return (values * weights).sum() / weights.sum()
