"""The whole loop with the driver `libiiwa` over a real socket: every stop halts the move under way."""

import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from maniskill_tomato.deploy.check import check
from maniskill_tomato.deploy.decision import TASK
from maniskill_tomato.deploy.libiiwa.loopback import LoopbackRobot
from maniskill_tomato.deploy.loop import Loop
from maniskill_tomato.deploy.loopback_faults import Fault
from maniskill_tomato.deploy.mock.episode import load_episode
from maniskill_tomato.deploy.mock.rehearsal import rehearsal
from maniskill_tomato.deploy.profile import load_profile
from maniskill_tomato.deploy.profile_files import profile_path
from maniskill_tomato.deploy.run_records import KeptSteps, Recorder, RunResult, Step
from maniskill_tomato.deploy.stops import Stops
from maniskill_tomato.policies.opening import open_policy

SEED = 1


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as free:
        return int(free.getsockname()[1])


def when_it_moves(robot: LoopbackRobot, then: Callable[[], None]) -> threading.Thread:
    """Calls something a little after the first move has begun."""

    def watch() -> None:
        end = time.monotonic() + 120.0
        while not robot.arm.moves and time.monotonic() < end:
            time.sleep(0.002)
        time.sleep(0.1)
        then()

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    return thread


def run(
    faults: Sequence[Fault] = (),
    stops: dict[str, Any] | None = None,
    in_move: Callable[[], None] | None = None,
    hang: Callable[[LoopbackRobot], None] | None = None,
    moves: int = 2,
    speed_fraction: float = 0.1,
    reply_timeout_s: float = 10.0,
    recorder: Callable[[LoopbackRobot], Recorder] | None = None,
) -> tuple[RunResult, LoopbackRobot]:
    port = free_port()
    start = load_episode("held_out", SEED).start_joints
    reach = {"controller": "127.0.0.1", "host": "127.0.0.1", "port": port, "flange_xyz": [0.0, 0.0, 0.026]}
    with LoopbackRobot(
        port=port,
        qpos=start.tolist(),
        media_flange_m=0.026,
        tries_for_s=600.0,
        faults=faults,
    ) as robot:
        workcell = rehearsal(
            "libiiwa",
            {**reach, "connect_timeout_s": 600.0, "reply_timeout_s": reply_timeout_s},
            lambda: robot.arm.qpos,
            SEED,
            moves,
            speed_fraction,
        )
        listening = Stops(on_lost_heartbeat=workcell.guarded_arm.stop, **(stops or {}))
        if hang is not None:
            wait, hangs = workcell.guarded_arm.wait, [hang]

            def hang_once(timeout_s: float) -> bool:
                if hangs:
                    hangs.pop()(robot)
                return wait(timeout_s)

            workcell.guarded_arm.wait = hang_once  # type: ignore[method-assign]
        with workcell.arm, workcell.camera, listening:
            watching = when_it_moves(robot, in_move) if in_move is not None else None
            recorders = [] if recorder is None else [recorder(robot)]
            result = Loop(workcell, open_policy("nbv", env_id=TASK), listening, "unattended", recorders).run()
            if watching is not None:
                watching.join(60.0)
    return result, robot


def test_the_loop_moves_the_arm_at_a_tenth_of_its_speed_to_where_it_was_sent() -> None:
    result, robot = run()
    assert not result.is_fault, result.detail
    assert result.reason in ("success", "budget") and result.moves > result.refused_moves
    sent = [request for request in robot.received if round(request[0]) == 102]
    assert len(sent) >= result.moves - result.refused_moves
    np.testing.assert_allclose(robot.arm.qpos, sent[-1][1:], atol=1e-9)
    assert {request[1] for request in robot.received if round(request[0]) == 201} == {np.float32(0.1)}
    assert robot.cancelled_by == []


