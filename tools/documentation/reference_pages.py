"""Pages of the reference that are written from the code: the commands with their help, the keys of profiles."""

import contextlib
import dataclasses
import io
import os
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from documentation.pages import ROOT
from maniskill_tomato.cli import main
from maniskill_tomato.cli.arguments import field_texts
from maniskill_tomato.cli.command_table import COMMANDS, FAMILIES, GROUPS, PROGRAM, members
from maniskill_tomato.deploy.capture import CaptureConfig
from maniskill_tomato.deploy.collision import Box
from maniskill_tomato.deploy.libiiwa.libiiwa_config import LibiiwaConfig
from maniskill_tomato.deploy.mock.twin_world import Faults, TwinOptions
from maniskill_tomato.deploy.profile import PerceptionConfig, StopConfig, TargetConfig
from maniskill_tomato.deploy.profile_bounds import BOUNDS
from maniskill_tomato.deploy.profile_files import profile_names
from maniskill_tomato.deploy.realsense.realsense_config import RealSenseConfig
from maniskill_tomato.deploy.run_records import LoopConfig
from maniskill_tomato.deploy.safety_config import SafetyConfig
from maniskill_tomato.deploy.sunrise.sunrise_config import SunriseConfig

NOTE: Final = "<!-- Written by `make reference` from the code; do not edit. -->"

PROFILE_TABLES: Final[tuple[tuple[str, str, type[Any]], ...]] = (
    ("`[arm]`, driver `sunrise`", "An iiwa through the Sunrise Toolbox server.", SunriseConfig),
    ("`[arm]`, driver `libiiwa`", "An iiwa through the LibIiwa application.", LibiiwaConfig),
    ("`[camera]`, driver `realsense`", "A RealSense camera, or a recording of one.", RealSenseConfig),
    ("`[twin]`", "The simulated arm and camera, of the driver `mock`.", TwinOptions),
    ("`[twin.faults]`", "What goes wrong on the twin, to see how a run ends.", Faults),
    ("`[perception]`", "What turns pictures into views.", PerceptionConfig),
    ("`[target]`", "Which fruit to look for.", TargetConfig),
    ("`[safety]`", "What the guard lets through.", SafetyConfig),
    ("`[loop]`", "When a run ends.", LoopConfig),
    ("`[capture]`", "What pictures must be like.", CaptureConfig),
    ("`[stop]`", "Ways to stop beside Ctrl-C and SIGTERM.", StopConfig),
)
"""Heading of a table of a profile, what it is for, and the dataclass that reads it."""


def commands_page() -> str:
    """`docs/commands.md`: every command with what its `--help` prints."""
    place = "~/.local/share/bash-completion/completions"
    lines = [
        "# Commands",
        "",
        NOTE,
        "",
        *_paragraph(
            f"`{PROGRAM}` alone lists the commands, and `{PROGRAM} COMMAND --help` prints what this page has. In an "
            f"environment made by `make venv` the command is `.venv/bin/{PROGRAM}`. Options stand in any order, as "
            "`--option VALUE` or `--option=VALUE`; `--no-...` switches off what is on. The exit status is 0 when all "
            "is done, 1 when a command failed on its way, and 2 when it cannot be done as asked."
        ),
        "",
        *_paragraph(
            "The Tab key completes commands, options and tasks. For bash (with the package bash-completion) and for "
            "zsh, write the script once and open a new terminal:"
        ),
        "",
        "```bash",
        f"mkdir -p {place} ~/.zfunc",
        f".venv/bin/{PROGRAM} --print-completion bash > {place}/{PROGRAM}",
        f".venv/bin/{PROGRAM} --print-completion zsh > ~/.zfunc/_{PROGRAM}",
        "```",
        "",
        *_paragraph(
            "For zsh, `~/.zshrc` needs the line `fpath=(~/.zfunc $fpath)` before `autoload -U compinit && compinit`. "
            "`--print-completion fish` is for fish."
        ),
        "",
        "| command | what it does |",
        "|---|---|",
    ]
    ordered = [full for names in GROUPS.values() for name in names for full in _full_names(name)]
    lines += [f"| [{name}](#{name.replace(' ', '-')}) | {COMMANDS[name].summary} |" for name in ordered]
    for name in ordered:
        lines += ["", f"## {name}", "", "```text", _help(name), "```"]
    return "\n".join(lines) + "\n"


