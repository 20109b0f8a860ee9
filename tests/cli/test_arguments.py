"""What is said of every command before anything heavy loads: lists, help, version, errors and exit status."""

import json
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Annotated, Literal, get_type_hints

import pytest

from maniskill_tomato import __version__
from maniskill_tomato.cli import main
from maniskill_tomato.cli.arguments import Flat, field_texts, options_of, parse_arguments, with_flags
from maniskill_tomato.cli.command_table import COMMANDS, FAMILIES, GROUPS, members
from maniskill_tomato.cli.early_checks import check_out
from maniskill_tomato.cli.shared_options import parse_env_options, tell_policy
from maniskill_tomato.errors import InvalidInputError, NotWrittenError, RenderingUnavailableError

ROOT = Path(__file__).resolve().parents[2]
HEAVY = ("torch", "mani_skill", "sapien", "warp", "matplotlib", "onnxruntime", "mujoco", "scipy")
GUIDED, GENERAL = "TomatoViewpointGuided-v1", "TomatoViewpoint-v1"


def light_run(*lines: tuple[str, ...]) -> list[tuple[int, str, list[str]]]:
    """Runs command lines in one new process: exit status, what was said, and which heavy libraries are loaded."""
    program = (
        "import contextlib, io, json, sys\n"
        "from maniskill_tomato.cli import main\n"
        f"for line in json.loads({json.dumps(json.dumps(lines))}):\n"
        "    said, status = io.StringIO(), 0\n"
        "    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):\n"
        "        try:\n            main(line)\n"
        "        except SystemExit as end:\n            status = end.code\n"
        f"    heavy = [name for name in {HEAVY} if name in sys.modules]\n"
        "    print(json.dumps([status, said.getvalue(), heavy]))\n"
    )
    environment = {"PYTHONPATH": str(ROOT), "COLUMNS": "80", "PATH": ""}
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, cwd=ROOT, env=environment, check=True
    )
    return [tuple(json.loads(line)) for line in done.stdout.splitlines()]


def plain(text: str) -> str:
    """The words of a message without the box around them and its line breaks."""
    return " ".join(re.sub(r"[│╭╮╰╯─]", " ", text).split())


