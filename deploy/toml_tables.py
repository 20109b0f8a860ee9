"""Tables of a profile as dataclasses."""

from collections.abc import Mapping
from typing import Any, TypeVar

from maniskill_tomato.deploy.deploy_errors import ProfileError
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.tables import read_table

T = TypeVar("T")


def parse_table(kind: type[T], table: Mapping[str, Any], where: str) -> T:
    """The same as `read_table`.

    Raises:
        ProfileError: A key is unknown or missing, or its value is of another kind or refused by the dataclass.
    """
    try:
        return read_table(kind, table, where)
    except InvalidInputError as error:
        raise ProfileError(str(error)) from error