def profiles_page() -> str:
    """`docs/profiles.md`: every key of a profile with its default, its bounds and its meaning."""
    shipped = ", ".join(f"`{name}`" for name in profile_names())
    lines = [
        "# Profiles",
        "",
        NOTE,
        "",
        *_paragraph(
            "A profile is a TOML file that names the arm, the camera and the limits of a run on them: "
            f"`maniskill-tomato deploy run --profile NAME`, or the path of a file of your own. The package brings "
            f"{shipped}. `maniskill-tomato deploy profiles --show NAME` prints one, to begin your own from."
        ),
        "",
        *_paragraph(
            "Every key is checked before anything connects, and a message names the key. A number outside its bounds "
            "is refused. A number that is laxer than its default is told at the start of a run. "
            "[deploy.md](deploy.md) says what the parts do, and "
            "[why the bounds are where they are](deploy.md#how-far-a-profile-may-go)."
        ),
        "",
        *_paragraph(
            "Two more things may stand in a profile: `description`, one line about it, and the table `[calibration]`. "
            "That has `file`, which `deploy calibrate` writes, or `T_flange_camera`, the drawing of a bracket of your "
            "own as 4 x 4 numbers."
        ),
    ]
    for title, what, kind in PROFILE_TABLES:
        bounds = BOUNDS.get(title.strip("`[]"), {})
        lines += ["", f"## {title}", "", what, ""]
        lines += ["| key | default | bounds | meaning |", "|---|---|---|---|"] if bounds else []
        lines += [] if bounds else ["| key | default | meaning |", "|---|---|---|"]
        texts = field_texts(kind)
        for field in dataclasses.fields(kind):
            cells = [f"`{field.name}`", _default(field)]
            if bounds:
                bound = bounds.get(field.name)
                cells.append(f"{bound.low:g} to {bound.high:g}" if bound else "")
            lines.append(f"| {' | '.join([*cells, texts.get(field.name, '')])} |")
    return "\n".join(lines) + "\n"


PAGES: Final[dict[Path, Callable[[], str]]] = {
    ROOT / "docs" / "commands.md": commands_page,
    ROOT / "docs" / "profiles.md": profiles_page,
}
"""The files and what writes them."""


def _full_names(name: str) -> tuple[str, ...]:
    return tuple(f"{name} {member}" for member in members(name)) if name in FAMILIES else (name,)


def _paragraph(text: str) -> list[str]:
    """Lines of the width that the pages have."""
    return textwrap.wrap(text, 118, break_on_hyphens=False, break_long_words=False)


def _help(name: str) -> str:
    """What `--help` prints on a plain terminal of 80 columns."""
    before = {key: os.environ.get(key) for key in ("COLUMNS", "NO_COLOR", "FORCE_COLOR")}
    os.environ.update(COLUMNS="80", NO_COLOR="1")
    os.environ.pop("FORCE_COLOR", None)
    printed = io.StringIO()
    try:
        with contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
            main([*name.split(), "--help"])
    finally:
        for key, value in before.items():
            if value is None:
                os.environ.pop(key, None)
            else:
                os.environ[key] = value
    return "\n".join(line.rstrip() for line in printed.getvalue().splitlines()).strip()


def _default(field: "dataclasses.Field[Any]") -> str:
    if field.default is not dataclasses.MISSING:
        value = field.default
    elif field.default_factory is not dataclasses.MISSING:
        value = field.default_factory()
    else:
        return "required"
    return f"`{_toml(value)}`" if value is not None else "none"


def _toml(value: Any) -> str:
    """A default as a profile writes it."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, Box):
        return f"{{ low = {_toml(value.low)}, high = {_toml(value.high)} }}"
    if dataclasses.is_dataclass(value):
        return "{}"
    if isinstance(value, tuple):
        return f"[{', '.join(map(_toml, value))}]"
    return f"{value:g}" if isinstance(value, float) else str(value)
