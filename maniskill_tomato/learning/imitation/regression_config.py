"""How the network of Deep 3D Move To See is trained; cheap to import."""

from dataclasses import dataclass

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.learning.round_config import check_counts


@dataclass(frozen=True, kw_only=True)
class RegressionConfig:
    """How the network is trained."""

    epochs: int = 15
    """Passes over the data; theirs: 50."""
    batch_size: int = 64
    """As theirs."""
    learning_rate: float = 1e-3
    """Of Adam; theirs fine-tune by SGD with momentum at 1e-5."""
    validation_share: float = 0.1
    """Share of the data, its last part, by whose loss the epoch is chosen."""
    seed: int = 0

    def __post_init__(self) -> None:
        check_counts(self, "epochs", "batch_size")
        if not 0.0 < self.validation_share < 1.0:
            raise InvalidInputError(f"validation_share must lie in (0, 1), got {self.validation_share}")
        if not self.learning_rate > 0.0:
            raise InvalidInputError(f"learning_rate must be positive, got {self.learning_rate}")
