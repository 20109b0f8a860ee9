"""What the training scripts share: options from the command line, one line for an error, how long it took."""

import json
import logging
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import tyro

from maniskill_tomato.errors import TomatoError

Options = TypeVar("Options")


def run_training(
    options: type[Options],
    train: Callable[[Options, Callable[[str], None]], Path],
    argv: list[str] | None,
    description: str | None,
) -> None:
    """Trains; errors made on purpose end with one line and exit status 2.

    Args:
        options: A dataclass of the command line's options.
        train: Given them and whom to tell a line, it returns the policy's file.
        argv: The command line; that of the process if None.
        description: Of the script.
    """
    logging.basicConfig(level=logging.WARNING, format="%(message)s", stream=sys.stderr)
    chosen = tyro.cli(options, args=argv, description=description)
    start = time.perf_counter()
    try:
        path = train(chosen, lambda line: print(line, flush=True))
    except TomatoError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    print(f"policy {path} after {time.perf_counter() - start:.0f} s")


def parse_env_options(options: Mapping[str, str]) -> dict[str, Any]:
    """Options of a task from the command line: each value as JSON where it is some, else as the text itself."""
    parsed: dict[str, Any] = {}
    for name, text in options.items():
        try:
            parsed[name] = json.loads(text)
        except json.JSONDecodeError:
            parsed[name] = text
    return parsed
