"""What other packages add to this one: a name in an entry point, and nothing is imported before it is asked for.

A package declares what it adds in its `pyproject.toml`:

    [project.entry-points."maniskill_tomato.policies"]
    my_search = "my_package.search:make_policy"

Wherever such a name is asked for, `package.module:attribute` works too: it names an object that can be imported, also
from the working directory.

A file is not trusted to choose what runs: a `package.module:attribute` that stands in one is loaded only if the user
named it too, at the command line or in Python.
"""

import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from pathlib import Path
from traceback import walk_tb
from typing import Any, Final

from maniskill_tomato.errors import InvalidInputError

OWN_PACKAGE: Final = "maniskill-tomato"

_loaded: set[tuple[str, str]] = set()
"""Kind and `package.module:attribute` of what this process was asked to load."""

_foreign: dict[str, str] = {}
"""What was loaded from others, in words, by the innermost package that it is in, or else its module."""


@dataclass(frozen=True)
class Extension:
    """One name of an extension point."""

    name: str
    """What a user writes."""
    target: str
    """`module:attribute` of the object."""
    origin: str
    """The distribution that adds it."""
    others: tuple[str, ...] = ()
    """Distributions that add one of the same name."""


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
        """All of them, this package's first; a name that is taken already goes to `others` of that."""
        found = {name: Extension(name, target, OWN_PACKAGE) for name, target in self.own.items()}
        others = entry_points(group=self.group)
        for entry in sorted(others, key=lambda entry: entry.name):
            if entry.name.startswith(self.prefix):
                name = entry.name.removeprefix(self.prefix)
                origin = "" if entry.dist is None else entry.dist.name
                first = found.setdefault(name, Extension(name, entry.value, origin))
                if first.origin != origin:
                    found[name] = replace(first, others=(*first.others, origin))
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
            InvalidInputError: There is no such name, two packages add one of this name, or the object cannot be
                imported.
        """
        if is_import_path(name):
            _look_in_working_directory()
            found = Extension(name, name, "")
        else:
            known = {extension.name: extension for extension in self.extensions()}
            if name not in known:
                raise InvalidInputError.choice(f"the {self.kind}", name, (*known, "package.module:attribute"))
            found = known[name]
            if found.others and found.origin != OWN_PACKAGE:
                raise InvalidInputError(
                    f"the {self.kind} {name!r} is added by {found.origin} and by {', '.join(found.others)}; give "
                    "package.module:attribute of the one that you mean, or uninstall the other"
                )
        if found.origin != OWN_PACKAGE:
            module = found.target.partition(":")[0]
            _foreign[module.rpartition(".")[0] or module] = f"the {self.kind} {name!r}"
        try:
            made = EntryPoint(name, found.target, self.group).load()
        except (ImportError, AttributeError, SyntaxError) as error:
            whose = f" of the package {found.origin}" if found.origin else ""
            raise InvalidInputError(
                f"the {self.kind} {name!r}{whose} cannot be loaded: {error}; can Python import {found.target}?"
            ) from error
        _loaded.add((self.kind, name))
        return made

    def may_load_recorded(self, name: str) -> bool:
        """Whether a name that stands in a file may be loaded.

        A module is not imported because a file names it: `package.module:attribute` may be once `load` was asked for
        it.
        """
        return not is_import_path(name) or (self.kind, name) in _loaded

    def check_recorded(self, name: str, source: object, instead: str) -> None:
        """Accepts a name that stands in a file, unless it would import a module that only the file names.

        Args:
            name: What the file says; whether there is such a name is not looked at.
            source: The file or folder, or where in it the name stands, for the message.
            instead: What the user may do beside giving it an entry point, for the message; empty if there is nothing.

        Raises:
            InvalidInputError: `may_load_recorded` is false.
        """
        if not self.may_load_recorded(name):
            way = f"{instead}, or give it" if instead else "give it"
            raise InvalidInputError(
                f"{source} names the {self.kind} {name}, a module that is not imported because a file names it; "
                f"{way} an entry point and write its name there (docs/make_it_yours.md)"
            )


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


def whose_fault(error: BaseException) -> str | None:
    """Whose code an error that nobody expected comes from: what was loaded of others, in words; None if it is ours."""
    whose = None
    for frame, _ in walk_tb(error.__traceback__):
        module = f"{frame.f_globals.get('__name__')}."
        if module.startswith(f"{__name__.partition('.')[0]}."):
            whose = None
        for package, what in _foreign.items():
            whose = what if module.startswith(f"{package}.") else whose
    return whose


def is_import_path(name: str) -> bool:
    """Whether a name has the form `package.module:attribute`."""
    module, colon, attribute = name.partition(":")
    parts = (*module.split("."), *attribute.split("."))
    return bool(colon) and all(part.isidentifier() for part in parts)
