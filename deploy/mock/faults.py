"""Faults that the twin's devices can simulate, to test how the real code reacts."""

from dataclasses import dataclass
from typing import Literal

from maniskill_tomato.errors import InvalidInputError

ArmFault = Literal["silent", "slow", "nan", "jump", "drop", "stuck", "refuse"]
"""No answers; moves 20 times too slow; NaN positions; positions that jump; gone in the middle of a move; does not move;
commands refused."""

CameraFault = Literal["unplugged", "frozen", "late", "black", "zero_depth", "wrong_size", "silent"]
"""Gone; the same picture again; pictures 30 s old; black; no depth; another size than announced; no answers."""


@dataclass(frozen=True, kw_only=True)
class Faults:
    """What goes wrong, and when."""

    arm: ArmFault | None = None
    """The arm's fault."""
    arm_from_move: int = 0
    """From which command on, counted from 0."""
    camera: CameraFault | None = None
    """The camera's fault."""
    camera_from_read: int = 0
    """From which picture on, counted from 0."""
    camera_reads: int = 1_000_000
    """For how many pictures."""

    def __post_init__(self) -> None:
        for name in ("arm_from_move", "camera_from_read"):
            if getattr(self, name) < 0:
                raise InvalidInputError(f"{name} must be 0 or more, got {getattr(self, name)}")
        if self.camera_reads < 1:
            raise InvalidInputError(f"camera_reads must be at least 1, got {self.camera_reads}")
