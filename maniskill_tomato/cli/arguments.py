"""From the words of a command line to a dataclass: tyro, with plain metavars, suggestions and flags as typed.

Importing this module is cheap, and so must be the modules of the commands: PyTorch and ManiSkill take seconds to
import, so that every command imports what it needs when it runs, after its arguments are checked.
"""

import ast
import dataclasses
import inspect
import re
import shutil
import textwrap
import types
from collections.abc import Callable, Iterator, Sequence
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import tyro
from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
    StructConstructorSpec,
    StructFieldSpec,
    StructTypeInfo,
    UnsupportedTypeAnnotationError,
)

from maniskill_tomato.errors import InvalidInputError, did_you_mean

T = TypeVar("T")

NONE_WORDS = ("None", "none")
"""What takes an optional value back to none."""

Flat = tyro.conf.arg(name="")
"""`Annotated[Config, Flat]`: the options of a configuration without its name before them."""

_REGISTRY = ConstructorRegistry()

DOCUMENTED = ConstructorRegistry()
"""The sentences under fields as help, and nothing else of this module: for the completion of shells."""


class UsageError(Exception):
    """A value that a dataclass refuses; not a `ValueError`, so that tyro lets it pass."""

    def __init__(self, message: str, owner: type) -> None:
        """Keeps which dataclass refused it."""
        super().__init__(message)
        self.owner = owner


def parse_arguments(kind: type[T], argv: Sequence[str], prog: str, default: T | None = None) -> T:
    """The command of this kind that the arguments describe.

    Args:
        kind: A dataclass. A sentence under each field is its help.
        argv: The arguments after the command's name.
        prog: The command as it was typed, for messages.
        default: What holds without arguments.

    Raises:
        InvalidInputError: There is no such option, or a value cannot be used; the message names the flag.
        SystemExit: The arguments cannot be read (2), or help was asked for (0).
    """
    _check_options(kind, argv, prog)
    try:
        return tyro.cli(
            kind,
            prog=prog,
            description=_wrapped(inspect.getdoc(kind) or ""),
            args=list(argv),
            default=tyro.MISSING_NONPROP if default is None else default,
            registry=_REGISTRY,
        )
    except UsageError as error:
        raise InvalidInputError(with_flags(str(error), kind, error.owner)) from error


def with_flags(message: str, kind: type, owner: type | None = None) -> str:
    """A message that begins with the name of a field of a command, such as `n_step must`, with the flag instead.

    Args:
        message: What to say.
        kind: The command's dataclass.
        owner: The dataclass whose field it is, if known.
    """
    name = re.match(r"[a-z][a-z0-9_]*(?= must |: )", message)
    if name is None:
        return message
    for dataclass, field, flag in options_of(kind):
        if field == name.group() and owner in (None, dataclass):
            return flag + message[name.end() :]
    return message


def _check_options(kind: type, argv: Sequence[str], prog: str) -> None:
    """Refuses a mistyped option, which tyro does not mention as long as an argument is missing."""
    known = {flag for _, _, flag in options_of(kind)}
    for word in argv:
        flag = word.partition("=")[0].replace("_", "-")
        asked = flag.replace("--no-", "--", 1)
        if re.match("--[a-z]", flag) and flag != "--help" and not {flag, asked} & known:
            raise InvalidInputError(
                f"{prog} has no option {flag}{did_you_mean(flag, known)} ({prog} --help lists them)"
            )


def options_of(kind: type, prefix: str = "") -> Iterator[tuple[type, str, str]]:
    """Dataclass, field and flag of every option of a command."""
    hints = get_type_hints(kind, include_extras=True)
    for field in dataclasses.fields(kind):
        hint = hints[field.name]
        own = field.name
        for extra in getattr(hint, "__metadata__", ()):
            own = own if getattr(extra, "name", None) is None else extra.name
        inner = get_args(hint)[0] if get_origin(hint) is Annotated else hint
        words = f"{prefix}{own}".replace("_", "-")
        if isinstance(inner, type) and dataclasses.is_dataclass(inner):
            yield from options_of(inner, f"{words}." if words else "")
        else:
            yield kind, field.name, f"--{words}"


def _wrapped(text: str) -> str:
    """Paragraphs that fit the terminal, indented: lines that begin with a letter tyro would join."""
    width = min(shutil.get_terminal_size().columns, 80)
    paragraphs = (" ".join(paragraph.split()) for paragraph in text.split("\n\n"))
    return "\n".join(textwrap.indent(textwrap.fill(text, width - 2), "  ") for text in paragraphs)


@_REGISTRY.primitive_rule
def _choice(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[str] | None:
    """A word out of several; another one is answered with the nearest."""
    if get_origin(info.type) is not Literal:
        return None
    choices: tuple[str, ...] = get_args(info.type)

    def read(words: list[str]) -> str:
        if words[0] not in choices:
            raise ValueError(f"{words[0]!r} is none of {', '.join(choices)}{did_you_mean(words[0], choices)}")
        return words[0]

    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=f"{{{','.join(choices)}}}",
        instance_from_str=read,
        is_instance=lambda value: value in choices,
        str_from_instance=lambda value: [value],
    )


