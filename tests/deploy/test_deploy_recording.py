"""Recordings: what goes in comes out, full disks, and replay through today's code."""

import json
import resource
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from maniskill_tomato.cli import main
from maniskill_tomato.deploy.clock import SimulatedClock
from maniskill_tomato.deploy.deploy_errors import ProfileError, RecordingError
from maniskill_tomato.deploy.interface import Frame
from maniskill_tomato.deploy.policy_run import RunConfig, run
from maniskill_tomato.deploy.profile import Profile, load_profile, parse_profile
from maniskill_tomato.deploy.recording import McapRecorder
from maniskill_tomato.deploy.recording_reader import read_messages
from maniskill_tomato.deploy.run_records import RunResult
from maniskill_tomato.deploy.run_replay import load_recording, replay
from maniskill_tomato.deploy.workcell import make_workcell
from maniskill_tomato.errors import TomatoError
from maniskill_tomato.robot.d435 import T_flange_camera_color_optical
from maniskill_tomato.segmentation.colour_segmenter import ColourSegmenter
from maniskill_tomato.segmentation.segmenter import SEGMENTERS
from twin_profile import TWIN_PROFILE

TEXT = (
    TWIN_PROFILE
    + """
[loop]
max_moves = 4
"""
)


def profile(text: str = TEXT) -> Profile:
    return parse_profile(text, Path("recorded.toml"))


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, RunResult]:
    out = tmp_path_factory.mktemp("run")
    return out, run(RunConfig(profile=profile(), out=out, policy="nbv", seed=9))


def test_a_run_leaves_result_report_and_recording(finished: tuple[Path, RunResult]) -> None:
    out, result = finished
    content = json.loads((out / "result.json").read_text())
    assert {"success", "reason", "moves", "visible_fraction", "seconds"} <= set(content)
    assert content["success"] == result.success and content["moves"] == result.moves
    assert len(content["steps"]) == len(result.visible_fractions)
    assert content["steps"][-1]["outcome"] == result.reason
    picture: Any = cv2.imread(str(out / "report.png"))
    assert picture is not None and picture.shape[1] > 300 and picture.std() > 20.0


def test_the_recording_holds_what_the_loop_saw(finished: tuple[Path, RunResult]) -> None:
    out, result = finished
    messages = list(read_messages(out / "run.mcap"))
    topics = [topic for topic, _ in messages]
    looks = len(result.visible_fractions)
    for topic in ("/camera/color", "/camera/depth", "/camera/mask", "/joint_states", "/step", "/truth"):
        assert topics.count(topic) == looks
    assert messages[0][0] == "/info" and messages[0][1]["seed"] == 9
    assert any(topic == "/log" and "end: " in message.message for topic, message in messages)
    recorded = load_recording(out / "run.mcap")
    fractions = [step.facts["visible_fraction"] for step in recorded.steps]
    assert [round(v, 4) for v in fractions] == list(result.visible_fractions)
    frame: Frame = recorded.steps[0].frame
    assert frame.truth is not None
    seen = (frame.truth.labels == frame.truth.target_label) & (frame.depth > 0.0)
    distance = np.linalg.norm(
        frame.truth.target_position - np.array(recorded.steps[0].facts["T_world_camera"])[:3, 3]
    )
    assert seen.any() and abs(float(np.median(frame.depth[seen])) - distance) < 0.1


def test_recordings_of_the_first_format_are_replayed() -> None:
    """One that `deploy run` wrote when all messages were JSON."""
    path = Path(__file__).parent / "data" / "json_recording.mcap"
    assert dict(read_messages(path))["/info"]["format"] == "maniskill-tomato-deploy-1"
    recorded = load_recording(path)
    assert [round(step.facts["visible_fraction"], 4) for step in recorded.steps] == [0.1668, 0.2963, 0.5049]
    for step in recorded.steps:
        assert step.frame.truth is not None
        camera = np.array(step.facts["T_world_camera"])
        target = np.linalg.inv(camera) @ [*step.frame.truth.target_position, 1.0]
        shown = step.frame.depth[step.frame.truth.labels == step.frame.truth.target_label]
        assert abs(float(np.median(shown[shown > 0.0])) - target[2]) < 0.03
        red, green, _ = step.frame.color[step.frame.truth.labels == step.frame.truth.target_label].mean(0)
        assert red > green, "the target is ripe"
    assert replay(recorded).steps == 3


