"""How imitation is configured; cheap to import."""

from dataclasses import dataclass, field
from typing import Literal

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.learning.round_config import DescentConfig, RoundsConfig

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
    student_share: float = 0.9
    """Share of the later rounds' episodes that the student leads."""
    fit: ImitationFitConfig = field(default_factory=ImitationFitConfig)
    """How each round's student is fitted, always from scratch to the data of all rounds."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0.0 <= self.student_share <= 1.0:
            raise InvalidInputError(f"student_share must be from 0 to 1, got {self.student_share}")
