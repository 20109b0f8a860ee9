"""What the commands that move an arm have in common at the terminal: their modes, their question, their end."""

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final, cast

from maniskill_tomato.errors import InvalidInputError

if TYPE_CHECKING:
    from maniskill_tomato.deploy.run_records import Mode

FAULT_STATUS: Final = 3
"""Exit status of a run that a fault ended, and of a check that something does not pass."""


def one_mode(**asked: bool) -> "Mode | None":
    """The one flag that was given, or none.

    Raises:
        InvalidInputError: There are several, or `confirm` has no terminal to ask at.
    """
    given = [name for name, wanted in asked.items() if wanted]
    if len(given) > 1:
        flags = " and ".join(f"--{name.replace('_', '-')}" for name in given)
        raise InvalidInputError(f"{flags} exclude each other; give one")
    if "confirm" in given and not sys.stdin.isatty():
        raise InvalidInputError("--confirm asks before every move and needs a terminal")
    return cast("Mode", given[0]) if given else None


def goes() -> bool:
    """Waits for a yes or a no; without a terminal it is a no."""
    try:
        return input("go? [y/N] ").strip().lower() in ("y", "yes")
    except EOFError:
        return False


@contextmanager
def stopped_early() -> Iterator[None]:
    """Ends with the exit status of a signal that came before a run's first look."""
    from maniskill_tomato.deploy.deploy_errors import StoppedError

    try:
        yield
    except StoppedError as error:
        print(f"stopped: {error} before the first look; nothing has moved")
        end_by_signal(str(error))
        raise


def end_by_signal(reason: str | None) -> None:
    """Ends with the exit status of a signal if that is what stopped a run; `reason` is its name."""
    if reason is not None and reason in signal.Signals.__members__:
        raise SystemExit(128 + signal.Signals[reason])
