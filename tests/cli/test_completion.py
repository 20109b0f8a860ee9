"""What shells complete: bash runs the script that the command prints."""

import re
import subprocess
from pathlib import Path

import pytest

from maniskill_tomato.cli import main
from maniskill_tomato.cli.command_table import COMMANDS, GROUPS
from maniskill_tomato.tasks import TASK_IDS


def script_of(shell: str, capsys: pytest.CaptureFixture[str], *before: str) -> str:
    main([*before, "--print-completion", shell])
    return capsys.readouterr().out


@pytest.fixture
def bash_script(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Path:
    path = tmp_path / "completion.bash"
    path.write_text(script_of("bash", capsys), encoding="utf-8")
    return path


def completed(script: Path, *words: str) -> list[str]:
    """What bash offers for the last of the words, as its Tab key would ask."""
    asked = (
        'source "$1"; shift\n'
        'compopt() { echo "compopt $*"; }\n'  # bash has it only while it completes.
        'COMP_WORDS=(maniskill-tomato "$@"); COMP_CWORD=$#\n'
        "[[ $(complete -p maniskill-tomato) =~ -F\\ ([^ ]+) ]]\n"
        '"${BASH_REMATCH[1]}"\n'
        'printf "%s\\n" "${COMPREPLY[@]}"\n'
    )
    result = subprocess.run(
        ["bash", "-c", asked, "bash", str(script), *words],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    assert result.stderr == ""
    return result.stdout.split()


def test_every_command_is_offered_first(bash_script: Path) -> None:
    listed = {name for names in GROUPS.values() for name in names}
    assert set(completed(bash_script, "")) == {"-h", "--help", *listed}


def test_the_second_word_of_a_family_is_offered(bash_script: Path) -> None:
    runs = {name.split()[1] for name in COMMANDS if name.startswith("deploy ")}
    assert set(completed(bash_script, "deploy", "")) == {"-h", "--help", *runs}


def test_options_and_their_choices_are_offered(bash_script: Path) -> None:
    assert completed(bash_script, "deploy", "run", "--prof") == ["--profile"]
    assert completed(bash_script, "train", "--preset", "thesis-") == ["thesis-guided", "thesis-sparse"]


def test_tasks_are_offered_where_no_option_fits_and_else_files(bash_script: Path) -> None:
    assert completed(bash_script, "train", "TomatoViewpointG") == [TASK_IDS[0]]
    assert completed(bash_script, "detect", "photos/") == ["compopt", "-o", "default"]


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_a_script_is_for_all_commands_whichever_stands_before_it(
    shell: str, capsys: pytest.CaptureFixture[str]
) -> None:
    script = script_of(shell, capsys)
    assert script == script_of(shell, capsys, "train")
    main(["--tyro-print-completion", shell])
    assert script == capsys.readouterr().out
    assert all(re.search(rf"['\"]{name.split()[-1]}['\"]", script) for name in COMMANDS)
    # The helper is called by its short name: a script for `maniskill-tomato train` would never be asked.
    assert {
        "bash": "complete -F",
        "zsh": "#compdef maniskill-tomato\n",
        "fish": "complete --no-files --command",
    }[shell] in script


@pytest.mark.parametrize(("words", "told"), [(["bsh"], "got bsh; did you mean 'bash'?"), ([], "got nothing")])
def test_another_shell_is_refused_with_those_that_there_are(
    words: list[str], told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end:
        main(["--print-completion", *words])
    assert end.value.code == 2
    assert f"must be followed by one of bash, zsh, fish, {told}" in capsys.readouterr().err
