"""The command `maniskill-tomato`; `maniskill-tomato --help` lists what it does.

Examples:
    maniskill-tomato demo
    maniskill-tomato train TomatoViewpointGuided-v1
    maniskill-tomato eval TomatoViewpointGuided-v1 --policy runs/demo/training/policy.pt --episodes 100
    maniskill-tomato deploy run --profile mock --out runs/deploy
"""

import logging
import os
import sys
import traceback
from collections.abc import Sequence
from typing import Any, NoReturn

from maniskill_tomato.cli.command_table import (
    COMMANDS,
    FAMILIES,
    PRINT_COMPLETION,
    PROGRAM,
    command_list,
    family_list,
    unknown,
)
from maniskill_tomato.cli.interruption import keyboard_interrupts
from maniskill_tomato.errors import (
    SIMULATOR_PACKAGES,
    InvalidInputError,
    MissingPackageError,
    NotWrittenError,
    SeedsFailedError,
    TomatoError,
    TrainingDivergedError,
    UnsoundEnvironmentError,
)
from maniskill_tomato.run_facts import running_command

HELP = ("-h", "--help", "help")

FAILED = 1
"""Exit status of a command that failed on its way."""

USAGE = 2
"""Exit status of a command that cannot be done as asked."""

INTERRUPTED = 130
"""Exit status after Ctrl-C, as of a shell."""

READER_GONE = 141
"""Exit status when whoever reads the output, such as `head`, has gone."""


def main(argv: Sequence[str] | None = None) -> None:
    """Runs the command; every error ends with words and an exit status."""
    logging.basicConfig(level=logging.WARNING, format="%(message)s", stream=sys.stderr)
    logging.getLogger("maniskill_tomato").setLevel(logging.INFO)
    try:
        with keyboard_interrupts():
            run(list(sys.argv[1:] if argv is None else argv))
    except TomatoError as error:
        _end(str(error), _status(error))
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
        raise SystemExit(INTERRUPTED) from None
    except BrokenPipeError:
        # What is still buffered must not fail at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(READER_GONE) from None
    except OSError as error:
        where = f": {error.filename}" if error.filename else ""
        _end(f"{error.strerror or error}{where}", FAILED)
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] in SIMULATOR_PACKAGES:
            _end(str(MissingPackageError.simulator()), USAGE)
        _end_by_fault()
    except Exception:
        _end_by_fault()


def run(argv: list[str]) -> None:
    """Runs the command, or prints the list of commands or the version.

    Raises:
        TomatoError: It cannot be run, or failed.
        SystemExit: Its arguments cannot be read, or help was asked for.
    """
    if not argv or argv[0] in HELP:
        print(command_list())
    elif argv[0] == "--version":
        from maniskill_tomato import __version__

        print(f"{PROGRAM} {__version__}")
    elif any(flag in argv for flag in PRINT_COMPLETION):
        from maniskill_tomato.cli.completion import print_completion

        print_completion(argv)
    elif argv[0] in FAMILIES and (len(argv) == 1 or argv[1] in HELP):
        print(family_list(argv[0]))
    else:
        command = parse(argv)
        try:
            if getattr(command, "out", None) is not None:
                from maniskill_tomato.cli.early_checks import check_out

                check_out(command.out, getattr(command, "writes_file", False))
            with running_command([PROGRAM, *argv]):
                command.run()
        except InvalidInputError as error:
            from maniskill_tomato.cli.arguments import with_flags

            raise InvalidInputError(with_flags(str(error), type(command))) from error


def parse(argv: Sequence[str]) -> Any:
    """The command that the arguments describe: a dataclass with a method `run`.

    Raises:
        InvalidInputError: There is no such command, or a value cannot be used.
        SystemExit: Its arguments cannot be read, or help was asked for.
    """
    words = 2 if argv[0] in FAMILIES else 1
    name, rest = " ".join(argv[:words]), argv[words:]
    if name not in COMMANDS:
        raise InvalidInputError(unknown(argv[words - 1], argv[0] if words == 2 else ""))
    kind = COMMANDS[name].load()

    from maniskill_tomato.cli.arguments import parse_arguments

    default = kind.defaults(rest) if hasattr(kind, "defaults") else None
    return parse_arguments(kind, rest, f"{PROGRAM} {name}", default)


def _status(error: TomatoError) -> int:
    """It failed on its way, or what was asked for cannot be done."""
    failed = (NotWrittenError, SeedsFailedError, TrainingDivergedError, UnsoundEnvironmentError)
    return FAILED if isinstance(error, failed) else USAGE


def _end_by_fault() -> NoReturn:
    from maniskill_tomato.extension_points import whose_fault

    traceback.print_exc()
    error = sys.exception()
    whose = None if error is None else whose_fault(error)
    if whose is not None:
        _end(f"{whose} failed, which is not of maniskill-tomato; the lines above say where", FAILED)
    _end("this is a fault of maniskill-tomato; please report it with the lines above", FAILED)


def _end(message: str, status: int) -> NoReturn:
    print(f"error: {message}", file=sys.stderr)
    raise SystemExit(status) from None
