"""`deploy run` and the loopback of LibIiwa as two processes that meet over a real socket."""

import re
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

PROFILE = """
[arm]
driver = "libiiwa"
controller = "127.0.0.1"
host = "127.0.0.1"
port = {port}
connect_timeout_s = 60.0
[camera]
driver = "{camera}"
[perception]
segmenter = "light"
"""

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]


@contextmanager
def robot(port: int) -> Iterator["subprocess.Popen[str]"]:
    """The loopback, as a person starts it beside the command."""
    command = [sys.executable, "-u", "-m", "maniskill_tomato.deploy.libiiwa", "--port", str(port)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        assert "connecting to" in process.stdout.readline()
        yield process
    finally:
        process.kill()
        process.communicate()


def deploy(tmp_path: Path, port: int, camera: str, *options: str) -> "subprocess.CompletedProcess[str]":
    profile = tmp_path / "lab.toml"
    profile.write_text(PROFILE.format(port=port, camera=camera))
    command = [sys.executable, "-m", "maniskill_tomato.cli", "deploy", "run", "--profile", str(profile)]
    command += ["--out", str(tmp_path / "out"), *options]
    return subprocess.run(command, capture_output=True, text=True, timeout=500, check=False)


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as free:
        return int(free.getsockname()[1])


def test_a_run_meets_the_robot_and_ends_in_words_when_no_camera_is_plugged_in(tmp_path: Path) -> None:
    """All that a machine without a RealSense can play: the arm connects and is let go without a single move."""
    port = free_port()
    with robot(port) as loopback:
        ended = deploy(tmp_path, port, "realsense")
        assert loopback.stdout is not None
        told = loopback.stdout.readline()
        assert loopback.poll() is None, "the robot waits for the next PC"
        assert "connecting to" in loopback.stdout.readline()
    assert ended.returncode == 2, ended.stderr
    assert "Traceback" not in ended.stderr and re.search(r"error: .*RealSense", ended.stderr), ended.stderr
    found = re.match(r"ended after (\d+) requests: (.+)", told)
    assert found is not None, told
    assert int(found[1]) >= 1, "the two have met"
    assert not (tmp_path / "out" / "result.json").exists()


def test_a_run_that_may_not_move_the_robot_does_not_even_connect(tmp_path: Path) -> None:
    port = free_port()
    with robot(port):
        ended = deploy(tmp_path, port, "realsense", "--unattended")
    assert ended.returncode == 2 and "Traceback" not in ended.stderr
    assert ended.stderr.strip().splitlines()[-1].startswith("error: ") and "calibrat" in ended.stderr
