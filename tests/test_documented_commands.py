"""The commands that the documentation names: each is one that the command line reads."""

import re
import shlex
from pathlib import Path

import pytest

from maniskill_tomato.cli import parse
from maniskill_tomato.cli.command_table import COMMANDS, FAMILIES

ROOT = Path(__file__).resolve().parent.parent
PAGES = [*sorted((ROOT / "docs").rglob("*.md")), ROOT / "README.md", ROOT / "CONTRIBUTING.md"]
NOT_PARSED = ("--resume", "--config", "--print-completion")
"""Options whose file is read with the command line, and the one that comes without a command."""


def commands_of(page: Path) -> list[str]:
    """The lines of code on a page that call the command, with what their backslashes join."""
    text = re.sub(r"\\\n\s*", "", page.read_text(encoding="utf-8"))
    lines = re.findall(r"^(?:    )?(?:\w+=\S+ )*(?:\.venv/bin/)?maniskill-tomato (.*)$", text, re.MULTILINE)
    return [re.sub(r"\s+[#>|&].*$", "", line) for line in lines]


@pytest.mark.skipif(not (ROOT / "pyproject.toml").is_file(), reason="the tests run outside a checkout")
@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_command_of_a_page_can_be_read(page: Path) -> None:
    for line in commands_of(page):
        words = shlex.split(line)
        if any(flag in words for flag in NOT_PARSED) or words[-1] in ("--help", "--version"):
            continue
        assert parse(words) is not None, line


@pytest.mark.skipif(not (ROOT / "pyproject.toml").is_file(), reason="the tests run outside a checkout")
@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_and_scripts_named_in_sentences_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for name in re.findall(r"`maniskill-tomato ([a-z][\w-]*)", text):
        assert name in COMMANDS or name in FAMILIES, name
    for path in re.findall(r"\b((?:scripts|tools|examples)/\w+\.(?:py|sh))\b", text):
        assert (ROOT / path).is_file(), path


@pytest.mark.skipif(not (ROOT / "pyproject.toml").is_file(), reason="the tests run outside a checkout")
@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_options_of_commands_named_in_sentences_exist(page: Path) -> None:
    helps = (ROOT / "docs" / "commands.md").read_text(encoding="utf-8")
    sections = dict(re.findall(r"^## ([\w -]+)\n(.*?)(?=^## |\Z)", helps, re.MULTILINE | re.DOTALL))
    names = "|".join(sorted(COMMANDS, key=len, reverse=True))
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    wrong = [
        f"{name} {flag}"
        for name, rest in re.findall(rf"`(?:maniskill-tomato )?({names})((?: [^`]*)?)`", text)
        for flag in re.findall(r"--[a-z][\w.-]*", rest)
        if not re.search(rf"{re.escape(flag)}(?![\w-])", sections[name])
    ]
    assert wrong == []
