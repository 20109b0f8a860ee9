"""How imitation is configured; cheap to import."""

from dataclasses import dataclass, field
from typing import Literal

from maniskill_tomato.errors import InvalidInputError

StudentKind = Literal["actor", "recurrent"]


@dataclass(frozen=True, kw_only=True)
class ImitationFitConfig:
    """How a student is fitted."""

    steps: int = 4000
    """Batches of each round."""
    batch_size: int = 256
    """Moves in each; for a recurrent student the moves of about as many episodes as this by 8."""
    learning_rate: float = 1e-3
    """Of AdamW at the start; it falls to nothing along half a cosine."""
    weight_decay: float = 1e-3
    """Of AdamW."""
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("steps", "batch_size"):
            if getattr(self, name) < 1:
                raise InvalidInputError(f"{name} must be 1 or more, got {getattr(self, name)}")
        if not 0.0 < self.learning_rate < 1.0:
            raise InvalidInputError(f"learning_rate must be in (0, 1), got {self.learning_rate}")


@dataclass(frozen=True, kw_only=True)
class ImitationConfig:
    """A training."""

    student: StudentKind = "actor"
    """`actor`: the network of the preset `general-td3` on the whole observation; `recurrent`: a GRU on what the present
    view tells, without the memory."""
    rounds: tuple[int, ...] = (1500, 1000, 1000, 1000)
    """Episodes of each round. The teacher leads the first, which alone is behaviour cloning; the student of the round
    before leads `student_share` of the later ones (DAgger)."""
    student_share: float = 0.9
    """Share of the later rounds' episodes that the student leads."""
    pool: int = 120
    """Training plants that three quarters of the episodes draw from; the others grow a new one each."""
    block: int = 100
    """Episodes that a process runs and writes at a time; what a stopped training repeats."""
    fit: ImitationFitConfig = field(default_factory=ImitationFitConfig)
    """How each round's student is fitted, always from scratch to the data of all rounds."""
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("pool", "block"):
            if getattr(self, name) < 1:
                raise InvalidInputError(f"{name} must be 1 or more, got {getattr(self, name)}")
        if not self.rounds or min(self.rounds) < 1:
            raise InvalidInputError(f"rounds must list one or more numbers above 0, got {self.rounds}")
        if not 0.0 <= self.student_share <= 1.0:
            raise InvalidInputError(f"student_share must be from 0 to 1, got {self.student_share}")
        if not 0 <= self.seed < 100:
            raise InvalidInputError(f"seed must be from 0 to 99, got {self.seed}")
