"""Runs the commands that stand in for a controller: `python -m maniskill_tomato.deploy.DRIVER`."""

import logging
import sys
from typing import Protocol

import tyro

from maniskill_tomato.errors import TomatoError


class Rehearsal(Protocol):
    """A command whose fields are its options."""

    def run(self) -> None:
        """Goes on until Ctrl-C."""
        ...


def run_rehearsal(kind: type[Rehearsal], driver: str) -> None:
    """Reads the command line and runs the command.

    Args:
        kind: A dataclass.
        driver: The driver's folder, for the name of the command.

    Raises:
        SystemExit: 2 with one line for errors made on purpose, 0 after Ctrl-C.
    """
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    try:
        tyro.cli(kind, prog=f"python -m maniskill_tomato.deploy.{driver}").run()
    except (TomatoError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    except KeyboardInterrupt:
        raise SystemExit(0) from None
