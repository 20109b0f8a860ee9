"""How the training of view quality is configured; cheap to import."""

from dataclasses import dataclass, field

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.learning.round_config import DescentConfig, RoundsConfig, check_counts

VALIDATION_SEED = 900_000_000
"""Seed of the first validation episode; training episodes stay below."""


@dataclass(frozen=True, kw_only=True)
class FitConfig(DescentConfig):
    """How the network is trained."""

    batch_size: int = 128
    """Looks in each batch."""
    learning_rate: float = 2e-3
    """Of AdamW at the start; it falls to nothing along half a cosine."""
    width: int = 32
    """Channels of the network's maps."""
    blocks: int = 3
    """Its residual blocks."""
    full_visibility: float = 0.8
    """V_f above which a view is a full one."""
    fraction_weight: float = 2.0
    """Weight of the squared error of V_f beside the cross entropy of full views."""
    mirror: bool = True
    """Also learn from the mirror images of the looks, left and right exchanged."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_counts(self, "width", "blocks")
        if not 0.0 < self.full_visibility < 1.0:
            raise InvalidInputError(f"full_visibility must be in (0, 1), got {self.full_visibility}")


@dataclass(frozen=True, kw_only=True)
class QualityTrainConfig(RoundsConfig):
    """A training."""

    rounds: tuple[int, ...] = (3000, 3000)
    """Episodes of each round. The first is led by the planner on the occupancy map, the later ones mostly by the
    network of the round before."""
    validation_episodes: int = 200
    """Episodes on the validation plants, for the losses in the log."""
    fit: FitConfig = field(default_factory=FitConfig)
    """How each round's network is trained, the first from scratch, the others going on from the one before."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_counts(self, "validation_episodes")
        if max(self.rounds) * len(self.rounds) > VALIDATION_SEED // 100:
            raise InvalidInputError(f"the rounds must hold less than 9 million episodes, got {self.rounds}")
