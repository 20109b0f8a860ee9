"""A policy: the camera goes round its start in growing circles, and always looks at the target."""

import math
from typing import Any

import torch
from torch import Tensor

from maniskill_tomato.policies.registry import PolicyContext


class Spiral:
    """Needs no more than how often it has looked."""

    name = "spiral"
    needs_truth = False

    def begin(self, belief: Any, rows: Tensor) -> None:
        """Nothing is remembered."""

    def act(self, belief: Any) -> Tensor:
        """Moves right, up and forward, as shares of the longest move. Shape (B, 3)."""
        looks = belief.memory.visits.float()
        angle = looks * math.pi / 3
        size = (0.4 + 0.1 * looks).clamp(max=1.0)
        return torch.stack([size * angle.cos(), size * angle.sin(), torch.zeros_like(size)], dim=-1)


def make_policy(context: PolicyContext) -> Spiral:
    """What the entry point names."""
    return Spiral()
