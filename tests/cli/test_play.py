"""`maniskill-tomato play` on the command line: it serves, ends at a signal, and refuses what cannot be."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest

COMMAND = [sys.executable, "-m", "maniskill_tomato.cli", "play"]


def run(*arguments: str) -> "subprocess.CompletedProcess[str]":
    return subprocess.run([*COMMAND, *arguments], capture_output=True, text=True, timeout=300)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["TomatoViewpoint"], "did you mean 'TomatoViewpoint-v1'"),
        (["--policy", "nvb"], "did you mean 'nbv'"),
        (["TomatoViewpointGuided-v1", "--policy", "nbv"], "nbv plans on a belief"),
        (["--perception", "segmenter"], "--perception must be one of"),
        (["--target", "any"], "give --perception as well"),
        (["--seed", "-1"], "--seed must be from 0"),
        (["--port", "70000"], "--port must be from 0 to 65535"),
        (["--episode-list", "heldout"], "did you mean 'held_out'"),
        (["TomatoViewpointRow-v1", "--episode-list", "held_out"], "--episode-list is for TomatoViewpoint-v1"),
        (["--export", "page.txt"], "--export must name an .html file"),
        (["--demonstrations", "shown", "--export", "page.html"], "leave out --export"),
        (["--demonstrations", "shown", "--record", "runs"], "leave out --record"),
        (["TomatoViewpointRow-v1", "--demonstrations", "shown"], "ENV_ID must be one of"),
    ],
)
def test_what_cannot_be_played_is_refused_before_torch_loads(arguments: list[str], message: str) -> None:
    code = (
        "import sys\nfrom maniskill_tomato.cli import main\n"
        "try:\n    main(['play', *sys.argv[1:]])\nfinally:\n    assert 'torch' not in sys.modules"
    )
    result = subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, timeout=300
    )
    assert result.returncode == 2, result.stderr
    assert message in result.stderr and "Traceback" not in result.stderr


def test_a_folder_of_other_demonstrations_is_refused_before_torch_loads(tmp_path: Path) -> None:
    about = {"env_info": {"env_id": "maniskill_tomato:TomatoViewpointGuided-v1"}, "episodes": []}
    (tmp_path / "trajectory.json").write_text(json.dumps(about))
    (tmp_path / "trajectory.h5").write_bytes(b"")
    arguments = ["TomatoViewpointSparse-v1", "--demonstrations", str(tmp_path), "--port", "0"]
    test_what_cannot_be_played_is_refused_before_torch_loads(arguments, "choose another folder")


def test_a_port_that_is_taken_is_refused() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        result = run("--port", str(taken.getsockname()[1]))
    assert result.returncode == 2
    assert "choose another --port" in result.stderr and "Traceback" not in result.stderr


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_page_is_served_on_this_machine_alone_until_a_signal_comes(number: signal.Signals) -> None:
    command = [*COMMAND, "TomatoViewpointGuided-v1", "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None and process.stderr is not None
            line = process.stdout.readline()
            address = re.search(r"http://127\.0\.0\.1:\d+", line)
            assert address is not None, line + process.stderr.read()
            with urllib.request.urlopen(address.group(), timeout=60) as answer:
                assert b"<html" in answer.read(2000)
            os.kill(process.pid, number)
            assert process.wait(60) == 0
            assert process.stderr.read() == ""
        finally:
            process.kill()


def test_an_episode_is_written_as_one_file(tmp_path: Path) -> None:
    path = tmp_path / "new" / "page.html"
    result = run("TomatoViewpointGuided-v1", "--export", str(path))
    assert result.returncode == 0, result.stderr
    assert "fully visible after" in result.stdout and f"page    {path}" in result.stdout
    assert path.read_text(encoding="utf-8").count("__VISER_EMBED_DATA__=") == 1
    assert list(path.parent.iterdir()) == [path]
