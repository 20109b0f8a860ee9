"""Why a command does not go out: which limit, by how much it would be passed, and the nearest that is allowed."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Final, Literal

Reason = Literal[
    "not_finite",
    "speed",
    "joint_limit",
    "joint_step",
    "stale_state",
    "stale_frame",
    "workspace",
    "forbidden_zone",
    "flange_step",
    "self_collision",
    "table",
    "obstacle",
    "plant",
]

COLLISIONS: Final[tuple[Reason, ...]] = ("self_collision", "table", "obstacle", "plant")
"""Those that another way to the same posture may avoid."""


def words(text: str) -> Callable[[], str]:
    """Words that need no working out."""
    return lambda: text


@dataclass(frozen=True, kw_only=True)
class Refusal:
    """Why a command does not go out."""

    reason: Reason
    """Which check speaks against it."""
    detail: str
    """Which limit, what the command would make of it, and by how much that is too far."""
    nearest: Callable[[], str] = words("")
    """The nearest that is allowed, in words; worked out when it is asked for, because planners only ask whether a
    command may go out."""

    @cached_property
    def told(self) -> str:
        """All of it."""
        return "; ".join(filter(None, (f"{self.reason}: {self.detail}", self.nearest())))

    def __str__(self) -> str:
        return self.told
