"""What the network and the memory say of a full view, weighed against each other.

The network has learned from some kinds of plants, and is too sure of itself on others. The memory's own prediction
assumes less and carries over better, and each of them knows something that the other does not. Their log-odds are
added with weights that are fitted on plants of kinds that the network has not learned from: a logistic regression, as
in stacked generalisation (Wolpert 1992).
"""

from dataclasses import astuple, dataclass
from typing import Final

import torch
from torch import Tensor

from maniskill_tomato.policies.quality_features import FEATURES
from maniskill_tomato.sensing.view_lattice import DISTANCES

SUREST: Final = 0.99
"""The memory's prediction is taken for no surer than this, nor less than 1 less this."""


@dataclass(frozen=True)
class Blend:
    """Weights of the terms of the log-odds of a full view; the network's own by default."""

    network: float = 1.0
    """Of the network's log-odds."""
    expected: float = 0.0
    """Of the log-odds of the visible share that the memory expects, or that was measured in a view that is alike."""
    unknown: float = 0.0
    """Of the unknown share of the way."""
    alike: float = 0.0
    """Of how alike the most similar view is that was taken."""
    constant: float = 0.0

    def log_odds(self, maps: Tensor, full: Tensor) -> Tensor:
        """Log-odds of a full view.

        Args:
            maps: Those of `quality_features`. Shape (B, 28, 13, 9).
            full: The network's. Shape (B, 13, 9, 4).

        Returns:
            Of all candidates, in the lattice's order. Shape (B, K).
        """
        if self == Blend():
            return full.flatten(1)
        log_odds: Tensor = blend_terms(maps, full) @ full.new_tensor(astuple(self))
        return log_odds


def blend_terms(maps: Tensor, full: Tensor) -> Tensor:
    """The terms that `Blend` weighs, of every candidate. Shape (B, K, 5), in the order of its fields."""
    table = maps.view(len(maps), len(FEATURES), DISTANCES, *maps.shape[2:]).permute(0, 1, 3, 4, 2).flatten(2)
    expected, unknown, measured, alike = (
        table[:, FEATURES.index(name)] for name in ("expected", "unknown", "measured", "alike")
    )
    # `measured` is V_f times `alike` already.
    expected = ((1.0 - alike) * expected + measured).clamp(1.0 - SUREST, SUREST)
    ones = torch.ones_like(unknown)
    return torch.stack([full.flatten(1), torch.logit(expected), unknown, alike, ones], dim=-1)
