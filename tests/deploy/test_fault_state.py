"""What is known at a fault is in a recording that `deploy replay` opens and explains."""

import json
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from maniskill_tomato.cli import main
from maniskill_tomato.deploy import policy_run
from maniskill_tomato.deploy.deploy_errors import RecordingError
from maniskill_tomato.deploy.fault_state import FaultState
from maniskill_tomato.deploy.guarded_arm import GuardedArm
from maniskill_tomato.deploy.mock.mock_arm import MockArm
from maniskill_tomato.deploy.policy_run import FAULT_RECORDING, RECORDING, RunConfig, run
from maniskill_tomato.deploy.profile import Profile, parse_profile
from maniskill_tomato.deploy.recording import McapRecorder
from maniskill_tomato.deploy.recording_reader import read_messages
from maniskill_tomato.deploy.recording_schemas import FAULT
from maniskill_tomato.deploy.robot_perception import ImagePerception
from maniskill_tomato.deploy.run_replay import load_recording, replay
from maniskill_tomato.policies.protocol import Planner
from maniskill_tomato.sensing.belief import Belief

TEXT = """
[arm]
driver = "mock"
[camera]
driver = "mock"
[twin]
width = 160
height = 120
{twin}
[perception]
segmenter = "ground_truth"
[target]
source = "twin"
[loop]
max_moves = 3
"""


