"""Text files that others wrote, as values: JSON and TOML within limits that real files stay far below."""

import json
import stat
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from maniskill_tomato.errors import InvalidInputError

LARGEST_FILE: Final = 512_000_000
"""In [bytes]."""

DEEPEST: Final = 64
"""Tables and lists within one another."""

LONGEST_INTEGER: Final = 19
"""Digits: more do not fit into 64 bits."""


def read_json(path: Path) -> Any:
    """The content of a JSON file.

    Raises:
        FileNotFoundError: There is none.
        InvalidInputError: It cannot be read, is too large, no JSON, or beyond the limits; the message says what.
    """
    return _read(path, "JSON", parse_json)


def read_toml(path: Path) -> dict[str, Any]:
    """The content of a TOML file; raises as `read_json`."""
    table: dict[str, Any] = _read(path, "TOML", parse_toml)
    return table


def parse_json(text: str) -> Any:
    """The value of a JSON text.

    Raises:
        InvalidInputError: It is no JSON, or beyond the limits.
    """
    return _parsed(lambda: json.loads(text, parse_int=_integer, object_pairs_hook=_object))


def parse_toml(text: str) -> dict[str, Any]:
    """The table of a TOML text; raises as `parse_json`."""
    table: dict[str, Any] = _parsed(lambda: tomllib.loads(text))
    return table


def _read(path: Path, what: str, parse: Callable[[str], Any]) -> Any:
    try:
        status = path.stat()
        if not (stat.S_ISREG(status.st_mode) or stat.S_ISDIR(status.st_mode)):
            # Such as a device that never ends, or a pipe in which nobody writes.
            raise InvalidInputError("it is no file")
        if (size := status.st_size) > LARGEST_FILE:
            raise InvalidInputError(f"it has {size} bytes; {LARGEST_FILE} are allowed")
        return parse(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise
    except (OSError, ValueError) as error:
        raise InvalidInputError(f"{path} cannot be read as {what}: {error}") from error


def _parsed(parse: Callable[[], Any]) -> Any:
    try:
        value = parse()
    except RecursionError:
        raise InvalidInputError(f"it is nested more than {DEEPEST} deep") from None
    except ValueError as error:
        raise InvalidInputError(str(error)) from error
    _check(value)
    return value


def _integer(text: str) -> int:
    if len(text.lstrip("-")) > LONGEST_INTEGER:
        raise ValueError(f"an integer of {len(text)} digits; {LONGEST_INTEGER} are allowed")
    return int(text)


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """A table whose keys stand once each, as TOML asks for too: of two values nobody knows which is meant."""
    table = dict(pairs)
    if len(table) < len(pairs):
        keys = [key for key, _ in pairs]
        twice = next(key for key in keys if keys.count(key) > 1)
        raise ValueError(f"the key {twice!r} stands twice in one table")
    return table


def _check(value: Any) -> None:
    level = [value]
    for _ in range(DEEPEST + 1):
        below: list[Any] = []
        for container in level:
            values = container.values() if isinstance(container, dict) else container
            if not isinstance(container, dict | list):
                values = (container,)
            for one in values:
                if isinstance(one, dict | list):
                    below.append(one)
                elif isinstance(one, int) and not -(2**63) <= one < 2**63:
                    raise InvalidInputError(
                        f"an integer beyond 64 bits; {LONGEST_INTEGER} digits are allowed"
                    )
        if not below:
            return
        level = below
    raise InvalidInputError(f"it is nested more than {DEEPEST} deep")
