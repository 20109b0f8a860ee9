"""Pages of the reference that say what the code is: written from it, or with tables that agree with it."""

import math
import re
from pathlib import Path
from typing import get_args

import pytest
from documentation.pages import ROOT
from documentation.reference_pages import PAGES

from maniskill_tomato.cli.command_table import COMMANDS
from maniskill_tomato.deploy.profile import load_profile
from maniskill_tomato.deploy.profile_files import profile_names, profile_path
from maniskill_tomato.sensing.observation import ObservationLayout
from maniskill_tomato.sensing.perception_kinds import Part
from maniskill_tomato.tasks import TASK_IDS
from maniskill_tomato.tasks.vector_env import make_vector_env
from maniskill_tomato.text_files import parse_toml


def table_rows(page: Path, first: str) -> dict[str, list[str]]:
    """The rows of the table whose first heading is given, by their first cell without the code's backticks."""
    lines = page.read_text(encoding="utf-8").splitlines()
    start = next(k for k, line in enumerate(lines) if line.startswith(f"| {first} |"))
    rows = {}
    for line in lines[start + 2 :]:
        if not line.startswith("|"):
            break
        cells = [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]]
        rows[cells[0].strip("`")] = cells[1:]
    return rows


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_a_page_that_is_written_from_the_code_is_up_to_date(page: Path) -> None:
    assert page.read_text(encoding="utf-8") == PAGES[page](), "run `make reference` and commit what it writes"


def test_the_page_of_commands_has_the_help_of_each() -> None:
    text = (ROOT / "docs" / "commands.md").read_text(encoding="utf-8")
    assert [name for name in COMMANDS if f"\nusage: maniskill-tomato {name} [-h]" not in text] == []


@pytest.mark.parametrize("name", profile_names())
def test_every_key_of_a_profile_that_ships_is_on_the_page_of_profiles(name: str) -> None:
    load_profile(name)
    text = (ROOT / "docs" / "profiles.md").read_text(encoding="utf-8")
    named = set(re.findall(r"^\| `(\w+)` \|", text, re.MULTILINE)) | {"driver", "file", "T_flange_camera"}
    tables = parse_toml(profile_path(name).read_text(encoding="utf-8"))
    unknown = {
        f"{table}.{key}"
        for table, content in tables.items()
        if isinstance(content, dict)
        for key in content
        if key not in named
    }
    assert unknown == set()


@pytest.mark.parametrize("env_id", TASK_IDS)
def test_the_table_of_tasks_has_the_sizes_of_the_environments(env_id: str) -> None:
    env = make_vector_env(env_id, num_envs=1)
    observed, action, moves = table_rows(ROOT / "docs" / "tasks.md", "task")[env_id][1:4]
    assert observed.split()[0] == str(env.single_observation_space.shape[0])  # type: ignore[index]
    assert action.split()[0] == str(env.single_action_space.shape[0])  # type: ignore[index]
    assert moves.split()[0] == str(env.max_steps)


def test_the_table_of_the_observation_has_its_parts_in_order_with_their_sizes() -> None:
    rows = table_rows(ROOT / "docs" / "observation.md", "part")
    told = {part: math.prod(map(int, cells[0].split(" x "))) for part, cells in rows.items()}
    slices = ObservationLayout(parts=get_args(Part)).slices
    assert told == {part: where.stop - where.start for part, where in slices.items()}
    usual = ObservationLayout()
    assert [part for part in told if part in usual.parts] == list(usual.parts)
    assert f"{usual.size} numbers by default" in (ROOT / "docs" / "observation.md").read_text(
        encoding="utf-8"
    )