ERRORS: dict[str, tuple[tuple[str, ...], str]] = {
    "command": (("trian", GUIDED), "maniskill-tomato has no command 'trian'"),
    "command of a family": (("deploy", "rnu"), "maniskill-tomato deploy has no command 'rnu'"),
    "flag": (("train", GUIDED, "--gama", "0.9"), "error: maniskill-tomato train has no option --gama"),
    "flag beside an argument that is missing": (("eval", "--polcy", "x"), "eval has no option --polcy"),
    "value that is missing": (("train", GUIDED, "--out"), "Missing value for argument '--out'"),
    "argument that is missing": (("detect",), "IMAGE_OR_FOLDER"),
    "task": (("train", "TomatoViewpointGuide-v1"), "ENV_ID must be one of 'TomatoViewpointGuided-v1'"),
    "task to evaluate": (("eval", "TomatoViewpoint-v2"), "ENV_ID must be one of"),
    "preset": (("train", GUIDED, "--preset", "td"), "--preset: 'td' is none of td3"),
    "whole number": (("eval", GUIDED, "--episodes", "x"), "--episodes: 'x' is not a whole number"),
    "number": (("train", GUIDED, "--value-range", "1", "y"), "--value-range: 'y' is not a number"),
    "too few numbers": (("eval", GUIDED, "--plant-pose", "1", "2"), "'--plant-pose'. Expected 3 values"),
    "range": (("train", GUIDED, "--gamma", "2"), "error: --gamma must be in [0, 1), got 2.0"),
    "range of a nested option": (
        ("train-view-quality", "--fit.steps", "0"),
        "error: --fit.steps must be 1 or more",
    ),
    "count": (("eval", GUIDED, "--episodes", "0"), "error: --episodes must be 1 or more, got 0"),
    "seeds": (("train", GUIDED, "--seeds", "4..0"), "error: --seeds must be"),
    "split": (
        ("eval", GUIDED, "--plant-seed", "trian"),
        "error: --plant-seed must be a number or one of train",
    ),
    "plant": (("eval", GUIDED, "--plant", "oak"), "--plant must be one of 'one_tomato'"),
    "policy's file": (("eval", GUIDED, "--policy", "no.pt"), "error: --policy: no policy at 'no.pt'"),
    "planner": (("eval", GENERAL, "--policy", "nvb"), "--policy: no policy at '"),
    "policy to export": (("export", "--policy", "no.pt"), "error: --policy: there is no file no.pt"),
    "run to go on with": (("train", "--resume", "nowhere"), "error: nowhere holds no run to continue"),
    "file of options": (("train", "--config", "no.toml"), "error: no configuration file at no.toml"),
    "no task": (("train",), "error: give the task to train on"),
    "profile": (("deploy", "run", "--profile", "mok"), "error: --profile: no profile 'mok'"),
    "policy of a robot": (
        ("deploy", "check", "--policy", "oracl"),
        "error: --policy: no policy at '",
    ),
    "recording": (("deploy", "replay", "no.mcap"), "error: RECORDING: there is no file no.mcap"),
    "views": (("deploy", "calibrate", "--views", "no"), "error: --views: there is no folder no"),
    "images": (("detect", "no.jpg"), "error: IMAGE_OR_FOLDER: there is no image or folder no.jpg"),
    "segmenter": (("detect", ".", "--segmenter", "lihgt"), "error: --segmenter must be one of"),
    "annotated images": (
        ("train-segmenter", "light", "--data", "no:train"),
        "error: --data: there is no folder no",
    ),
    "weights": (
        ("train-segmenter", "light", "--data", ".", "--start-from", "no.pt"),
        "error: --start-from: there",
    ),
    "photos": (("dataset", "--real", "no"), "error: --real: there is no folder no"),
    "rendered images": (("judge", "occlusion", "--data", "no"), "error: --data: there is no folder no"),
    "student": (("train-imitation", "--student", "aktor"), "--student: 'aktor' is none of actor, recurrent"),
    "seeds of PPO": (
        ("train-ppo", GUIDED, "--out", "x", "--seeds", "1", "1"),
        "error: --seeds must be one or more",
    ),
    "demonstrations": (
        ("demonstrations", "--policy", "orakle"),
        "error: --policy: no policy at 'orakle'",
    ),
    "demonstrations of a planner without a belief": (
        ("demonstrations", GUIDED, "--policy", "nbv"),
        "error: --policy: nbv plans on a belief",
    ),
    "demonstrations to learn from": (
        ("train", GUIDED, "--reward-from", "no.h5"),
        "error: --reward-from: there is no file no.h5",
    ),
    "hindsight without the task's word": (
        ("train", GUIDED, "--reward-from", "no.h5", "--hindsight-targets", "2"),
        "error: --hindsight-targets must be 0 beside",
    ),
    "policy beside another": (
        ("eval", GENERAL, "--beside", "lattice_oracle,nbw"),
        "error: --beside: no policy at 'nbw'",
    ),
    "policy of a benchmark": (
        ("benchmark", "--policies", "nbv,oracel"),
        "error: --policies: no policy at 'oracel'",
    ),
    "file of a policy": (
        ("benchmark", "--policies", "mine=no.pt"),
        "error: --policies: no policy at 'no.pt'",
    ),
    "list of an evaluation": (
        ("eval", GENERAL, "--episode-list", "mine.json"),
        "error: --episode-list must be one of 'validation', 'held_out', 'FILE.json'; got 'mine.json'",
    ),
    "list of episodes": (("benchmark", "--episode-list", "heldout"), "error: --episode-list must be one of"),
    "rows": (("benchmark-rows", "--rows", "0"), "error: --rows must be 1 or more, got 0"),
    "split of rows": (("benchmark-rows", "--split", "test"), "error: --split must be one of"),
    "runs to compare": (("compare", "no"), "error: RUN: there is no folder no"),
    "file instead of a run": (("compare", "Makefile"), "error: RUN must be a folder, and Makefile is a file"),
    "folder instead of a file": (
        ("export", "--policy", "docs"),
        "error: --policy must be a file, and docs is a folder",
    ),
    "no runs": (("compare",), "error: give one run folder or more"),
    "experiment": (("reproduce", "guidet"), "'guidet' is none of guided, sparse"),
    "variant": (("reproduce", "guided", "--variant", "small-action"), "small-action"),
    "variant of the learner": (("ablate", "--variants", "n-step"), "n-step"),
    "task of an ablation": (("ablate", "--env-ids", "Tomato"), "error: --env-ids must be one of"),
    "twin": (("judge", "twin", "--profile", "mok"), "error: --profile: no profile 'mok'"),
    "folder of an evaluation": (
        ("eval", GUIDED, "--out", "Makefile"),
        "error: Makefile is a file; choose another",
    ),
    "file of a list": (("detect", ".", "--out", "docs"), "error: --out must be a file, and docs is a folder"),
    "minutes": (("demo", "--minutes", "0"), "error: --minutes must be above 0"),
}
"""Command lines that cannot be done as asked, and what is said."""

