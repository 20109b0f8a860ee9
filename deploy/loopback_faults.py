"""What goes wrong at a loopback controller, and at which command."""

from collections.abc import Sequence
from dataclasses import dataclass

from maniskill_tomato.errors import InvalidInputError


@dataclass(frozen=True, kw_only=True)
class Fault:
    """One thing that goes wrong."""

    kind: str
    """What happens: a word that the controller knows."""
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
            InvalidInputError: The count is no number.
        """
        kind, _, rest = text.partition("@")
        command, _, count = rest.partition("#")
        if count and not (count.isdecimal() and int(count) > 0):
            raise InvalidInputError(f"the count of a fault must be a whole number above 0, got {count!r}")
        return cls(kind=kind, command=command, count=int(count or 1))


class FaultSchedule:
    """Which fault begins with which command."""

    def __init__(self, faults: Sequence[Fault], kinds: Sequence[str]) -> None:
        """Counts from the first command on.

        Args:
            faults: What goes wrong.
            kinds: The words that the controller knows.

        Raises:
            InvalidInputError: It does not know one of the faults.
        """
        for fault in faults:
            if fault.kind not in kinds:
                raise InvalidInputError.choice("fault", fault.kind, kinds)
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