def _number(kind: type[int] | type[float], what: str) -> Callable[[PrimitiveTypeInfo], Any]:
    def rule(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[float] | None:
        if info.type is not kind:
            return None

        def read(words: list[str]) -> float:
            try:
                return int(words[0]) if kind is int else float(words[0])
            except ValueError:
                raise ValueError(f"{words[0]!r} is not {what}") from None

        return PrimitiveConstructorSpec(
            nargs=1,
            metavar=kind.__name__.upper(),
            instance_from_str=read,
            is_instance=lambda value: isinstance(value, kind),
            str_from_instance=lambda value: [f"{value:.12g}" if kind is float else str(value)],
        )

    return rule


_REGISTRY.primitive_rule(_number(int, "a whole number"))
_REGISTRY.primitive_rule(_number(float, "a number"))


@_REGISTRY.primitive_rule
def _optional(
    info: PrimitiveTypeInfo,
) -> PrimitiveConstructorSpec[Any] | UnsupportedTypeAnnotationError | None:
    """`T | None` reads a T; the word `none` stands for None."""
    if info.type_origin not in (Union, types.UnionType):
        return None
    others = [kind for kind in get_args(info.type) if kind is not type(None)]
    if len(others) != 1 or len(get_args(info.type)) != 2:
        return None
    spec = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(others[0], info.markers))
    if not isinstance(spec, PrimitiveConstructorSpec):
        return spec

    def read(words: list[str]) -> Any:
        return None if len(words) == 1 and words[0] in NONE_WORDS else spec.instance_from_str(words)

    return dataclasses.replace(
        spec,
        instance_from_str=read,
        is_instance=lambda value: value is None or spec.is_instance(value),
        str_from_instance=lambda value: [] if value is None else spec.str_from_instance(value),
        choices=None,
    )


@_REGISTRY.primitive_rule
def _tuple(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | UnsupportedTypeAnnotationError | None:
    """Several values of one type: as many as the annotation names, or any number."""
    kinds = get_args(info.type)
    if info.type_origin is not tuple or len(set(kinds) - {Ellipsis}) != 1:
        return None
    spec = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(kinds[0], info.markers))
    if not isinstance(spec, PrimitiveConstructorSpec):
        return spec
    many = Ellipsis in kinds
    return PrimitiveConstructorSpec(
        nargs="*" if many else len(kinds),
        metavar=f"[{spec.metavar} ...]" if many else " ".join([spec.metavar] * len(kinds)),
        instance_from_str=lambda words: tuple(spec.instance_from_str([word]) for word in words),
        is_instance=lambda value: isinstance(value, tuple) and all(map(spec.is_instance, value)),
        str_from_instance=lambda value: [spec.str_from_instance(v)[0] for v in value],
    )


@DOCUMENTED.struct_rule
@_REGISTRY.struct_rule
def _documented(info: StructTypeInfo) -> StructConstructorSpec | None:
    """A dataclass: the sentences under its fields are their help, and a default is told where there is one."""
    kind = info.type
    if not dataclasses.is_dataclass(kind) or kind.__module__.startswith(
        "tyro."
    ):  # It wraps choices of commands.
        return None
    texts = field_texts(kind)
    hints = get_type_hints(kind, include_extras=True)
    fields = []
    for field in dataclasses.fields(kind):
        default: Any = getattr(info.default, field.name, tyro.MISSING_NONPROP)
        if default is tyro.MISSING_NONPROP and field.default is not dataclasses.MISSING:
            default = field.default
        if default is tyro.MISSING_NONPROP and field.default_factory is not dataclasses.MISSING:
            default = field.default_factory()
        hint: Any = hints[field.name]
        if default is None or default == () or default == {}:
            hint = Annotated[hint, tyro.conf.arg(help_behavior_hint="")]
        elif isinstance(default, bool):
            hint = Annotated[
                hint, tyro.conf.arg(help_behavior_hint=f"(default: {'yes' if default else 'no'})")
            ]
        fields.append(StructFieldSpec(field.name, hint, default, helptext=texts.get(field.name, "")))

    def make(**values: Any) -> Any:
        try:
            return kind(**values)
        except InvalidInputError as error:
            raise UsageError(str(error), kind) from error

    return StructConstructorSpec(instantiate=make, fields=tuple(fields))


def field_texts(kind: type[Any]) -> dict[str, str]:
    """The sentences under the fields of a dataclass and its bases, on one line each."""
    texts: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        if not dataclasses.is_dataclass(base):
            continue
        try:
            source = inspect.getsource(base)
        except OSError:  # Made at run time, as those of `completion`.
            continue
        (body,) = ast.parse(textwrap.dedent(source)).body
        assert isinstance(body, ast.ClassDef)
        for line, after in zip(body.body, body.body[1:], strict=False):
            if (
                isinstance(line, ast.AnnAssign)
                and isinstance(line.target, ast.Name)
                and isinstance(after, ast.Expr)
                and isinstance(after.value, ast.Constant)
                and isinstance(after.value.value, str)
            ):
                texts[line.target.id] = " ".join(after.value.value.split())
    return texts
