"""Running mean and spread of the observations, from which the normaliser follows the run."""

import torch
from torch import Tensor, nn

from maniskill_tomato.policies.actor import ObservationNormalizer

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
