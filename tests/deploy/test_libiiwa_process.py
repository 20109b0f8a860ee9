"""`deploy run` and the loopback of LibIiwa as two processes that meet over a real socket."""

import re
import socket
import struct
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


def ended_line(process: "subprocess.Popen[str]") -> tuple[int, int, str]:
    """What the loopback tells next, of a conversation that has ended: requests, those for a move, why it ended."""
    assert process.stdout is not None
    told = process.stdout.readline()
    found = re.fullmatch(r"ended after (\d+) requests, (\d+) of them for a move: (.+)\n", told)
    assert found is not None, told
    assert "connecting to" in process.stdout.readline(), "the robot waits for the next PC"
    return int(found[1]), int(found[2]), found[3]


def end_as_pc(port: int) -> None:
    """Meets the loopback in the place of the command, and ends it by a code that no driver sends."""
    with socket.create_server(("127.0.0.1", port)) as pc:
        pc.settimeout(60.0)
        peer, _ = pc.accept()
        with peer:
            peer.sendall(struct.pack(">8f", -1.0, *[0.0] * 7))
            peer.settimeout(60.0)
            assert peer.recv(1) == b""


def test_a_run_meets_the_robot_and_ends_in_words_without_a_move_when_no_camera_is_plugged_in(
    tmp_path: Path,
) -> None:
    """All that a machine without a RealSense can play: the arm connects and is let go without a single move."""
    port = free_port()
    with robot(port) as loopback:
        ended = deploy(tmp_path, port, "realsense")
        assert ended.returncode == 2, ended.stderr
        assert "Traceback" not in ended.stderr and re.search(r"error: .*RealSense", ended.stderr), (
            ended.stderr
        )
        end_as_pc(port)
        requests, moves, why = ended_line(loopback)
        assert why == "0 bytes instead of 32", "the two have met, and the command closed the connection"
        assert requests >= 1 and moves == 0
        assert ended_line(loopback) == (1, 0, "code -1.0"), "they met once"
    assert not (tmp_path / "out" / "result.json").exists()


def test_a_run_that_may_not_move_the_robot_does_not_even_connect(tmp_path: Path) -> None:
    """The first conversation of the loopback, which tries fifty times a second, is the one with this test."""
    port = free_port()
    with robot(port) as loopback:
        ended = deploy(tmp_path, port, "realsense", "--unattended")
        end_as_pc(port)
        assert ended_line(loopback) == (1, 0, "code -1.0"), "the command met the robot"
    assert ended.returncode == 2 and "Traceback" not in ended.stderr
    assert ended.stderr.strip().splitlines()[-1].startswith("error: ") and "calibrat" in ended.stderr
