"""Heads on the networks that learn to predict what the reward is made of, so that the layers below learn it sooner
(auxiliary tasks, Jaderberg et al., 2017)."""

import torch
from torch import Tensor, nn

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.learning.rl.replay import Batch
from maniskill_tomato.learning.rl.train_config import TrainConfig
from maniskill_tomato.policies.layout import TARGET_POSITION

EE_POSITION = slice(0, 3)
"""Where the end-effector's position is in the observation."""


class AuxiliaryHeads(nn.Module):
    """Linear heads on the last hidden layers; those of weight 0 do not exist.

    They are no part of the actor or the critics, so that a policy is the same with and without them.
    """

    def __init__(self, config: TrainConfig, observation_dim: int) -> None:
        """Makes the heads that have a weight.

        Raises:
            InvalidInputError: The distance is to be predicted, and the observation does not hold it.
        """
        super().__init__()
        self.distance: nn.Linear | None = None
        """From the actor's features: the distance of end-effector and target, in [m]."""
        self.visible_fraction: nn.ModuleList | None = None
        """From each critic's features: V_f after the action."""
        if config.aux_distance_weight > 0.0:
            if observation_dim < TARGET_POSITION.stop:
                raise InvalidInputError(
                    "aux_distance_weight needs an observation that holds the target's position, got one of "
                    f"{observation_dim} values; set it to 0"
                )
            self.distance = nn.Linear(config.actor_hidden[-1], 1)
        if config.aux_visibility_weight > 0.0:
            self.visible_fraction = nn.ModuleList(
                nn.Linear(config.critic_hidden[-1], 1) for _ in range(2 if config.twin_critics else 1)
            )

    def distance_loss(self, features: Tensor, observations: Tensor) -> Tensor:
        """Mean squared error of the distance, in [m^2]; a scalar.

        Args:
            features: The actor's. Shape (B, width).
            observations: Not normalised. Shape (B, observation_dim).
        """
        assert self.distance is not None
        offset = observations[:, TARGET_POSITION] - observations[:, EE_POSITION]
        predicted: Tensor = self.distance(features)
        return torch.nn.functional.mse_loss(predicted[:, 0], offset.norm(dim=-1))

    def visibility_loss(self, index: int, features: Tensor, batch: Batch) -> Tensor:
        """Mean squared error of V_f after the action; a scalar.

        Args:
            index: Which critic.
            features: Its own. Shape (B, width).
            batch: Transitions with their V_f.
        """
        assert self.visible_fraction is not None and batch.visible_fractions is not None
        predicted: Tensor = self.visible_fraction[index](features)
        return torch.nn.functional.mse_loss(predicted[:, 0], batch.visible_fractions)
