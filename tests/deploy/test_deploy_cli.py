"""`maniskill-tomato deploy` as a user runs it."""

import json
import os
import pty
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

from maniskill_tomato.cli import deploy_commands, main, parse
from maniskill_tomato.cli.operator_prompt import goes
from maniskill_tomato.deploy.mock.mock_arm import MockArm
from maniskill_tomato.deploy.mock.mock_camera import MockCamera
from maniskill_tomato.deploy.recording import McapRecorder
from maniskill_tomato.deploy.robot_perception import ImagePerception, TruthPerception
from maniskill_tomato.deploy.stops import Stops

BLOCKED = """
import sys

class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("mani_skill", "sapien", "pyrealsense2", "torchvision", "ultralytics"):
            raise ImportError(f"{name} is not installed here")

sys.meta_path.insert(0, Blocked())
from maniskill_tomato.cli import main
words = sys.argv[1:]
cut = words.index("then")
try:
    main(words[:cut])
    main(words[cut + 1:])
finally:
    loaded = sorted(
        name for name in sys.modules
        if name.split(".")[0] in ("mani_skill", "sapien") or name.startswith(
            ("maniskill_tomato.learning.rl.agent", "maniskill_tomato.learning.rl.trainer", "maniskill_tomato.tasks.")
        )
        if name != "maniskill_tomato.tasks.registration"  # The names of the tasks, which come with the package.
    )
    print("LOADED", loaded)
"""


def test_the_twin_runs_and_inspects_without_sapien_and_maniskill(tmp_path: Path) -> None:
    """Every import of either fails in this process, and none of the simulator's modules is loaded."""
    twin = ["--profile", "mock", "--seed", "6", "--out"]
    run = ["deploy", "run", *twin, str(tmp_path / "run")]
    inspect = ["deploy", "inspect", *twin, str(tmp_path / "row"), "--max-moves", "2", "--no-record"]
    command = [sys.executable, "-c", BLOCKED, *run, "then", *inspect]
    done = subprocess.run(command, capture_output=True, text=True, timeout=500)
    assert done.returncode == 0, done.stderr
    assert "LOADED []" in done.stdout
    content = json.loads((tmp_path / "run" / "result.json").read_text())
    assert content["success"] is True and content["reason"] == "success"
    assert content["visible_fraction"] > 0.8 and content["moves"] >= 1 and content["seconds"] > 0.0
    assert (tmp_path / "run" / "report.png").stat().st_size > 10_000
    page = (tmp_path / "run" / "report.html").read_text()
    looks = len(content["steps"])
    assert (
        page.count("<img") == looks
        and f"n = {looks} looks" in page
        and not re.search(r'src="(?!data:)', page)
    )
    assert re.search(r"<code>maniskill-tomato deploy run .*?</code>", page)
    assert (tmp_path / "run" / "run.mcap").stat().st_size > 10_000
    listed = json.loads((tmp_path / "row" / "inspection.json").read_text())
    assert (listed["reason"], listed["moves"], listed["row_moves"]) == ("budget", 2, 2)
    for fruit in listed["fruits"]:
        assert {"position_m", "radius_m", "ripeness", "visible_fraction"} <= fruit.keys()


