"""Reads tables of TOML and JSON files into frozen dataclasses. Errors name the key."""

import math
import types
from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from maniskill_tomato.errors import InvalidInputError, did_you_mean

T = TypeVar("T")


def read_table(kind: type[T], table: Mapping[str, Any], where: str | Path) -> T:
    """The dataclass `kind` with the values of a table; fields that it does not name keep their defaults.

    Values may be booleans, numbers, strings, `Literal`s, tuples of them (arrays in TOML), dictionaries, other
    dataclasses (tables), each also `| None`. Numbers must be finite; an integer will do for a float, and a float
    without decimals for an integer.

    Args:
        kind: A dataclass.
        table: What was read.
        where: The file, or the name of the table in it, such as `safety` or `profile.toml: arm`, for messages.

    Raises:
        InvalidInputError: A key is unknown or missing, or its value is of another kind or refused by the dataclass.
    """
    assert is_dataclass(kind)
    inside = f"{where}: " if isinstance(where, Path) else f"{where}."
    hints = get_type_hints(kind)
    known = {field.name: field for field in fields(kind)}
    for key in table:
        if key not in known:
            raise InvalidInputError(
                f"{inside}{key} is unknown; {where} may have {', '.join(sorted(known))}{did_you_mean(key, known)}"
            )
    values: dict[str, Any] = {}
    for name, field in known.items():
        if name in table:
            values[name] = _value(hints[name], table[name], inside + name)
        elif field.default is MISSING and field.default_factory is MISSING:
            raise InvalidInputError(f"{inside}{name} is missing")
    try:
        return kind(**values)
    except InvalidInputError as error:
        raise InvalidInputError(f"{where}: {error}") from error


def _value(kind: Any, value: Any, where: str) -> Any:
    origin = get_origin(kind)
    if origin in (Union, types.UnionType):
        inner = [k for k in get_args(kind) if k is not types.NoneType]
        if value is None:
            return None
        if len(inner) == 1:
            return _value(inner[0], value, where)
        for k in inner:
            try:
                return _value(k, value, where)
            except InvalidInputError:
                continue
        raise InvalidInputError(f"{where} must be one of {', '.join(map(_name, inner))}; got {value!r}")
    if origin is Literal:
        if value not in get_args(kind):
            raise InvalidInputError.choice(where, value, get_args(kind))
        return value
    if origin is tuple:
        return _tuple(get_args(kind), value, where)
    if is_dataclass(kind):
        if not isinstance(value, Mapping):
            raise InvalidInputError(f"{where} must be a table; got {value!r}")
        return read_table(kind if isinstance(kind, type) else type(kind), value, where)
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if kind is float and is_number and math.isfinite(value):
        return float(value)
    if kind is int and is_number and value == value // 1:
        return int(value)
    if kind in (bool, str) and isinstance(value, kind):
        return value
    if origin is dict and isinstance(value, Mapping):
        return dict(value)
    raise InvalidInputError(f"{where} must be {_name(kind)}; got {value!r}")


def _tuple(kinds: tuple[Any, ...], value: Any, where: str) -> tuple[Any, ...]:
    if not isinstance(value, list | tuple):
        raise InvalidInputError(f"{where} must be an array; got {value!r}")
    if len(kinds) == 2 and kinds[1] is Ellipsis:
        kinds = (kinds[0],) * len(value)
    if len(value) != len(kinds):
        raise InvalidInputError(f"{where} must have {len(kinds)} entries; got {len(value)}")
    return tuple(_value(k, v, f"{where}[{i}]") for i, (k, v) in enumerate(zip(kinds, value, strict=True)))


def _name(kind: Any) -> str:
    names = {float: "a finite number", int: "a whole number", bool: "true or false", str: "a string"}
    return names.get(kind, "a table" if get_origin(kind) is dict else str(kind))
