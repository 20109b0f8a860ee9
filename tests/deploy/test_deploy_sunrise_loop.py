"""The whole loop with the iiwa's driver over a real socket: the loopback controller's arm carries the twin's camera."""

import os
import signal
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from maniskill_tomato.deploy.decision import TASK
from maniskill_tomato.deploy.loop import Loop
from maniskill_tomato.deploy.loopback_faults import Fault
from maniskill_tomato.deploy.mock.episode import load_episode
from maniskill_tomato.deploy.mock.rehearsal import rehearsal
from maniskill_tomato.deploy.run_records import RunResult
from maniskill_tomato.deploy.stops import Stops
from maniskill_tomato.deploy.sunrise.loopback import LoopbackController
from maniskill_tomato.policies.opening import open_policy

SEED = 1


def run(
    faults: Sequence[Fault] = (),
    moves: int = 2,
    speedup: float = 1.0,
    reply_timeout_s: float = 30.0,
    kind: type[LoopbackController] = LoopbackController,
    largest_segment: float = 0.15,
) -> tuple[RunResult, LoopbackController]:
    start = load_episode("held_out", SEED).start_joints
    with kind(qpos=start.tolist(), speedup=speedup, media_flange_m=0.026, faults=faults) as controller:
        host, port = controller.address
        options: dict[str, Any] = {"host": host, "port": port, "flange_xyz": [0.0, 0.0, 0.026]}
        options |= {"reply_timeout_s": reply_timeout_s, "largest_segment": largest_segment}
        workcell = rehearsal("sunrise", options, lambda: np.array(controller.arm.qpos), SEED, moves, 0.3)
        with workcell.arm, workcell.camera, Stops() as stops:
            result = Loop(workcell, open_policy("nbv", env_id=TASK), stops, "unattended").run()
    return result, controller


def test_the_loop_moves_the_arm_over_the_socket_through_safety_and_guarded_moves() -> None:
    result, controller = run()
    assert not result.is_fault, result.detail
    assert result.reason in ("success", "budget")
    assert result.moves > result.refused_moves
    sent = [line for line in controller.received if line.startswith("doPTP")]
    assert len(sent) >= result.moves - result.refused_moves
    assert all(line.startswith("doPTP!inJS_0_") for line in sent)
    targets = [line for line in controller.received if line.startswith("jp_")]
    last = [float(token) for token in targets[-1].split("_")[1:8]]
    np.testing.assert_allclose(controller.arm.qpos, last, atol=1e-9)
    # Three tenths of the largest speed, as the envelope says.
    speeds = {line for line in controller.received if line.startswith("jRelVel")}
    assert speeds == {"jRelVel_0.300000000_"}
    assert controller.lost == []


class Ending(LoopbackController):
    """The program is told to end when the arm is at the end of a piece, before the controller says so."""

    def _move(self, windows: Sequence[tuple[int, float, float]]) -> None:
        super()._move(windows)
        os.kill(os.getpid(), signal.SIGTERM)


class Preparing(LoopbackController):
    """The program is told to end when the target is set, before the line that begins the move."""

    def _set_target(self, line: str) -> None:
        super()._set_target(line)
        os.kill(os.getpid(), signal.SIGTERM)


@pytest.mark.parametrize(("kind", "sent"), [(Ending, 1), (Preparing, 0)])
def test_a_signal_between_the_pieces_of_a_move_or_while_one_is_prepared_lets_none_out(
    kind: type[LoopbackController], sent: int
) -> None:
    result, controller = run(kind=kind, largest_segment=0.05)
    assert (result.reason, result.detail, result.is_fault) == ("stopped", "SIGTERM", False)
    assert len([line for line in controller.received if line.startswith("doPTP")]) == sent
    assert result.end_state.endswith("holds its position")


@pytest.mark.parametrize(
    ("fault", "reason", "word"),
    [
        (Fault(kind="drop", command="doPTP", seconds=0.05), "not_connected", "emergency stop"),
        (Fault(kind="jump", command="getJointsPositions", count=3, radians=0.5), "fault", "turned by"),
        (Fault(kind="contact", command="doPTP"), "fault", "touched something"),
        (Fault(kind="silent", command="doPTP"), "timeout", "emergency stop"),
        (Fault(kind="slow", command="getJointsPositions", count=4, seconds=4.0), "timeout", "answer"),
        (Fault(kind="garbage", command="getJointsPositions", count=4), "protocol", ""),
        (Fault(kind="partial", command="getJointsPositions", count=4), "timeout", ""),
        (Fault(kind="nan", command="getJointsPositions", count=4), "protocol", ""),
        (Fault(kind="nak", command="doPTP", count=2), "fault", "nak"),
    ],
)
def test_a_fault_of_the_controller_ends_the_run_with_its_reason(fault: Fault, reason: str, word: str) -> None:
    result, controller = run([fault], moves=3, reply_timeout_s=2.0 if reason == "timeout" else 30.0)
    assert result.is_fault and result.reason == reason and word in result.detail, result.detail
    if reason != "fault":
        # What is said about the arm agrees with whether a move was sent that nobody saw the end of.
        assert ("emergency stop" in result.detail) == ("may still be under way" in result.end_state)
    before = len([line for line in controller.received if line.startswith("doPTP")])
    assert before <= 2


@pytest.mark.parametrize(
    ("kind", "reason"),
    [
        ("silent", "timeout"),
        ("slow", "timeout"),
        ("garbage", "protocol"),
        ("partial", "timeout"),
        ("nan", "protocol"),
    ],
)
def test_after_a_connection_lost_in_a_move_nobody_claims_that_the_arm_stands(kind: str, reason: str) -> None:
    """The seventh reading of the joints falls into the first move."""
    fault = Fault(kind=kind, command="getJointsPositions", count=7, seconds=4.0)
    timeout = 2.0 if reason == "timeout" else 30.0
    result, controller = run([fault], moves=3, speedup=0.5, reply_timeout_s=timeout)
    assert (result.is_fault, result.reason) == (True, reason), result.detail
    assert "The arm may be in a move, which goes on" in result.detail and "emergency stop" in result.detail
    assert (
        result.end_state.startswith("a move may still be under way") and "emergency stop" in result.end_state
    )
    assert len([line for line in controller.received if line.startswith("doPTP")]) == 1