@contextmanager
def full_disk(room: int) -> Iterator[None]:
    """No file of this process may grow beyond `room` bytes: the real write fails."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def profile(twin: str = "") -> Profile:
    return parse_profile(TEXT.format(twin=twin), Path("lab.toml"))


def faulty(out: Path, twin: str = "", **options: Any) -> Any:
    return run(RunConfig(profile=profile(twin), out=out, policy="nbv", seed=9, **options))


def told(recording: Path, capsys: pytest.CaptureFixture[str]) -> str:
    """What `deploy replay` prints of it."""
    capsys.readouterr()
    try:
        main(["deploy", "replay", str(recording)])
    except SystemExit as end:
        assert end.code == 1, "only differences end it otherwise"
    return capsys.readouterr().out


def test_an_arm_that_reports_nan_leaves_its_last_readings_its_move_and_where_it_was_noticed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    result = faulty(tmp_path, 'faults = { arm = "nan", arm_from_move = 1 }')
    assert result.is_fault and result.fault_file == RECORDING
    assert json.loads((tmp_path / "result.json").read_text())["fault_file"] == RECORDING
    recorded = load_recording(tmp_path / RECORDING)
    fault = recorded.fault
    assert fault is not None and (fault.reason, fault.detail) == (result.reason, result.detail)
    assert np.isnan(fault.arm_states[-1]["joint_positions"]).any()
    assert np.isfinite(fault.arm_states[0]["joint_positions"]).all()
    stamps = [state["stamp"] for state in fault.arm_states]
    assert stamps == sorted(stamps)
    # The move is the one that the last look sent; what cannot be true has stopped it.
    assert fault.plan is not None and not fault.plan["under_way"]
    np.testing.assert_allclose(fault.plan["goal"], recorded.steps[-1].facts["commanded"])
    assert fault.plan["speed_fraction"] == recorded.profile.safety.speed_fraction
    assert fault.memory["looks"] == len(recorded.steps) == len(result.visible_fractions)
    assert fault.memory["plant points"] > 100 and fault.memory["moves"] == result.moves
    text = told(tmp_path / RECORDING, capsys)
    assert "not finite: A" in text and "was stopped" in text and "profile lab" in text
    assert "guarded_arm.py" in text and "FaultError" in text
    assert f"in {len(recorded.steps)} looks" in text or f"all {len(recorded.steps)} looks" in text


@pytest.mark.parametrize("record", [True, False])
def test_a_fault_before_the_first_look_is_kept_and_explained(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], record: bool
) -> None:
    result = faulty(tmp_path, 'faults = { camera = "unplugged", camera_from_read = 0 }', record=record)
    assert result.reason == "not_connected" and result.visible_fractions == ()
    name = RECORDING if record else FAULT_RECORDING
    assert result.fault_file == name and (tmp_path / FAULT_RECORDING).exists() == (not record)
    recorded = load_recording(tmp_path / name)
    assert recorded.steps == () and recorded.fault is not None and recorded.fault.plan is None
    text = told(tmp_path / name, capsys)
    assert "USB cable" in text and "none had been sent" in text and "nothing to replay" in text
    with pytest.raises(RecordingError, match="nothing to replay"):
        replay(recorded)


def test_what_fails_while_things_are_warmed_up_is_kept_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(self: Any, intrinsics: Any) -> None:
        raise ZeroDivisionError("no weights")

    monkeypatch.setattr(ImagePerception, "warm_up", broken)
    with pytest.raises(ZeroDivisionError):
        faulty(tmp_path)
    text = told(tmp_path / RECORDING, capsys)
    assert "unexpected: ZeroDivisionError: no weights" in text and "before the first look" in text


class Broken(Planner):
    """Fails in its second decision, as a programming error would."""

    name = "broken"

    def __init__(self) -> None:
        self.asked = 0

    def act(self, belief: Belief) -> Tensor:
        self.asked += 1
        if self.asked > 1:
            raise KeyError("target")
        return torch.tensor([[0.2, 0.1, 0.1]])


def test_an_error_that_nobody_expected_stops_the_arm_and_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(policy_run, "open_policy", lambda *args, **kwargs: Broken())
    result = faulty(tmp_path)
    assert (result.is_fault, result.reason) == (True, "unexpected")
    assert "stands and holds" in result.end_state
    text = told(tmp_path / RECORDING, capsys)
    assert "KeyError: 'target'" in text and "Traceback" in text and "test_fault_state.py" in text


def test_a_driver_that_breaks_in_a_move_is_told_to_stop(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stopped: list[bool] = []
    stop = MockArm.stop

    def counted(self: MockArm) -> bool:
        stopped.append(True)
        return stop(self)

    def broken(self: MockArm, timeout_s: float) -> bool:
        raise AttributeError("socket")

    monkeypatch.setattr(MockArm, "stop", counted)
    monkeypatch.setattr(MockArm, "wait", broken)
    result = faulty(tmp_path)
    assert (result.is_fault, result.reason) == (True, "unexpected")
    assert stopped and "told to stop" in result.end_state or "was stopped" in result.end_state
    fault = load_recording(tmp_path / RECORDING).fault
    assert fault is not None and fault.plan is not None and fault.plan["under_way"]


def test_a_command_that_is_not_finite_is_kept_though_the_run_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What the camera saw of the plant is spoilt once."""
    command, spoilt = GuardedArm.command, [True]

    def once(self: GuardedArm, move: Any, frame_stamp: Any = None, points_w: Any = None) -> Any:
        if spoilt:
            spoilt.pop()
            points_w = np.full((20, 3), np.nan)
        return command(self, move, frame_stamp, points_w)

    monkeypatch.setattr(GuardedArm, "command", once)
    result = faulty(tmp_path)
    assert not result.is_fault and result.fault_file == RECORDING
    fault = load_recording(tmp_path / RECORDING).fault
    assert fault is not None and fault.reason == "not_finite" and "20 of the 20 points" in fault.refused


