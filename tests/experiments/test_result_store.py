"""The store of results: what survives a crash, and what it refuses."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.experiments.result_store import ResultStore


def test_results_come_back_by_part_name_and_number(tmp_path: Path) -> None:
    store = ResultStore(tmp_path, {"env_id": "x"})
    store.add("held_out", "nbv", {4: {"moves": 2}, 2: {"moves": 5}})
    store.add("held_out", "runs/a b.pt", {2: {"moves": 7}})
    assert list(store.read("held_out", "nbv")) == [2, 4]
    assert store.read("held_out", "runs/a b.pt") == {2: {"moves": 7}}
    assert store.read("validation", "nbv") == {}
    store.add("held_out", "nbv", {4: {"moves": 3}})
    assert store.read("held_out", "nbv")[4] == {"moves": 3}


def test_the_store_goes_on_after_a_line_was_cut_short(tmp_path: Path) -> None:
    ResultStore(tmp_path, {"env_id": "x"}, {"nbv": "a"}).add("held_out", "nbv", {4: {"a": 1}, 2: {"a": 2}})
    (path,) = tmp_path.rglob("nbv.jsonl")
    whole = path.read_bytes()
    path.write_bytes(whole + whole[:13])
    again = ResultStore(tmp_path, {"env_id": "x"}, {"nbv": "a", "oracle": "b"})
    assert list(again.read("held_out", "nbv")) == [2, 4]
    assert again.missing("held_out", "nbv", range(6)) == [0, 1, 3, 5]
    again.add("held_out", "nbv", {3: {"a": 3}})
    assert again.read("held_out", "nbv") == {2: {"a": 2}, 3: {"a": 3}, 4: {"a": 1}}


def test_every_result_that_was_added_is_there_after_sigkill(tmp_path: Path) -> None:
    script = (
        "import itertools, sys\n"
        "from pathlib import Path\n"
        "from maniskill_tomato.experiments.result_store import ResultStore\n"
        "store = ResultStore(Path(sys.argv[1]), {'env_id': 'x'})\n"
        "for number in itertools.count():\n"
        "    store.add('part', 'name', {number: {'text': 'long ' * 1000}})\n"
        "    print(number, flush=True)\n"
    )
    command = [sys.executable, "-c", script, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as writer:
        assert writer.stdout is not None
        for line in writer.stdout:
            if int(line) >= 20:
                break
        writer.send_signal(signal.SIGKILL)
        last = max([20, *(int(line) for line in writer.stdout if line.endswith("\n"))])
    store = ResultStore(tmp_path, {"env_id": "x"})
    assert store.missing("part", "name", range(last + 1)) == []
    store.add("part", "name", {10_000: {"text": "after"}})
    assert store.read("part", "name")[10_000] == {"text": "after"}


def test_a_folder_of_another_experiment_or_policy_is_refused(tmp_path: Path) -> None:
    ResultStore(tmp_path, {"env_id": "x", "config": {"size": (3, 4)}}, {"policy mine": "a"})
    ResultStore(tmp_path, {"env_id": "x", "config": {"size": (3, 4)}}, {"policy mine": "a"})
    with pytest.raises(InvalidInputError, match=r"another experiment \(env_id differ\)"):
        ResultStore(tmp_path, {"env_id": "y", "config": {"size": (3, 4)}})
    with pytest.raises(InvalidInputError, match=r"another experiment \(policy mine differ\)"):
        ResultStore(tmp_path, {"env_id": "x", "config": {"size": (3, 4)}}, {"policy mine": "b"})


def test_settings_that_cannot_be_read_are_refused(tmp_path: Path) -> None:
    for text in ('{"settings"', '{"settings": {}}', "[]"):
        (tmp_path / "settings.json").write_text(text)
        with pytest.raises(InvalidInputError, match="does not describe an experiment"):
            ResultStore(tmp_path, {})