SUGGESTIONS = {
    "command": "did you mean 'train'?",
    "command of a family": "did you mean 'run'?",
    "flag": "did you mean '--gamma'?",
    "flag beside an argument that is missing": "did you mean '--policy'?",
    "task": "did you mean 'TomatoViewpointGuided-v1'?",
    "preset": "did you mean 'td3'?",
    "split": "did you mean 'train'?",
    "planner": "did you mean 'nbv'?",
    "profile": "did you mean 'mock'?",
    "segmenter": "did you mean 'light'?",
    "student": "did you mean 'actor'?",
    "policy of a benchmark": "did you mean 'oracle'?",
    "list of episodes": "did you mean 'held_out'?",
    "experiment": "did you mean 'guided'?",
    "demonstrations": "did you mean 'oracle'?",
}
"""What is offered instead of a mistyped word."""


@pytest.mark.parametrize(
    ("out", "is_file", "words"),
    [
        ("file", False, "file is a file; choose another --out"),
        ("file/run", False, "file is a file, so that {out} cannot be made; choose another --out"),
        ("file/list.json", True, "file is a file, so that {out} cannot be made"),
        ("folder", True, "--out must be a file, and {out} is a folder"),
        ("/proc/self/run", False, "cannot write to /proc/self: it may only be read; choose another --out"),
    ],
)
def test_a_place_where_results_cannot_be_written_is_refused(
    out: str, is_file: bool, words: str, tmp_path: Path
) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "folder").mkdir()
    with pytest.raises(InvalidInputError) as refused:
        check_out(tmp_path / out, is_file)
    assert words.format(out=tmp_path / out) in str(refused.value)