@pytest.mark.parametrize("how", ["SIGTERM", "SIGINT", "file"])
def test_a_stop_in_a_move_halts_the_arm_on_its_way(how: str, tmp_path: Path) -> None:
    stop_file = tmp_path / "STOP"

    def ask() -> None:
        if how == "file":
            stop_file.touch()
        else:
            os.kill(os.getpid(), signal.Signals[how])

    result, robot = run(stops={"stop_file": stop_file}, in_move=ask)
    assert result.reason == "stopped" and not result.is_fault, result.detail
    assert result.end_state == "the arm was stopped and holds its position"
    sent = [request for request in robot.received if round(request[0]) == 102]
    assert len(sent) == 1
    assert np.abs(robot.arm.qpos - sent[0][1:]).max() > 0.01
    assert robot.stopped_at is not None


def test_the_arm_is_halted_before_the_broken_move_is_recorded_on_a_disk_that_may_be_slow() -> None:
    halted_before: list[bool] = []

    class Disk(KeptSteps):
        def __init__(self, robot: LoopbackRobot) -> None:
            super().__init__()
            self.robot = robot

        def step(self, step: Step) -> None:
            if step.outcome == "broken off":
                halted_before.append(self.robot.stopped_at is not None)

    result, _ = run(in_move=lambda: os.kill(os.getpid(), signal.SIGTERM), recorder=Disk)
    assert result.end_state == "the arm was stopped and holds its position"
    assert halted_before == [True]


def test_a_lost_heartbeat_in_a_move_halts_the_arm_while_the_loop_still_hangs() -> None:
    """The loop hangs for much longer than the heartbeat may be missing."""
    halted: list[bool] = []

    def hang(robot: LoopbackRobot) -> None:
        time.sleep(2.5)
        halted.append(not robot.arm.moves and robot.stopped_at is not None)

    result, robot = run(stops={"heartbeat_s": 2.0}, hang=hang, speed_fraction=0.03)
    assert halted == [True]
    assert (result.reason, result.is_fault) == ("heartbeat", True), result.detail
    sent = [request for request in robot.received if round(request[0]) == 102]
    assert len(sent) == 1 and np.abs(robot.arm.qpos - sent[0][1:]).max() > 0.01


@pytest.mark.parametrize(
    ("fault", "reason", "word"),
    [
        (Fault(kind="drop", command="102", seconds=0.05), "not_connected", "emergency stop"),
        (Fault(kind="cut", command="102", seconds=0.05), "timeout", "emergency stop"),
        (Fault(kind="contact", command="102", seconds=0.05), "fault", "touched something"),
        (Fault(kind="failed", command="102", seconds=0.05), "fault", "asynchronous move failed"),
        (Fault(kind="not_ready", command="102", seconds=0.05), "fault", "enabling switch"),
        (Fault(kind="nan", command="102"), "protocol", "not finite"),
        (Fault(kind="hurry", command="102"), "fault", "does not move as planned"),
    ],
)
def test_a_fault_of_the_robot_ends_the_run_with_its_reason(fault: Fault, reason: str, word: str) -> None:
    timeout = 1.0 if reason == "timeout" else 10.0
    result, robot = run([fault], moves=3, reply_timeout_s=timeout)
    assert result.is_fault and result.reason == reason and word in result.detail, result.detail
    claims = "the arm was stopped and holds" in result.end_state or "the arm stands" in result.end_state
    # Nothing is claimed of an arm that does not answer.
    assert claims == (reason == "fault"), result.end_state
    assert len([request for request in robot.received if round(request[0]) == 102]) == 1


def test_the_check_knows_the_profile_and_says_that_a_move_can_be_stopped(tmp_path: Path) -> None:
    port = free_port()
    text = profile_path("iiwa14_libiiwa_d435").read_text()
    profile = tmp_path / "lab.toml"
    profile.write_text(
        text.replace('controller = "172.31.1.147"', 'controller = "127.0.0.1"').replace("12225", str(port))
    )
    with LoopbackRobot(port=port, tries_for_s=600.0) as robot:
        found = {finding.what: finding for finding in check(load_profile(str(profile)), "nbv", 0, None)}
        assert robot.wait(5.0)
    assert "flange_difference_mm 0.0" in found["arm"].detail
    assert found["stop"].detail == "can be stopped"
    assert found["limits"].good
    # There is no camera here.
    assert not found["device"].good and 102 not in [round(request[0]) for request in robot.received]
