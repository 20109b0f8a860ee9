"""The network: maps over candidate directions in, what to expect at every candidate out."""

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from maniskill_tomato.errors import InvalidInputError


class Judgement(NamedTuple):
    """What the network says of every candidate; each of shape (B, azimuths, elevations, distances)."""

    full: Tensor
    """Logits of the target being fully visible."""
    fraction: Tensor
    """Visible fraction to expect, in [0, 1]."""
    touch: Tensor
    """Logits of the arm touching the plant on the move that ends there."""


class _DirectionBlock(nn.Module):
    """Two convolutions with a residual; the second one also hears the mean over all directions.

    The mean carries what one direction says about all others, e.g. how dense the plant is, over any distance
    (global pooling bias, Wu 2019, "Accelerating Self-Play Learning in Go", section 4.2).
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(width, width, 3, padding=1)
        self.everywhere = nn.Linear(2 * width, width)
        self.second = nn.Conv2d(width, width, 3, padding=1)
        nn.init.zeros_(self.second.weight)

    def forward(self, maps: Tensor) -> Tensor:
        """Maps of the same shape (B, width, azimuths, elevations)."""
        inner = functional.relu(self.first(functional.relu(maps)))
        overall = torch.cat([inner.mean(dim=(2, 3)), inner.amax(dim=(2, 3))], dim=-1)
        inner = inner + self.everywhere(overall)[..., None, None]
        out: Tensor = maps + self.second(functional.relu(inner))
        return out


class ViewQualityNetwork(nn.Module):
    """A small convolutional network over the directions from the target; distances are channels."""

    def __init__(
        self, map_channels: int, scalars: int, distances: int, width: int = 48, blocks: int = 3
    ) -> None:
        """Builds the layers.

        Args:
            map_channels: Channels of the input maps.
            scalars: Values that hold for all directions alike.
            distances: Candidate distances in every direction.
            width: Channels of the hidden maps.
            blocks: Residual blocks.

        Raises:
            InvalidInputError: A size is below 1.
        """
        super().__init__()
        sizes = {
            "map_channels": map_channels,
            "scalars": scalars,
            "distances": distances,
            "width": width,
            "blocks": blocks,
        }
        for name, size in sizes.items():
            if size < 1:
                raise InvalidInputError(f"{name} must be 1 or more, got {size}")
        self.sizes = sizes
        self.entry = nn.Conv2d(map_channels, width, 3, padding=1)
        self.entry_scalars = nn.Linear(scalars, width)
        self.blocks = nn.ModuleList(_DirectionBlock(width) for _ in range(blocks))
        self.exit = nn.Conv2d(width, 3 * distances, 1)

    def forward(self, maps: Tensor, scalars: Tensor) -> Judgement:
        """Judges every candidate.

        Args:
            maps: Shape (B, map_channels, azimuths, elevations).
            scalars: Shape (B, scalars).
        """
        x = self.entry(maps) + self.entry_scalars(scalars)[..., None, None]
        for block in self.blocks:
            x = block(x)
        full, fraction, touch = self.exit(functional.relu(x)).permute(0, 2, 3, 1).chunk(3, dim=-1)
        return Judgement(full, fraction.sigmoid(), touch)
