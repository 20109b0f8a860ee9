"""Faults of the loopback controller, and when they occur."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

from maniskill_tomato.errors import InvalidInputError

FaultKind = Literal[
    "silent", "slow", "nak", "drop", "garbage", "partial", "endless", "nan", "jump", "contact", "swallow"
]
"""What goes wrong: `silent` never answers again; `slow` answers after `seconds`; `nak` fails in the main loop; `drop`
closes the connection after `seconds`; `garbage` sends bytes that mean nothing; `partial` a line without an end;
`endless` a line that never ends; `nan` joint angles that are no numbers; `jump` joint angles `radians` away; `contact`
pushes on joint 2 while it moves; `swallow` loses this one command."""


@dataclass(frozen=True, kw_only=True)
class Fault:
    """One thing that goes wrong."""

    kind: FaultKind
    """What happens."""
    command: str = ""
    """Beginning of the command at which it happens; empty: any."""
    count: int = 1
    """At which occurrence of that command."""
    seconds: float = 0.5
    """How late, or how long after."""
    radians: float = 0.5
    """How far a joint jumps."""

    @classmethod
    def parse(cls, text: str) -> "Fault":
        """A fault written as KIND, KIND@COMMAND or KIND@COMMAND#COUNT.

        Raises:
            InvalidInputError: The kind is unknown or the count is no number.
        """
        kind, _, rest = text.partition("@")
        command, _, count = rest.partition("#")
        if kind not in get_args(FaultKind):
            raise InvalidInputError.choice("fault", kind, get_args(FaultKind))
        if count and not (count.isdecimal() and int(count) > 0):
            raise InvalidInputError(f"the count of a fault must be a whole number above 0, got {count!r}")
        return cls(kind=kind, command=command, count=int(count or 1))  # type: ignore[arg-type]


class FaultSchedule:
    """Which fault begins with which command."""

    def __init__(self, faults: Sequence[Fault]) -> None:
        """Counts from the first command on."""
        self._faults = tuple(faults)
        self._seen = [0] * len(self._faults)

    def due(self, command: str) -> Fault | None:
        """The fault that begins with this command, if any; empty lines do not count."""
        for index, fault in enumerate(self._faults):
            if command and command.startswith(fault.command):
                self._seen[index] += 1
                if self._seen[index] == fault.count:
                    return fault
        return None