def test_sigterm_ends_a_run_in_a_defined_state(tmp_path: Path) -> None:
    profile = tmp_path / "slow.toml"
    profile.write_text(
        '[arm]\ndriver = "mock"\n[camera]\ndriver = "mock"\n[twin]\nwidth = 160\nheight = 120\nreal_time = true\n'
        '[perception]\nsegmenter = "ground_truth"\n[target]\nsource = "twin"\n[safety]\nspeed_fraction = 0.02\n'
    )
    command = [sys.executable, "-m", "maniskill_tomato.cli", "deploy", "run", "--profile", str(profile)]
    out = tmp_path / "out"
    with subprocess.Popen(
        [*command, "--seed", "9", "--out", str(out)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as running:
        recording, deadline = out / "run.mcap", time.monotonic() + 300
        while time.monotonic() < deadline and not recording.exists():
            time.sleep(0.2)
        time.sleep(2.0)
        running.send_signal(signal.SIGTERM)
        stdout, stderr = running.communicate(timeout=300)
    assert running.returncode == 128 + signal.SIGTERM, stderr
    content = json.loads((out / "result.json").read_text())
    assert (content["reason"], content["detail"], content["success"]) == ("stopped", "SIGTERM", False)
    assert "holds its position" in content["end_state"]


@pytest.mark.slow  # Compiles every kernel.
def test_the_first_run_compiles_its_kernels_before_the_heartbeat_is_watched(tmp_path: Path) -> None:
    profile = tmp_path / "hasty.toml"
    profile.write_text(
        '[arm]\ndriver = "mock"\n[camera]\ndriver = "mock"\n[twin]\nwidth = 160\nheight = 120\n'
        '[perception]\nsegmenter = "ground_truth"\n[target]\nsource = "twin"\n'
        "[loop]\nmax_moves = 3\n[stop]\nheartbeat = 3.0\n"
    )
    out, cache = tmp_path / "out", tmp_path / "empty"
    command = [sys.executable, "-m", "maniskill_tomato.cli", "deploy", "run", "--profile", str(profile)]
    done = subprocess.run(
        [*command, "--seed", "9", "--out", str(out)],
        env={**os.environ, "WARP_CACHE_PATH": str(cache)},
        capture_output=True,
        text=True,
        timeout=500,
    )
    assert done.returncode == 0, done.stderr
    assert any(cache.rglob("*.o")), "kernels were compiled into the empty folder"
    assert json.loads((out / "result.json").read_text())["reason"] in ("success", "budget")


def test_ctrl_c_while_views_of_a_calibration_are_taken_ends_it_with_its_status(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    beat = Stops.beat

    def press_and_beat(self: Stops) -> str | None:
        os.kill(os.getpid(), signal.SIGINT)
        return beat(self)

    monkeypatch.setattr(Stops, "beat", press_and_beat)
    with pytest.raises(SystemExit) as end:
        main(["deploy", "calibrate", "--profile", "mock", "--unattended", "--out", str(tmp_path)])
    assert end.value.code == 128 + signal.SIGINT
    assert "stopped (SIGINT) after 0 views; the arm stands and holds its position" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("command", "place"),
    [
        ("run", "arm"),
        ("run", "camera"),
        ("run", "warming up"),
        ("inspect", "warming up"),
        ("calibrate", "arm"),
        ("calibrate", "camera"),
    ],
)
def test_a_signal_before_the_first_look_ends_the_command_with_its_devices_let_go(
    command: str,
    place: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    opened: list[Any] = []
    pressed = threading.Event()

    def pressing(kind: Any, name: str, presses: bool) -> None:
        real = getattr(kind, name)

        def call(self: Any, *arguments: Any) -> Any:
            if name == "connect":
                opened.append(self)
            answer = real(self, *arguments)
            if presses and not pressed.is_set():
                pressed.set()
                os.kill(os.getpid(), signal.SIGTERM)
                time.sleep(60.0)  # As if a controller did not answer.
            return answer

        monkeypatch.setattr(kind, name, call)

    pressing(MockArm, "connect", place == "arm")
    pressing(MockCamera, "connect", place == "camera")
    for perception in (ImagePerception, TruthPerception):
        pressing(perception, "warm_up", place == "warming up")
    began, before = time.monotonic(), signal.getsignal(signal.SIGTERM)
    options = ["--unattended"] if command == "calibrate" else []
    with pytest.raises(SystemExit) as end:
        main(["deploy", command, "--profile", "mock", *options, "--out", str(tmp_path / "out")])
    assert end.value.code == 128 + signal.SIGTERM and time.monotonic() - began < 60.0
    assert "stopped: SIGTERM before the first look; nothing has moved" in capsys.readouterr().out
    assert len(opened) == (1 if place == "arm" else 2)
    assert not any(device.is_connected for device in opened)
    assert signal.getsignal(signal.SIGTERM) is before


def test_ctrl_c_while_the_recording_is_begun_leaves_a_file_that_is_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    begin = McapRecorder._channel

    def press_and_begin(self: McapRecorder, topic: str, encoding: str, schema_id: int) -> int:
        if topic == "/camera/color":
            os.kill(os.getpid(), signal.SIGINT)
        return begin(self, topic, encoding, schema_id)

    monkeypatch.setattr(McapRecorder, "_channel", press_and_begin)
    with pytest.raises(SystemExit) as end:
        main(["deploy", "run", "--profile", "mock", "--out", str(tmp_path)])
    assert end.value.code == 128 + signal.SIGINT
    assert "stopped: SIGINT before the first look; nothing has moved" in capsys.readouterr().out
    with (tmp_path / "run.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert {channel.topic for channel in summary.channels.values()} >= {"/info", "/step", "/camera/color"}


def test_a_fault_while_views_are_taken_tells_what_the_arm_does_then(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    profile = tmp_path / "broken.toml"
    profile.write_text(
        '[arm]\ndriver = "mock"\n[camera]\ndriver = "mock"\n'
        '[twin]\nfaults = { camera = "unplugged", camera_from_read = 0 }\n'
    )
    with pytest.raises(SystemExit) as end:
        main(
            ["deploy", "calibrate", "--profile", str(profile), "--unattended", "--out", str(tmp_path / "out")]
        )
    assert end.value.code == 3
    told = capsys.readouterr().err
    assert "the camera is gone" in told and "; the arm stands and holds its position" in told


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_at_the_prompt_ends_the_run_before_anything_moves(
    number: signal.Signals, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    master, slave = pty.openpty()
    monkeypatch.setattr(sys, "stdin", os.fdopen(slave))
    asked = threading.Event()

    def ask() -> bool:
        asked.set()
        return goes()

    def press() -> None:
        assert asked.wait(300)
        time.sleep(0.2)
        os.kill(os.getpid(), number)

    monkeypatch.setattr(deploy_commands, "goes", ask)
    threading.Thread(target=press, daemon=True).start()
    profile = tmp_path / "small.toml"
    profile.write_text(
        '[arm]\ndriver = "mock"\n[camera]\ndriver = "mock"\n[twin]\nwidth = 160\nheight = 120\n'
        '[perception]\nsegmenter = "ground_truth"\n[target]\nsource = "twin"\n'
    )
    with pytest.raises(SystemExit) as end:
        main(["deploy", "run", "--profile", str(profile), "--confirm", "--out", str(tmp_path / "out")])
    os.close(master)
    assert end.value.code == 128 + number
    content = json.loads((tmp_path / "out" / "result.json").read_text())
    assert (content["reason"], content["detail"]) == ("stopped", number.name)
    assert len({str(step["camera"]) for step in content["steps"]}) <= 1


def test_a_fault_has_its_own_exit_status(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    profile = tmp_path / "broken.toml"
    profile.write_text(
        '[arm]\ndriver = "mock"\n[camera]\ndriver = "mock"\n[twin]\nwidth = 160\nheight = 120\n'
        'faults = { camera = "unplugged", camera_from_read = 1 }\n'
        '[perception]\nsegmenter = "ground_truth"\n[target]\nsource = "twin"\n'
    )
    with pytest.raises(SystemExit) as end:
        main(["deploy", "run", "--profile", str(profile), "--seed", "9", "--out", str(tmp_path / "out")])
    assert end.value.code == 3
    captured = capsys.readouterr()
    assert captured.err.strip().endswith("error: the camera is gone; is its USB cable plugged in?")
    assert json.loads((tmp_path / "out" / "result.json").read_text())["reason"] == "not_connected"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["run", "--profile", "nothing"], "give the path of a TOML file or one of"),
        (["run", "--policy", "missing.pt"], "no policy at 'missing.pt'"),
        (["run", "--policy", ""], "no policy at ''"),
        (["run", "--policy", "oracle"], "in simulation only"),
        (["run", "--confirm", "--unattended"], "exclude each other"),
        (["run", "--seed", "-1"], "the seed must be 0 or more"),
        (
            ["run", "--out", "/dev/null/x"],
            "/dev/null is a file, so that /dev/null/x cannot be made; choose another --out",
        ),
        (["inspect", "--profile", "nothing"], "give the path of a TOML file or one of"),
        (["inspect", "--policy", "oracle"], "in simulation only"),
        (["inspect", "--dry-run", "--unattended"], "exclude each other"),
        (["inspect", "--max-moves", "0"], "--max-moves must be 1 or more, got 0"),
        (
            ["inspect", "--out", "/dev/null/x"],
            "/dev/null is a file, so that /dev/null/x cannot be made; choose another --out",
        ),
        (["calibrate", "--profile", "mock", "--out", "/dev/null/x"], "so that /dev/null/x cannot be made"),
        (["calibrate", "--views", "missing"], "--views: there is no folder missing"),
        (["profiles", "--show", "missing"], "no profile 'missing'"),
        (["replay", "/dev/null"], "RECORDING: there is no file /dev/null"),
        (["replay", "missing.mcap"], "RECORDING: there is no file missing.mcap"),
    ],
)
def test_what_cannot_begin_is_one_line_and_exit_status_2(
    arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end:
        main(["deploy", *arguments])
    assert end.value.code == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and words in error and error.count("\n") == 1


def test_profiles_are_listed_and_shown(capsys: pytest.CaptureFixture[str]) -> None:
    main(["deploy", "profiles"])
    listed = capsys.readouterr().out
    assert "mock " in listed and "iiwa14_d435" in listed
    main(["deploy", "profiles", "--show", "mock"])
    assert '[arm]\ndriver = "mock"' in capsys.readouterr().out


def test_check_looks_at_everything_and_moves_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main(["deploy", "check", "--seed", "9", "--out", str(tmp_path)])
    told = capsys.readouterr().out
    for what in (
        "profile",
        "policy",
        "calibration",
        "arm",
        "limits",
        "camera",
        "picture",
        "target",
        "decision",
    ):
        assert f"ok    {what}" in told
    assert "FAIL" not in told
    assert (tmp_path / "check.png").stat().st_size > 1000


def test_the_defaults_of_the_command_are_the_mock_profile() -> None:
    command = parse(["deploy", "run"])
    assert command.profile == "mock"
    assert os.fspath(command.out) == "runs/deploy"