def test_replay_of_an_unchanged_run_differs_nowhere(finished: tuple[Path, RunResult]) -> None:
    found = replay(load_recording(finished[0] / "run.mcap"))
    assert found.differences == ()
    assert found.steps == len(finished[1].visible_fractions)
    assert found.result.reason == finished[1].reason


def test_replay_with_another_policy_or_envelope_says_where_it_differs(
    finished: tuple[Path, RunResult],
) -> None:
    recorded = load_recording(finished[0] / "run.mcap")
    found = replay(recorded, policy="random_step")
    assert {d.what for d in found.differences} >= {"action"}
    assert str(found.differences[0]).startswith("look 0: action was [")
    assert all(d.what != "visible_fraction" for d in found.differences), "the pictures are the same"


def test_no_module_is_imported_because_a_profile_or_a_recording_names_it(
    finished: tuple[Path, RunResult], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "planted_eyes.py").write_text("raise SystemExit('the module ran')\n")
    monkeypatch.chdir(tmp_path)
    words = "names the {} planted_eyes:make, a module that is not imported because a file names it"
    for old, new, kind in (
        ('segmenter = "ground_truth"', 'segmenter = "planted_eyes:make"', "segmenter"),
        ('[camera]\ndriver = "mock"', '[camera]\ndriver = "planted_eyes:make"', "driver of a camera"),
        ('[arm]\ndriver = "mock"', '[arm]\ndriver = "planted_eyes:make"', "driver of an arm"),
        ("[twin]\n", '[twin]\nmodel = "planted_eyes:make"\n', "model of an arm"),
    ):
        assert old in TEXT
        with pytest.raises(ProfileError, match=words.format(kind)):
            make_workcell(profile(TEXT.replace(old, new)))
    recorded = load_recording(finished[0] / "run.mcap")
    crafted = replace(recorded, info={**recorded.info, "policy": "planted_eyes:make"})
    with pytest.raises(RecordingError, match=f"{words.format('policy')}.*--policy planted_eyes:make"):
        replay(crafted)
    assert "planted_eyes" not in sys.modules
    assert replay(crafted, policy="nbv").differences == ()


def make_own_eyes() -> ColourSegmenter:
    return ColourSegmenter()


def test_a_program_names_a_segmenter_of_its_own_for_a_profile() -> None:
    name = f"{__name__}:make_own_eyes"
    SEGMENTERS.load(name)
    workcell = make_workcell(profile(TEXT.replace('"ground_truth"', f'"{name}"')))
    assert workcell.perception.name.endswith(name)


