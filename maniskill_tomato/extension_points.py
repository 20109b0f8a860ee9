"""What other packages add to this one: a name in an entry point, and nothing is imported before it is asked for.

A package declares what it adds in its `pyproject.toml`:

    [project.entry-points."maniskill_tomato.policies"]
    my_search = "my_package.search:make_policy"

Wherever such a name is asked for, `package.module:attribute` works too: it names an object that can be imported, also
from the working directory.
"""

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

from maniskill_tomato.errors import InvalidInputError

OWN_PACKAGE: Final = "maniskill-tomato"


@dataclass(frozen=True)
class Extension:
    """One name of an extension point."""

    name: str
    """What a user writes."""
    target: str
    """`module:attribute` of the object."""
    origin: str
    """The distribution that adds it."""


@dataclass(frozen=True)
class ExtensionPoint:
    """Objects of one kind by name: this package's own, those of other packages, and any importable one."""

    kind: str
    """What they are, in one word for messages."""
    group: str
    """Group of the entry points by which other packages add theirs."""
    own: Mapping[str, str]
    """This package's names, and `module:attribute` of each."""
    prefix: str = ""
    """What the names of others begin with in the group, where several kinds share one."""

    def extensions(self) -> tuple[Extension, ...]:
        """All of them, this package's first; a name that is taken already is not taken again."""
        found = {name: Extension(name, target, OWN_PACKAGE) for name, target in self.own.items()}
        others = entry_points(group=self.group)
        for entry in sorted(others, key=lambda entry: entry.name):
            if entry.name.startswith(self.prefix):
                name = entry.name.removeprefix(self.prefix)
                origin = "" if entry.dist is None else entry.dist.name
                found.setdefault(name, Extension(name, entry.value, origin))
        return tuple(found.values())

    def names(self) -> tuple[str, ...]:
        """All names, this package's first."""
        return tuple(extension.name for extension in self.extensions())

    def has(self, name: str) -> bool:
        """Whether a name is one of `names` or has the form `package.module:attribute`."""
        return is_import_path(name) or name in self.names()

    def load(self, name: str) -> Any:
        """The object of a name.

        Args:
            name: One of `names`, or `package.module:attribute`.

        Raises:
            InvalidInputError: There is no such name, or the object cannot be imported.
        """
        if is_import_path(name):
            _look_in_working_directory()
            found = Extension(name, name, "")
        else:
            known = {extension.name: extension for extension in self.extensions()}
            if name not in known:
                raise InvalidInputError.choice(f"the {self.kind}", name, (*known, "package.module:attribute"))
            found = known[name]
        try:
            return EntryPoint(name, found.target, self.group).load()
        except (ImportError, AttributeError) as error:
            whose = f" of the package {found.origin}" if found.origin else ""
            raise InvalidInputError(
                f"the {self.kind} {name!r}{whose} cannot be loaded: {error}; can Python import {found.target}?"
            ) from error


def source_file(import_path: str) -> Path | None:
    """The file of the module of `package.module:attribute`, which is not imported; None if there is none."""
    _look_in_working_directory()
    try:
        spec = find_spec(import_path.partition(":")[0])
    except (ImportError, ValueError):
        return None
    return None if spec is None or spec.origin is None else Path(spec.origin)


def _look_in_working_directory() -> None:
    if "" not in sys.path:
        sys.path.append("")  # Whatever it is by then.


def is_import_path(name: str) -> bool:
    """Whether a name has the form `package.module:attribute`."""
    module, colon, attribute = name.partition(":")
    parts = (*module.split("."), *attribute.split("."))
    return bool(colon) and all(part.isidentifier() for part in parts)