def test_on_a_full_disk_the_run_ends_in_words_and_leaves_no_half_file(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with full_disk(200_000):
        result = faulty(tmp_path)
    assert result.is_fault and result.reason == "recording"
    # The recording alone is full: the state has a small one of its own.
    assert result.fault_file == FAULT_RECORDING
    assert load_recording(tmp_path / FAULT_RECORDING).fault is not None
    with full_disk(20_000):
        result = faulty(tmp_path, 'faults = { camera = "unplugged", camera_from_read = 0 }', record=False)
    assert (result.reason, result.fault_file) == ("not_connected", "")
    assert not (tmp_path / FAULT_RECORDING).exists()
    assert "the state at the fault is lost" in caplog.text and "free some space" in caplog.text


def test_a_recording_that_cannot_be_finished_does_not_claim_to_hold_the_fault(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk fills up with the very last message."""
    finish = McapRecorder.fault

    def filled(self: Any, fault: FaultState) -> None:
        with full_disk(self.path.stat().st_size + 10):
            finish(self, fault)

    monkeypatch.setattr(McapRecorder, "fault", filled)
    result = faulty(tmp_path, 'faults = { camera = "unplugged", camera_from_read = 3 }')
    assert result.reason == "not_connected" and result.fault_file == ""
    assert not (tmp_path / FAULT_RECORDING).exists()
    assert len(load_recording(tmp_path / RECORDING).steps) >= 1


def test_the_fault_of_an_earlier_run_in_the_folder_goes(tmp_path: Path) -> None:
    faulty(tmp_path, 'faults = { camera = "unplugged", camera_from_read = 0 }', record=False)
    assert (tmp_path / FAULT_RECORDING).exists()
    result = faulty(tmp_path, record=False)
    assert result.fault is None and not (tmp_path / FAULT_RECORDING).exists()
    assert "fault" not in json.loads((tmp_path / "result.json").read_text())


def test_a_fault_reads_back_as_it_was_and_nonsense_in_its_place_is_refused() -> None:
    joints = [0.1, float("nan"), float("inf"), -float("inf"), 0.0, 1e308, -0.5]
    fault = FaultState(
        reason="fault",
        detail="a jump",
        stamp=12.5,
        arm_states=({"stamp": 12.0, "joint_positions": joints, "joint_velocities": [0.0] * 7},),
        plan={
            "start": [0.0] * 7,
            "goal": [0.1] * 7,
            "speed_fraction": 0.1,
            "seconds": 2.0,
            "sent": 11.0,
            "under_way": True,
            "worst": {"off_path": 0.3},
        },
        refused="workspace: too far",
        stop="SIGTERM",
        memory={"looks": 3},
        traceback="Traceback",
    )
    content = json.loads(json.dumps(fault.to_json(), allow_nan=False))
    again = FaultState.from_json(content)
    np.testing.assert_array_equal(again.arm_states[0]["joint_positions"], joints)
    assert again.plan == fault.plan and again.memory == fault.memory and again.stop == fault.stop
    for name in content:
        if content[name] is None or isinstance(content[name], str):
            continue
        with pytest.raises((KeyError, TypeError, ValueError, AttributeError)):
            FaultState.from_json({**content, name: ["nonsense"]})
        with pytest.raises((KeyError, TypeError, ValueError, AttributeError)):
            FaultState.from_json({key: value for key, value in content.items() if key != name})


def test_a_fault_keeps_to_its_schema(tmp_path: Path) -> None:
    faulty(tmp_path, 'faults = { arm = "nan", arm_from_move = 0 }')
    message = next(content for topic, content in read_messages(tmp_path / RECORDING) if topic == "/fault")
    assert follows(message, FAULT) and "nan" in json.dumps(message["arm_states"])
    assert not follows({**message, "memory": {"looks": "three"}}, FAULT)
    assert not follows({name: value for name, value in message.items() if name != "plan"}, FAULT)


def follows(value: Any, schema: dict[str, Any]) -> bool:
    """Whether a value is what a JSON Schema of ours describes."""
    if "anyOf" in schema:
        return any(follows(value, one) for one in schema["anyOf"])
    if "enum" in schema:
        return value in schema["enum"]
    kind = schema["type"]
    if kind == "array":
        return isinstance(value, list) and all(follows(one, schema["items"]) for one in value)
    if kind == "object":
        others = schema.get("additionalProperties")
        known = schema.get("properties", {})
        return (
            isinstance(value, dict)
            and set(schema.get("required", ())) <= set(value)
            and all(follows(one, known.get(name, others)) for name, one in value.items())
        )
    kinds: dict[str, Any] = {"number": int | float, "integer": int, "string": str, "boolean": bool}
    return value is None if kind == "null" else isinstance(value, kinds[kind])


def test_the_fault_is_the_last_message_of_a_recording(tmp_path: Path) -> None:
    faulty(tmp_path, 'faults = { camera = "unplugged", camera_from_read = 1 }')
    assert [topic for topic, _ in read_messages(tmp_path / RECORDING)][-1] == "/fault"
