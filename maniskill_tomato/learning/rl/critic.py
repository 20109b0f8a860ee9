"""The critics: the thesis's network (section 4-3-2), wider ones of the same shape, and values as distributions over
fixed atoms (C51, Bellemare et al., 2017), as FastTD3 uses them (Seo et al., 2025)."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from maniskill_tomato.policies.actor import initialise_hidden_

CRITIC_OUTPUT_BOUND = 0.05
"""Half-width of the critic's uniform output weights. The thesis says "a uniform distribution" and no bound;
this is the default of Keras's RandomUniform, whose vocabulary (dense layer, kernel, He and Glorot
initialiser) the thesis uses."""


class Critic(nn.Module):
    """The value Q(s, a): hidden ReLU layers, then one linear output.

    The action joins the input of the hidden layer `action_layer`: 1 as in the thesis (the first layer sees
    the state alone), 0 to give the state and the action to the first layer.
    """

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        hidden: Sequence[int] = (100, 100),
        action_layer: int = 1,
        outputs: int = 1,
    ) -> None:
        super().__init__()
        self.action_layer = action_layer
        layers: list[nn.Linear] = []
        fan_in = observation_dim
        for index, width in enumerate(hidden):
            layers.append(nn.Linear(fan_in + (action_dim if index == action_layer else 0), width))
            initialise_hidden_(layers[-1])
            fan_in = width
        self.hidden = nn.ModuleList(layers)
        self.output = nn.Linear(fan_in, outputs)
        nn.init.uniform_(self.output.weight, -CRITIC_OUTPUT_BOUND, CRITIC_OUTPUT_BOUND)
        nn.init.zeros_(self.output.bias)

    def features(self, observations: Tensor, actions: Tensor) -> Tensor:
        """The last hidden layer. Shape (B, width)."""
        x = observations
        for index, layer in enumerate(self.hidden):
            if index == self.action_layer:
                x = torch.cat((x, actions), dim=-1)
            x = torch.relu(layer(x))
        return x

    def forward(self, observations: Tensor, actions: Tensor) -> Tensor:
        """Values of shape (B,) for observations (B, observation_dim) and actions in [-1, 1], (B,
        action_dim)."""
        values: Tensor = self.output(self.features(observations, actions))
        return values.squeeze(-1)


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
