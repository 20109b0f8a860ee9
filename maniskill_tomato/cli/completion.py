"""What a shell completes after `maniskill-tomato`: every command with its options, as a script that tyro writes."""

import contextlib
import dataclasses
import io
from collections.abc import Sequence
from typing import Annotated, Any, Final, Union

import tyro

from maniskill_tomato.cli.arguments import DOCUMENTED
from maniskill_tomato.cli.command_table import COMMANDS, FAMILIES, PRINT_COMPLETION, PROGRAM, members
from maniskill_tomato.errors import InvalidInputError, did_you_mean
from maniskill_tomato.task_registry import task_ids

SHELLS: Final = ("bash", "zsh", "fish")

NOTHING_KNOWN: Final = {
    "bash": """
  if [[ -z "$completions" ]]; then
    COMPREPLY=($(compgen -W "{words}" -- "${{COMP_WORDS[COMP_CWORD]}}"))
    ((${{#COMPREPLY[@]}})) || compopt -o default
    return 0
  fi
""",
    "zsh": """
  if [[ -z "$completions" ]]; then
    compadd -- {words} || _files
    return
  fi
""",
}
"""What goes before tyro's last step: it knows options and commands, so anything else is a task or a file."""

LAST_STEP: Final = "\n  # Parse completions "
"""Where that is in tyro's scripts."""


def print_completion(argv: Sequence[str]) -> None:
    """Prints the script of a shell. It is for all commands, whichever stands before the flag.

    Args:
        argv: The arguments, the name of the shell after the flag.

    Raises:
        InvalidInputError: It names no shell, or another one.
    """
    at = next(k for k, word in enumerate(argv) if word in PRINT_COMPLETION)
    shell = "".join(argv[at + 1 : at + 2])
    if shell not in SHELLS:
        raise InvalidInputError(
            f"{argv[at]} must be followed by one of {', '.join(SHELLS)}, got {shell or 'nothing'}"
            f"{did_you_mean(shell, SHELLS)}"
        )
    written = io.StringIO()
    with (
        contextlib.suppress(SystemExit),
        contextlib.redirect_stdout(written),
    ):  # tyro ends the program after it.
        tyro.cli(
            _all_commands(),
            prog=PROGRAM,
            args=[PRINT_COMPLETION[1], shell],
            registry=DOCUMENTED,
            config=(tyro.conf.OmitSubcommandPrefixes,),
        )
    addition = NOTHING_KNOWN.get(shell, "").format(words=" ".join(task_ids()))
    print(written.getvalue().replace(LAST_STEP, addition + LAST_STEP), end="")


def _all_commands() -> Any:
    """One type for tyro: any of the commands, those of a family one word further."""
    kinds = [_named(name, name) for name in COMMANDS if " " not in name]
    for family, text in FAMILIES.items():
        choice: Any = Union[tuple(_named(name, f"{family} {name}") for name in members(family))]  # noqa: UP007
        holder = dataclasses.make_dataclass(family.replace("-", "_"), [("command", choice)])
        kinds.append(Annotated[holder, tyro.conf.subcommand(name=family, description=text)])
    return Union[tuple(kinds)]  # noqa: UP007


def _named(name: str, command: str) -> Any:
    entry = COMMANDS[command]
    return Annotated[entry.load(), tyro.conf.subcommand(name=name, description=entry.summary)]
