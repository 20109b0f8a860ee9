"""Settings of a run, and the question that an operator is asked before each move."""

from dataclasses import dataclass
from typing import Literal

from maniskill_tomato.deploy.interface import Float64
from maniskill_tomato.errors import InvalidInputError

Mode = Literal["dry_run", "confirm", "unattended"]
"""Show the first move and end; ask before every move; go on alone."""


@dataclass(frozen=True, kw_only=True)
class LoopConfig:
    """When a run ends."""

    threshold: float = 0.8
    """The target is fully visible when V_f is above this."""
    max_moves: int = 20
    """Moves in which it must be."""
    lost_after: int = 12
    """Looks without any of the target in a row after which it counts as lost."""
    refused_after: int = 8
    """Refused moves in a row after which the run ends."""
    settle: float = 0.2
    """Between the end of a move and the next picture, in [s]."""

    def __post_init__(self) -> None:
        if not 0.0 < self.threshold < 1.0:
            raise InvalidInputError(f"threshold must be between 0 and 1, got {self.threshold}")
        for name in ("max_moves", "lost_after", "refused_after"):
            if getattr(self, name) < 1:
                raise InvalidInputError(f"{name} must be at least 1, got {getattr(self, name)}")
        if not 0.0 <= self.settle <= 10.0:
            raise InvalidInputError(f"settle must be from 0 to 10 s, got {self.settle}")


@dataclass(frozen=True, kw_only=True, eq=False)
class Proposal:
    """A move that a person is asked about."""

    number: int
    """How many moves there were before."""
    visible_fraction: float
    """V_f now."""
    joint_positions: Float64
    """Where the arm would go, in [rad]. Shape (7,)."""
    turn: Float64
    """How far each joint would turn, in [rad]. Shape (7,)."""
    camera_step: float
    """How far the camera would move, in [m]."""
    refusal: str | None
    """Why `safety` would refuse it, if it would."""
