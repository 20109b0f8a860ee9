"""What trainings in rounds of episodes and fits have in common; cheap to import."""

from dataclasses import dataclass
from typing import Any

from maniskill_tomato.errors import InvalidInputError


@dataclass(frozen=True, kw_only=True)
class DescentConfig:
    """How a network is fitted."""

    steps: int = 4000
    """Batches."""
    batch_size: int
    """Samples in each."""
    learning_rate: float
    """Of AdamW at the start; it falls to nothing along half a cosine."""
    weight_decay: float = 1e-3
    """Of AdamW."""
    seed: int = 0

    def __post_init__(self) -> None:
        check_counts(self, "steps", "batch_size")
        if not 0.0 < self.learning_rate < 1.0:
            raise InvalidInputError(f"learning_rate must be in (0, 1), got {self.learning_rate}")


@dataclass(frozen=True, kw_only=True)
class RoundsConfig:
    """A training in rounds."""

    rounds: tuple[int, ...]
    """Episodes of each round."""
    block: int = 100
    """Episodes that a process runs and writes at a time; what a stopped training repeats."""
    seed: int = 0

    def __post_init__(self) -> None:
        check_counts(self, "block")
        if not self.rounds or min(self.rounds) < 1:
            raise InvalidInputError(f"rounds must list one or more numbers above 0, got {self.rounds}")
        if not 0 <= self.seed < 100:
            raise InvalidInputError(f"seed must be from 0 to 99, got {self.seed}")


def check_counts(config: Any, *names: str) -> None:
    """Raises an `InvalidInputError` for the first of these fields that is below 1."""
    for name in names:
        if getattr(config, name) < 1:
            raise InvalidInputError(f"{name} must be 1 or more, got {getattr(config, name)}")
