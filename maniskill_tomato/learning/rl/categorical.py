"""Values as distributions over fixed atoms (C51, Bellemare et al., 2017), as FastTD3 uses them (Seo et al., 2025)."""

from collections.abc import Sequence

import torch
from torch import Tensor

from maniskill_tomato.learning.rl.critic import Critic


class CategoricalCritic(Critic):
    """The distribution of Q(s, a) over evenly spaced values; called, it answers with the mean like a `Critic`."""

    atoms: Tensor

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        hidden: Sequence[int],
        action_layer: int,
        atoms: int,
        value_range: tuple[float, float],
    ) -> None:
        """Builds the layers.

        Args:
            observation_dim: Number of observed values.
            action_dim: Number of actions.
            hidden: Width of each hidden layer.
            action_layer: Hidden layer that the action enters.
            atoms: How many values the distribution is over.
            value_range: The smallest and the largest of them.
        """
        super().__init__(observation_dim, action_dim, hidden, action_layer, outputs=atoms)
        self.register_buffer("atoms", torch.linspace(*value_range, atoms))

    def logits(self, observations: Tensor, actions: Tensor) -> Tensor:
        """Unnormalised log-probabilities of the atoms. Shape (B, atoms)."""
        logits: Tensor = self.output(self.features(observations, actions))
        return logits

    def forward(self, observations: Tensor, actions: Tensor) -> Tensor:
        """The mean value. Shape (B,)."""
        return self.mean(self.logits(observations, actions).softmax(dim=-1))

    def mean(self, probabilities: Tensor) -> Tensor:
        """The mean of distributions over the atoms. Shapes (..., atoms) and (...)."""
        return (probabilities * self.atoms).sum(dim=-1)


def project(probabilities: Tensor, atoms: Tensor, rewards: Tensor, discounts: Tensor) -> Tensor:
    """The distribution of r + gamma Z over the atoms that Z has (Bellemare et al., 2017, Algorithm 1).

    A shifted value between two atoms is shared by them in proportion to how near it is; beyond the outermost it
    goes to these.

    Args:
        probabilities: Of Z. Shape (B, atoms).
        atoms: Evenly spaced, rising. Shape (atoms,).
        rewards: Shape (B,).
        discounts: gamma^k, 0 after a termination. Shape (B,).

    Returns:
        Rows that add up to 1. Shape (B, atoms).
    """
    low, high = atoms[0], atoms[-1]
    spacing = (high - low) / (len(atoms) - 1)
    shifted = (rewards[:, None] + discounts[:, None] * atoms).clamp(low, high)
    # Rounding may put the place of the last atom a little beyond it.
    place = ((shifted - low) / spacing).clamp(0.0, len(atoms) - 1)
    below = place.floor()
    above_share = place - below
    below = below.long()
    above = (below + 1).clamp(max=len(atoms) - 1)
    projected = torch.zeros_like(probabilities)
    projected.scatter_add_(1, below, probabilities * (1.0 - above_share))
    projected.scatter_add_(1, above, probabilities * above_share)
    return projected
