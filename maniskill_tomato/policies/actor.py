"""The actor's network and the normaliser before it: the thesis's (section 4-3-2) and wider ones of the same shape."""

from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor, nn

ACTOR_SMALL_OUTPUT_BOUND = 3e-3
"""Half-width of the actor's output weights with `output_init="small"`: the first actions are nearly zero
(Lillicrap et al., 2016)."""

ActorOutputInit = Literal["glorot", "small"]


def initialise_hidden_(layer: nn.Linear) -> None:
    """He initialisation for a ReLU layer: weights N(0, 2 / fan_in), biases zero."""
    nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
    nn.init.zeros_(layer.bias)


class Actor(nn.Module):
    """The policy mu(s): hidden ReLU layers, then tanh.

    The output is in units of the action scale: the environment's action is `output * action_scale`.
    """

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        hidden: Sequence[int] = (100, 100),
        output_init: ActorOutputInit = "glorot",
    ) -> None:
        """Builds the layers.

        Args:
            observation_dim: Number of observed values.
            action_dim: Number of actions.
            hidden: Width of each hidden layer.
            output_init: `glorot`: uniform within sqrt(6 / (fan_in + fan_out)), as the thesis; `small`:
                uniform within `ACTOR_SMALL_OUTPUT_BOUND`.
        """
        super().__init__()
        widths = (observation_dim, *hidden)
        layers = [nn.Linear(a, b) for a, b in zip(widths[:-1], widths[1:], strict=True)]
        for layer in layers:
            initialise_hidden_(layer)
        self.hidden = nn.ModuleList(layers)
        self.output = nn.Linear(widths[-1], action_dim)
        if output_init == "glorot":
            nn.init.xavier_uniform_(self.output.weight)
        else:
            nn.init.uniform_(self.output.weight, -ACTOR_SMALL_OUTPUT_BOUND, ACTOR_SMALL_OUTPUT_BOUND)
        nn.init.zeros_(self.output.bias)

    def features(self, observations: Tensor) -> Tensor:
        """The last hidden layer. Shape (B, width)."""
        x = observations
        for layer in self.hidden:
            x = torch.relu(layer(x))
        return x

    def pre_activation(self, observations: Tensor) -> Tensor:
        """The output before tanh. Shape (B, action_dim)."""
        out: Tensor = self.output(self.features(observations))
        return out

    def forward(self, observations: Tensor) -> Tensor:
        """Actions in [-1, 1] for normalised observations of shape (B, observation_dim). Shape (B,
        action_dim)."""
        return torch.tanh(self.pre_activation(observations))


class ObservationNormalizer(nn.Module):
    """An affine map `(observation - centre) / half_range`."""

    centre: Tensor
    half_range: Tensor

    def __init__(self, centre: Sequence[float], half_range: Sequence[float]) -> None:
        super().__init__()
        self.register_buffer("centre", torch.tensor(centre, dtype=torch.float32))
        self.register_buffer("half_range", torch.tensor(half_range, dtype=torch.float32))

    @classmethod
    def identity(cls, observation_dim: int) -> "ObservationNormalizer":
        """The map that changes nothing."""
        return cls([0.0] * observation_dim, [1.0] * observation_dim)

    def forward(self, observations: Tensor) -> Tensor:
        """Scaled observations, of the same shape (B, observation_dim)."""
        return (observations - self.centre) / self.half_range
