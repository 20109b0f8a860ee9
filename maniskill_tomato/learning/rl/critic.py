"""The critic's network: the thesis's (section 4-3-2) and wider ones of the same shape."""

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
