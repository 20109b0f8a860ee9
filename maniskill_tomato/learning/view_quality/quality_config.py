"""How the training of view quality is configured; cheap to import."""

from dataclasses import dataclass, field

from maniskill_tomato.errors import InvalidInputError

VALIDATION_SEED = 900_000_000
"""Seed of the first validation episode; training episodes stay below."""


@dataclass(frozen=True, kw_only=True)
class FitConfig:
    """How the network is trained."""

    steps: int = 4000
    """Batches."""
    batch_size: int = 128
    """Looks in each."""
    learning_rate: float = 2e-3
    """Of AdamW at the start; it falls to nothing along half a cosine."""
    weight_decay: float = 1e-3
    """Of AdamW."""
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
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("steps", "batch_size", "width", "blocks"):
            if getattr(self, name) < 1:
                raise InvalidInputError(f"{name} must be 1 or more, got {getattr(self, name)}")
        if not 0.0 < self.learning_rate < 1.0:
            raise InvalidInputError(f"learning_rate must be in (0, 1), got {self.learning_rate}")
        if not 0.0 < self.full_visibility < 1.0:
            raise InvalidInputError(f"full_visibility must be in (0, 1), got {self.full_visibility}")


@dataclass(frozen=True, kw_only=True)
class QualityTrainConfig:
    """A training."""

    rounds: tuple[int, ...] = (3000, 3000)
    """Episodes of each round. The first is led by the planner on the occupancy map, the later ones mostly by the
    network of the round before."""
    pool: int = 120
    """Training plants that three quarters of the episodes draw from; the others grow a new one each."""
    block: int = 100
    """Episodes that a process runs and writes at a time; what a stopped training repeats."""
    validation_episodes: int = 200
    """Episodes on the validation plants, for the losses in the log."""
    fit: FitConfig = field(default_factory=FitConfig)
    """How each round's network is trained, the first from scratch, the others going on from the one before."""
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("pool", "block", "validation_episodes"):
            if getattr(self, name) < 1:
                raise InvalidInputError(f"{name} must be 1 or more, got {getattr(self, name)}")
        if not self.rounds or min(self.rounds) < 1:
            raise InvalidInputError(f"rounds must list one or more numbers above 0, got {self.rounds}")
        if not 0 <= self.seed < 100 or max(self.rounds) * len(self.rounds) > VALIDATION_SEED // 100:
            raise InvalidInputError(
                "seed must be from 0 to 99 and the rounds hold less than 9 million episodes"
            )