def test_a_disk_that_fills_up_ends_the_run_as_a_fault(tmp_path: Path) -> None:
    """The real write fails: no file of this process may grow beyond 60 kB meanwhile."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, hard))
    try:
        result = run(RunConfig(profile=profile(), out=tmp_path, policy="stay", seed=9))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert (result.reason, result.is_fault) == ("recording", True)
    assert "cannot write the recording" in result.detail
    assert result.end_state == "the arm stands and holds its position"
    assert result.moves < 4, "it ended when the disk was full, not later"
    assert json.loads((tmp_path / "result.json").read_text())["reason"] == "recording"
    with pytest.raises(RecordingError, match="cut off"):
        list(read_messages(tmp_path / "run.mcap"))


def test_a_disk_that_is_full_from_the_start_is_told_before_anything_moves() -> None:
    with pytest.raises(
        RecordingError, match=r"cannot write the recording /dev/full.*No space left.*--no-record"
    ):
        McapRecorder(Path("/dev/full"), {}, SimulatedClock(), np.array(T_flange_camera_color_optical))


def test_a_recording_that_was_cut_off_is_replayed_as_far_as_it_is_whole(
    tmp_path: Path, finished: tuple[Path, RunResult], capsys: pytest.CaptureFixture[str]
) -> None:
    """As a full disk or a lost supply leaves it, at many places: looks are whole or not there, and none differs."""
    content = (finished[0] / "run.mcap").read_bytes()
    whole = len(finished[1].visible_fractions)
    found = set()
    cut = tmp_path / "cut.mcap"
    for share in np.linspace(0.05, 0.999, 24):
        cut.write_bytes(content[: int(share * len(content))])
        try:
            recorded = load_recording(cut)
        except RecordingError as error:
            assert "it is cut off before its first" in str(error) or "no recording of" in str(error)
            found.add(0)
            continue
        assert recorded.is_cut_off or share > 0.9
        assert len(recorded.steps) <= whole
        if len(recorded.steps) not in found:
            assert replay(recorded).differences == ()
        found.add(len(recorded.steps))
    assert {1, whole} <= found and min(found) == 0
    cut.write_bytes(content[: int(0.6 * len(content))])
    main(["deploy", "replay", str(cut)])
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("the recording is cut off; its first ") and lines[1].startswith(
        "the same in all"
    )
    assert not load_recording(finished[0] / "run.mcap").is_cut_off


def test_a_recording_is_replayed_without_the_calibration_file_of_its_run(tmp_path: Path) -> None:
    mount = np.array(T_flange_camera_color_optical)
    mount[:3, 3] += [0.004, -0.003, 0.002]
    (tmp_path / "calibration.json").write_text(json.dumps({"T_flange_camera": mount.tolist()}))
    (tmp_path / "lab.toml").write_text(TEXT + '[calibration]\nfile = "calibration.json"\n')
    out = tmp_path / "elsewhere" / "out"
    run(RunConfig(profile=load_profile(str(tmp_path / "lab.toml")), out=out, policy="nbv", seed=9))
    (tmp_path / "calibration.json").unlink()
    recorded = load_recording(out / "run.mcap")
    np.testing.assert_array_equal(recorded.profile.T_flange_camera, mount)
    assert replay(recorded).differences == ()


def test_damaged_and_foreign_files_are_errors_not_tracebacks(
    tmp_path: Path, finished: tuple[Path, RunResult]
) -> None:
    content = (finished[0] / "run.mcap").read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(content[:2000])
    noise = tmp_path / "noise.mcap"
    noise.write_bytes(b"not a recording at all" * 10)
    flipped = tmp_path / "flipped.mcap"
    middle = len(content) // 3
    flipped.write_bytes(
        content[:middle] + bytes(255 - b for b in content[middle : middle + 64]) + content[middle + 64 :]
    )
    for path in (cut, noise, flipped):
        with pytest.raises(RecordingError, match=r"readable recording|no recording|no look|incomplete"):
            load_recording(path)
    with pytest.raises(RecordingError, match="no recording at"):
        load_recording(tmp_path / "missing.mcap")


def test_a_recording_with_damage_anywhere_is_an_error_or_whole(
    tmp_path: Path, finished: tuple[Path, RunResult]
) -> None:
    content = (finished[0] / "run.mcap").read_bytes()
    damaged, rng, refused = tmp_path / "damaged.mcap", np.random.default_rng(1), 0
    for _ in range(60):
        at = int(rng.integers(0, len(content) - 8))
        damaged.write_bytes(content[:at] + rng.bytes(8) + content[at + 8 :])
        try:
            load_recording(damaged)
        except TomatoError:
            refused += 1
    assert refused > 10
