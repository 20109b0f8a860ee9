"""A learned map of how good views are, and a search on it: the policy that looks where a full view is likely and near.

The network has seen, for thousands of hidden tomatoes, what the memory knew after a few looks and how much of the
target every candidate view would really have shown. At each step the policy moves towards the candidate with the
largest P(full view) x `patience` - moves: with moves as the cost, `patience` is what it expects to need from here if
a look fails, the rule that is best when looks succeed or fail independently and their number is not bounded. A
touched plant costs as much as `touch_cost` moves.
"""

import math
from dataclasses import asdict, astuple, dataclass
from pathlib import Path
from typing import Any, Final

import torch
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.policies.lattice_planner import LatticePlanner, way_to
from maniskill_tomato.policies.moves import moves_needed
from maniskill_tomato.policies.network_file import load_network, save_network
from maniskill_tomato.policies.quality_blend import Blend
from maniskill_tomato.policies.quality_features import MAP_CHANNELS, SCALARS, quality_features
from maniskill_tomato.policies.quality_network import ViewQualityNetwork
from maniskill_tomato.sensing.belief import Belief
from maniskill_tomato.sensing.view_lattice import DISTANCES

FORMAT: Final = "view-quality-3"


@dataclass(frozen=True, kw_only=True)
class ViewQualityConfig:
    """How the policy weighs."""

    patience: float = 24.0
    """Moves that are worth a certain full view."""
    touch_cost: float = 0.0
    """Moves that are worth not touching the plant."""
    blend: Blend = Blend()
    """How the network's log-odds and the memory's are weighed."""

    def __post_init__(self) -> None:
        if not 0.0 < self.patience < math.inf:
            raise InvalidInputError(f"patience must be a positive number, got {self.patience}")
        if not 0.0 <= self.touch_cost < math.inf:
            raise InvalidInputError(f"touch_cost must be 0 or more, got {self.touch_cost}")
        if not all(map(math.isfinite, astuple(self.blend))):
            raise InvalidInputError(f"the weights of the blend must be finite, got {self.blend}")


class ViewQuality(LatticePlanner):
    """Moves towards the view that the network thinks most of."""

    name = "view_quality"

    def __init__(
        self,
        network: ViewQualityNetwork,
        config: ViewQualityConfig | None = None,
        facts: dict[str, Any] | None = None,
    ) -> None:
        """Keeps the network.

        Args:
            network: Judges the candidates.
            config: How the policy weighs.
            facts: Numbers and strings about its training.
        """
        super().__init__()
        self.network = network.eval().requires_grad_(False)
        self.config = config or ViewQualityConfig()
        self.facts = facts or {}

    def describe(self) -> dict[str, Any]:
        """Its kind and its training."""
        return {**super().describe(), **self.facts}

    def success_probability(self, belief: Belief) -> Tensor:
        """P(full view) of every candidate. Shape (B, K)."""
        return self._probabilities(belief)[0]

    def worth(self, belief: Belief, views: Tensor) -> Tensor:
        """P(full view) x patience - P(touch) x touch_cost - moves. Shape (B, K)."""
        full, touch = self._probabilities(belief)
        gain = self.config.patience * full - self.config.touch_cost * touch
        return gain - moves_needed(way_to(belief, views))

    def _probabilities(self, belief: Belief) -> tuple[Tensor, Tensor]:
        maps, scalars = quality_features(belief)
        with torch.no_grad():
            judged = self.network(maps, scalars)
        return self.config.blend.log_odds(maps, judged.full).sigmoid(), judged.touch.flatten(1).sigmoid()


def save_view_quality(path: Path, policy: ViewQuality) -> None:
    """Writes the network, the settings and the facts."""
    network = policy.network
    save_network(
        path, FORMAT, network.sizes, network.state_dict(), config=asdict(policy.config), facts=policy.facts
    )


def load_view_quality(path: Path, device: str | torch.device = "cpu") -> ViewQuality:
    """Reads what `save_view_quality` wrote.

    Raises:
        CheckpointError: The file is missing, damaged, or of something else.
    """

    def build(data: dict[str, Any]) -> tuple[ViewQuality, ViewQualityNetwork]:
        network = ViewQualityNetwork(**data["sizes"])
        config = {**data["config"], "blend": Blend(**data["config"]["blend"])}
        return ViewQuality(network, ViewQualityConfig(**config), dict(data["facts"])), network

    return load_network(
        path, FORMAT, device, build, "view-quality policy; `maniskill-tomato train-view-quality` makes one"
    )


def new_network(width: int = 32, blocks: int = 3) -> ViewQualityNetwork:
    """A fresh network for the features of `quality_features`."""
    return ViewQualityNetwork(MAP_CHANNELS, SCALARS, DISTANCES, width, blocks)