def test_a_place_for_results_that_can_be_made_is_accepted(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for out, is_file in (("a/b/c", False), (".", False), ("a/list.json", True), ("file", True)):
        check_out(tmp_path / out, is_file)


@pytest.fixture(scope="module")
def errors() -> dict[str, tuple[int, str, list[str]]]:
    """What each line of `ERRORS` ends with."""
    return dict(zip(ERRORS, light_run(*(line for line, _ in ERRORS.values())), strict=True))


@pytest.mark.parametrize("name", ERRORS)
def test_a_mistake_is_named_with_its_flag_before_anything_heavy_loads(
    name: str, errors: dict[str, tuple[int, str, list[str]]]
) -> None:
    status, said, heavy = errors[name]
    assert (status, heavy) == (2, [])
    assert ERRORS[name][1] in plain(said)
    assert "Traceback" not in said and "tyro" not in said and "<class" not in said
    assert SUGGESTIONS.get(name, "") in plain(said)


def test_what_is_shown_of_commands_is_narrow_and_loads_nothing_heavy() -> None:
    lists = [(), ("--help",), ("--version",), *((family,) for family in FAMILIES)]
    helps = [(*name.split(), "--help") for name in COMMANDS]
    for line, (status, said, heavy) in zip([*lists, *helps], light_run(*lists, *helps), strict=True):
        assert (status, heavy) == (0, []), line
        after_usage = said.splitlines()[1:]  # tyro does not wrap the line of the usage.
        assert max(map(len, after_usage), default=0) <= 80, line
        assert "None" not in said and "{None}" not in said and "tyro" not in said, line
        if line in helps:
            assert said.startswith(f"usage: maniskill-tomato {' '.join(line[:-1])} "), line


def test_every_option_is_suggested_for_its_name_without_the_last_letter() -> None:
    lines, names = [], []
    for name, entry in COMMANDS.items():
        flags = {flag for _, _, flag in options_of(entry.load())}
        for flag in sorted(flags):
            if flag[:-1] not in flags and len(flag) > 5:
                lines.append((*name.split(), flag[:-1]))
                names.append(flag)
    assert len(lines) > 200
    for line, flag, (status, said, _) in zip(lines, names, light_run(*lines), strict=True):
        assert status == 2 and f"has no option {flag[:-1]}; did you mean '{flag}'?" in said, (line, said)


def test_the_list_shows_every_command_once(capsys: pytest.CaptureFixture[str]) -> None:
    main([])
    said = capsys.readouterr().out
    listed = [name for names in GROUPS.values() for name in names]
    assert sorted(listed) == sorted({name.split()[0] for name in COMMANDS})
    assert re.findall(r"^  (\S+)  +\S", said, flags=re.M) == listed
    for family in FAMILIES:
        main([family])
        assert re.findall(r"^  (\S+)  +\S", capsys.readouterr().out, flags=re.M) == list(members(family))


@pytest.mark.parametrize("name", COMMANDS)
def test_every_option_says_what_it_is_for(name: str) -> None:
    kind = COMMANDS[name].load()
    assert kind.__doc__ and callable(kind.run)
    said = field_texts(kind)
    in_type = {
        name
        for name, hint in get_type_hints(kind, include_extras=True).items()
        if any(getattr(part, "help", None) for part in getattr(hint, "__metadata__", ()))
    }
    assert [f.name for f in fields(kind) if f.name not in said and f.name not in in_type] == []


def test_the_version_is_that_of_the_package(capsys: pytest.CaptureFixture[str]) -> None:
    main(["--version"])
    assert capsys.readouterr().out == f"maniskill-tomato {__version__}\n"


@pytest.mark.parametrize(
    ("error", "status", "said"),
    [
        (
            InvalidInputError("episodes must be 1 or more, got 0"),
            2,
            "error: --episodes must be 1 or more, got 0\n",
        ),
        (RenderingUnavailableError("no Vulkan device"), 2, "error: no Vulkan device\n"),
        (NotWrittenError("cannot write x: no space"), 1, "error: cannot write x: no space\n"),
        (PermissionError(13, "Permission denied", "runs"), 1, "error: Permission denied: runs\n"),
        (KeyboardInterrupt(), 130, "stopped\n"),
    ],
)
def test_the_exit_status_tells_usage_from_failure(
    error: BaseException,
    status: int,
    said: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def fail(self: object) -> None:
        raise error

    monkeypatch.setattr(COMMANDS["demo"].load(), "run", fail)
    with pytest.raises(SystemExit) as end:
        main(["demo"])
    assert (end.value.code, capsys.readouterr().err) == (status, said)


def test_a_fault_of_the_program_is_called_one(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(self: object) -> None:
        raise KeyError("nothing")

    monkeypatch.setattr(COMMANDS["demo"].load(), "run", fail)
    with pytest.raises(SystemExit) as end:
        main(["demo"])
    said = capsys.readouterr().err
    assert end.value.code == 1
    assert "KeyError: 'nothing'" in said and said.splitlines()[-1].startswith("error: this is a fault of")


# ------------------------------------------------------------ arguments to dataclasses


@dataclass(frozen=True, kw_only=True)
class Inner:
    """A part."""

    steps: int = 3
    """How many."""
    size: tuple[float, float] = (1.0, 2.0)
    """Width and height, in [m]."""

    def __post_init__(self) -> None:
        if self.steps < 1:
            raise InvalidInputError(f"steps must be 1 or more, got {self.steps}")


@dataclass(frozen=True, kw_only=True)
class Outer:
    """A command."""

    kind: Literal["red", "green"] = "red"
    """Which
    colour."""
    limit: float | None = 0.5
    """At most."""
    words: tuple[str, ...] = ()
    """Some."""
    fast: bool = False
    """Hurry."""
    options: dict[str, str] = field(default_factory=dict)
    """Names and values."""
    flat: Annotated[Inner, Flat] = Inner()
    """Without a prefix."""
    inner: Inner = Inner(steps=5)
    """With one."""


def test_a_command_line_fills_a_dataclass_and_its_parts() -> None:
    line = "--kind green --limit none --words a b --fast --options n 1 m x --steps 7 --inner.size 3 4e-1"
    assert parse_arguments(Outer, line.split(), "prog") == Outer(
        kind="green",
        limit=None,
        words=("a", "b"),
        fast=True,
        options={"n": "1", "m": "x"},
        flat=Inner(steps=7),
        inner=Inner(steps=5, size=(3.0, 0.4)),
    )
    assert parse_arguments(Outer, [], "prog") == Outer()
    assert parse_arguments(Outer, ["--no-fast"], "prog", Outer(fast=True, limit=2.0)) == Outer(limit=2.0)


def test_help_has_sentences_units_and_defaults(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        parse_arguments(Outer, ["--help"], "prog")
    said = plain(capsys.readouterr().out)
    assert "--kind {red,green} Which colour. (default: red)" in said
    assert "--limit FLOAT At most. (default: 0.5)" in said
    assert "--words [STR ...] Some. --fast" in said
    assert "--fast, --no-fast Hurry. (default: no)" in said
    assert "--steps INT How many. (default: 3)" in said
    assert "--inner.steps INT How many. (default: 5)" in said
    assert "--inner.size FLOAT FLOAT Width and height, in [m]. (default: 1 2)" in said


def test_messages_name_the_flag_of_the_part_that_refuses() -> None:
    for flag in ("--steps", "--inner.steps"):
        with pytest.raises(InvalidInputError, match=r"^--(inner\.)?steps must be 1 or more, got 0$"):
            parse_arguments(Outer, [flag, "0"], "prog")
    assert with_flags("limit must be positive", Outer) == "--limit must be positive"
    assert with_flags("the limit must be positive", Outer) == "the limit must be positive"
    assert with_flags("nothing must be positive", Outer) == "nothing must be positive"


def test_options_of_the_task_are_read_from_words() -> None:
    texts = {"perception": "occlusion_model", "contact_penalty": "0.5", "plant": '{"pool": 3}'}
    options = parse_env_options(texts)
    assert options == {"perception": "occlusion_model", "contact_penalty": 0.5, "plant": {"pool": 3}}


def test_a_training_tells_its_lines_and_where_the_policy_is(capsys: pytest.CaptureFixture[str]) -> None:
    def train(report: Callable[[str], None]) -> Path:
        report("begun")
        return Path("there/policy.pt")

    tell_policy(train)
    assert re.fullmatch(r"begun\npolicy there/policy\.pt after \d+ s\n", capsys.readouterr().out)
