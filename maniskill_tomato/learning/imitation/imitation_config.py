"""How imitation is configured; cheap to import."""

from dataclasses import dataclass, field
from typing import Literal

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.learning.round_config import DescentConfig, RoundsConfig, check_counts

StudentKind = Literal["actor", "recurrent"]


@dataclass(frozen=True, kw_only=True)
class ImitationFitConfig(DescentConfig):
    """How a student is fitted in each round."""

    batch_size: int = 256
    """Moves in each batch; for a recurrent student the moves of about as many episodes as this by 8."""
    learning_rate: float = 1e-3
    """Of AdamW at the start; it falls to nothing along half a cosine."""


@dataclass(frozen=True, kw_only=True)
class ImitationConfig(RoundsConfig):
    """A training."""

    student: StudentKind = "actor"
    """`actor`: the network of the preset `general-td3` on the whole observation; `recurrent`: a GRU on what the present
    view tells, without the memory."""
    rounds: tuple[int, ...] = (1500, 1000, 1000, 1000)
    """Episodes of each round. The teacher leads the first, which alone is behaviour cloning; the student of the round
    before leads `student_share` of the later ones (DAgger)."""
    pool: int = 120
    """Training plants that three quarters of the episodes draw from; the others grow a new one each."""
    student_share: float = 0.9
    """Share of the later rounds' episodes that the student leads."""
    fit: ImitationFitConfig = field(default_factory=ImitationFitConfig)
    """How each round's student is fitted, always from scratch to the data of all rounds."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_counts(self, "pool")
        if not 0.0 <= self.student_share <= 1.0:
            raise InvalidInputError(f"student_share must be from 0 to 1, got {self.student_share}")


@dataclass(frozen=True, kw_only=True)
class RegressionConfig:
    """How the network of Deep 3D Move To See is trained."""

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
