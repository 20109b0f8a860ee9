"""How the training of view quality is configured; cheap to import."""

from dataclasses import dataclass, field

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.learning.round_config import DescentConfig, RoundsConfig, check_counts
from maniskill_tomato.plants.seed_splits import SEED_SPLITS

VALIDATION_SEED = 900_000_000
"""Seed of the first validation episode; training episodes stay below."""

SEEDS_A_PLANT = 10
"""Seeds of episodes that belong to each plant."""


@dataclass(frozen=True, kw_only=True)
class FitConfig(DescentConfig):
    """How the network is trained."""

    steps: int = 2500
    """Batches."""
    batch_size: int = 128
    """Looks in each batch."""
    learning_rate: float = 4e-3
    """Of AdamW at the start; it falls to nothing along half a cosine."""
    width: int = 32
    """Channels of the network's maps."""
    blocks: int = 3
    """Its residual blocks."""
    full_visibility: float = 0.8
    """V_f above which a view is a full one."""
    fraction_weight: float = 2.0
    """Weight of the squared error of V_f beside the cross entropy of full views."""
    touch_weight: float = 0.25
    """Weight of the cross entropy of touches beside it."""
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

    rounds: tuple[int, ...] = (2000, 4000, 4000)
    """Episodes of each round. The first is led by the planner on the occupancy map, the later ones mostly by the
    network of the round before."""
    episodes_a_plant: int = 4
    """Episodes on each plant, which is grown for them and not met again."""
    validation_episodes: int = 200
    """Episodes on validation plants of `other_kind`, on which the network's log-odds and the memory's are weighed; the
    log tells the losses there."""
    fit: FitConfig = field(default_factory=FitConfig)
    """How each round's network is trained, the first from scratch, the others going on from the one before."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_counts(self, "episodes_a_plant", "validation_episodes")
        if self.episodes_a_plant > SEEDS_A_PLANT:
            raise InvalidInputError(
                f"episodes_a_plant must be {SEEDS_A_PLANT} or less, got {self.episodes_a_plant}"
            )
        if self.block % self.episodes_a_plant:
            raise InvalidInputError(
                f"block must be a multiple of episodes_a_plant, {self.episodes_a_plant}; got {self.block}"
            )
        low, high = SEED_SPLITS["train"]
        if (self.seed + 1) * len(self.rounds) * self.plants(max(self.rounds)) > high - low:
            raise InvalidInputError(
                f"rounds and seed ask for more than the {high - low} training plants, got {self.rounds} and {self.seed}"
            )

    def plants(self, episodes: int) -> int:
        """Plants that the whole blocks of so many episodes are run on."""
        return -(-episodes // self.block) * (self.block // self.episodes_a_plant)
