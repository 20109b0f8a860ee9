"""The driver `libiiwa` over a real socket: against the loopback robot, its hazards and its faults, and by hand."""

import math
import os
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from maniskill_tomato.deploy.clock import MonotonicClock
from maniskill_tomato.deploy.deploy_errors import (
    DeployError,
    DeviceTimeoutError,
    FaultError,
    NotConnectedError,
    ProfileError,
    ProtocolError,
    RefusedError,
)
from maniskill_tomato.deploy.drivers import DriverContext, make_arm, make_camera
from maniskill_tomato.deploy.interface import Arm, JointMove
from maniskill_tomato.deploy.libiiwa.loopback import LoopbackRobot
from maniskill_tomato.deploy.libiiwa.messages import Code, Messages
from maniskill_tomato.deploy.libiiwa.robot_connection import RobotConnection
from maniskill_tomato.deploy.loopback_faults import Fault
from maniskill_tomato.deploy.profile import load_profile
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.robot.iiwa14 import JOINT_UPPER, VELOCITY_LIMITS

START = np.array([0.0, 0.35, 0.0, -1.2, 0.0, 1.5, 0.0])
NEAR = START + np.array([0.05, -0.03, 0.02, 0.06, 0.0, -0.04, 0.08])
FAR = START + np.array([0.9, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
PATIENT: dict[str, Any] = {"connect_timeout_s": 30.0, "reply_timeout_s": 10.0, "move_margin_s": 30.0}
"""No deadline passes where none should, however busy the machine is."""
HASTY: dict[str, Any] = {"reply_timeout_s": 0.3, "move_margin_s": 0.3}
"""Deadlines that tests wait for."""


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as free:
        return int(free.getsockname()[1])


def driver(port: int, **options: Any) -> Arm:
    loopback = {"controller": "127.0.0.1", "host": "127.0.0.1", "port": port}
    return make_arm("libiiwa", {**loopback, **PATIENT, **options}, DriverContext(clock=MonotonicClock()))


@contextmanager
def met(robot: dict[str, Any] | None = None, **options: Any) -> Iterator[tuple[LoopbackRobot, Arm]]:
    """A robot and a driver that are connected."""
    port = free_port()
    with LoopbackRobot(port=port, qpos=START.tolist(), tries_for_s=30.0, **(robot or {})) as application:
        with driver(port, **options) as arm:
            yield application, arm


@contextmanager
def waiting(**options: Any) -> Iterator[tuple[int, list[BaseException | None]]]:
    """A driver that waits for a robot in another thread: its port, and afterwards how `connect` ended."""
    port, ended = free_port(), list[BaseException | None]()
    arm = driver(port, **options)

    def connect() -> None:
        try:
            arm.connect()
            ended.append(None)
        except DeployError as error:
            ended.append(error)

    thread = threading.Thread(target=connect, daemon=True)
    thread.start()
    yield port, ended
    thread.join(30.0)
    arm.disconnect()


def dial(port: int) -> socket.socket:
    end = time.monotonic() + 30.0
    while True:
        try:
            return socket.create_connection(("127.0.0.1", port))
        except OSError:
            assert time.monotonic() < end
            time.sleep(0.01)


def move_to(joints: np.ndarray, speed: float = 0.2) -> JointMove:
    return JointMove(joint_positions=joints, speed_fraction=speed)


def finish(arm: Arm, seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not arm.wait(0.1):
        assert time.monotonic() < end, "the move does not end"


def begin(arm: Arm, robot: LoopbackRobot, speed: float = 0.05) -> None:
    """Sends the arm to `FAR` and waits until it is on its way."""
    arm.command(move_to(FAR, speed))
    end = time.monotonic() + 30.0
    while abs(robot.arm.qpos[0]) < 1e-3:
        assert time.monotonic() < end, "the move does not begin"
        time.sleep(0.002)


def stands(robot: LoopbackRobot) -> bool:
    """Whether it comes to rest within a second, short of where it was sent."""
    end = time.monotonic() + 1.0
    while robot.arm.moves and time.monotonic() < end:
        time.sleep(0.002)
    return not robot.arm.moves and 0.0 < robot.arm.qpos[0] < 0.25


def codes(robot: LoopbackRobot) -> list[int]:
    return [round(request[0]) for request in robot.received]


def test_a_move_ends_where_it_was_asked_to_at_the_speed_that_was_asked_for() -> None:
    with met(robot={"speedup": 4.0}) as (robot, arm):
        sent = arm.command(move_to(NEAR))
        finish(arm)
        np.testing.assert_allclose(robot.arm.qpos, NEAR, atol=1e-6)
        np.testing.assert_allclose(sent.joint_positions, NEAR, atol=1e-6)
        np.testing.assert_allclose(arm.read().joint_positions, NEAR, atol=1e-6)
        assert arm.wait(0.0)
    assert robot.cancelled_by == []


@pytest.mark.parametrize("double_precision", [False, True])
def test_what_is_returned_is_what_the_robot_got(double_precision: bool) -> None:
    options = {"double_precision": double_precision}
    with met(robot={"speedup": 4.0, **options}, **options) as (robot, arm):
        sent = arm.command(move_to(NEAR))
        finish(arm)
        np.testing.assert_array_equal(robot.arm.qpos, sent.joint_positions)
        assert (np.abs(sent.joint_positions - NEAR).max() == 0.0) == double_precision


def test_before_every_move_speed_and_acceleration_are_set_since_the_robot_begins_with_all_of_both() -> None:
    with met(robot={"speedup": 4.0}, acceleration_fraction=0.25) as (robot, arm):
        arm.command(move_to(NEAR, 0.2))
        finish(arm)
        arm.command(move_to(START, 0.1))
        finish(arm)
    limits = {201: 1.0, 202: 1.0}
    moved_at = []
    for request in robot.received:
        if round(request[0]) in limits:
            limits[round(request[0])] = request[1]
        if round(request[0]) == 102:
            moved_at.append((limits[201], limits[202]))
            limits = {201: 1.0, 202: 1.0}
    np.testing.assert_allclose(moved_at, [(0.2, 0.25), (0.1, 0.25)], atol=1e-6)


def test_a_move_takes_as_long_as_its_speed_says() -> None:
    with met() as (robot, arm):
        began = time.monotonic()
        arm.command(move_to(START + np.array([0.1, 0, 0, 0, 0, 0, 0]), 0.2))
        fastest = 0.0
        while not arm.wait(0.02):
            fastest = max(fastest, float(np.abs(robot.arm.qvel).max()))
        assert time.monotonic() - began > 0.1 / (0.2 * VELOCITY_LIMITS[0])
        assert fastest == pytest.approx(0.2 * VELOCITY_LIMITS[0], rel=0.02)


def test_a_long_move_goes_in_pieces_on_one_line() -> None:
    with met(robot={"speedup": 4.0}, largest_segment=0.3) as (robot, arm):
        target = START + np.array([0.7, -0.1, 0.0, 0.35, 0.0, 0.0, 0.0])
        arm.command(move_to(target))
        finish(arm)
        np.testing.assert_allclose(robot.arm.qpos, target, atol=1e-6)
    sent = [np.array(request[1:]) for request in robot.received if round(request[0]) == 102]
    for k, joints in enumerate(sent, start=1):
        np.testing.assert_allclose(joints, START + (target - START) * k / 3, atol=1e-6)
    assert len(sent) == 3


# A stop that stops.


def test_a_stop_halts_the_move_under_way() -> None:
    with met() as (robot, arm):
        begin(arm, robot)
        assert arm.stop() is True
        assert stands(robot)
        finish(arm)
        assert np.abs(arm.read().joint_velocities).max() < 1e-3
        with pytest.raises(RefusedError, match="told to stop"):
            arm.command(move_to(START))
    assert codes(robot).count(102) == 1


def test_a_stop_from_another_thread_halts_the_move_while_it_is_waited_for() -> None:
    with met() as (robot, arm):
        begin(arm, robot)
        stopped = list[bool]()
        thread = threading.Thread(target=lambda: stopped.append(arm.stop()))
        thread.start()
        finish(arm, 5.0)
        thread.join()
        assert stopped == [True] and stands(robot)


def test_no_move_follows_a_stop_that_comes_while_the_next_piece_is_prepared() -> None:
    """The stop arrives between the settings of a piece and its move: the move stays unsent."""
    with met(robot={"speedup": 4.0}) as (robot, arm):
        client: Any = arm._client  # type: ignore[attr-defined]
        setting = client.set

        def set_and_stop(code: Code, *others: Any) -> None:
            setting(code, *others)
            if code == Code.JERK:
                threading.Thread(target=arm.stop).start()
                time.sleep(0.1)

        client.set = set_and_stop
        with pytest.raises(RefusedError, match="told to stop"):
            arm.command(move_to(NEAR))
        assert 102 not in codes(robot)
        np.testing.assert_array_equal(robot.arm.qpos, START)


def test_disconnecting_cancels_the_move() -> None:
    with met() as (robot, arm):
        begin(arm, robot)
        arm.disconnect()
        assert stands(robot) and robot.over


@pytest.mark.slow  # A process of its own imports everything anew.
def test_killing_the_program_cancels_the_move() -> None:
    port = free_port()
    program = (
        "import sys, time, numpy as np\n"
        "from maniskill_tomato.deploy.clock import MonotonicClock\n"
        "from maniskill_tomato.deploy.drivers import DriverContext, make_arm\n"
        "from maniskill_tomato.deploy.interface import JointMove\n"
        f"options = {{'controller': '127.0.0.1', 'port': {port}}}\n"
        "arm = make_arm('libiiwa', options, DriverContext(clock=MonotonicClock()))\n"
        "arm.connect()\n"
        f"arm.command(JointMove(joint_positions=np.array({FAR.tolist()}), speed_fraction=0.05))\n"
        "time.sleep(600)\n"
    )
    with LoopbackRobot(port=port, qpos=START.tolist(), tries_for_s=120.0) as robot:
        with subprocess.Popen([sys.executable, "-c", program]) as running:
            end = time.monotonic() + 120.0
            while abs(robot.arm.qpos[0]) < 1e-3 and time.monotonic() < end:
                time.sleep(0.01)
            os.kill(running.pid, signal.SIGKILL)
            assert robot.wait(5.0) and stands(robot)


# What the robot does without a word.


def test_a_joint_that_the_robot_leaves_where_it_is_ends_the_move_as_a_fault() -> None:
    """The controller's own limits may be narrower; it says `done`, and moves the other joints."""
    limits = JOINT_UPPER.copy()
    limits[3] = 1.21
    with met(robot={"speedup": 4.0, "joint_limits": limits.tolist()}) as (robot, arm):
        arm.command(move_to(START + np.array([0.05, 0, 0, -0.05, 0, 0, 0])))
        with pytest.raises(FaultError, match=r"joint 4 is 2\.86 degrees off.*told to stop"):
            finish(arm)
        assert robot.arm.qpos[3] == START[3] and robot.arm.qpos[0] == pytest.approx(0.05, abs=1e-6)


def test_a_target_at_a_limit_which_single_precision_puts_beyond_it_is_never_sent() -> None:
    at_limit = START.copy()
    at_limit[3] = -JOINT_UPPER[3]
    assert abs(np.float32(at_limit[3])) > JOINT_UPPER[3]
    with met() as (robot, arm):
        with pytest.raises(RefusedError, match="within the limits"):
            arm.command(move_to(at_limit))
    assert 102 not in codes(robot)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_numbers_that_are_not_finite_are_never_sent_since_they_mean_keep(bad: float) -> None:
    joints = START.copy()
    joints[2] = bad
    with met() as (robot, arm):
        before = len(robot.received)
        for target, speed in ((joints, 0.1), (NEAR, bad), (NEAR, 0.0), (NEAR, 1.1), (START + 3.0, 0.1)):
            with pytest.raises(RefusedError):
                arm.command(move_to(target, speed))
        assert len(robot.received) == before
    with pytest.raises(InvalidInputError, match="finite"):
        Messages(False).request(Code.MOVE_JOINTS, joints.tolist())
    with pytest.raises(InvalidInputError):
        Messages(False).request(Code.SPEED, [1e300])


def test_an_error_that_stays_for_good_stops_nothing_later_and_is_not_told_again() -> None:
    with met(robot={"speedup": 4.0, "faults": [Fault(kind="refused", command="201")]}) as (_, arm):
        with pytest.raises(RefusedError, match="did not take the speed: a value was not taken"):
            arm.command(move_to(NEAR))
        arm.command(move_to(NEAR))
        finish(arm)


def test_an_error_in_a_move_is_a_fault() -> None:
    faults = [Fault(kind="failed", command="102", seconds=0.2)]
    with met(robot={"faults": faults}) as (robot, arm):
        begin(arm, robot)
        with pytest.raises(FaultError, match="an asynchronous move failed"):
            finish(arm)
        assert stands(robot)


def test_an_error_that_was_there_before_is_noticed_by_where_the_arm_stands() -> None:
    """The second failure of a kind changes nothing in what the robot says."""
    faults = [Fault(kind="failed", command="102", seconds=0.2)]
    with met(robot={"faults": faults}) as (robot, arm):
        robot._error = -14
        begin(arm, robot)
        with pytest.raises(FaultError, match=r"joint 1 is .* degrees off"):
            finish(arm)


def test_a_move_whose_flag_comes_late_is_not_taken_for_one_that_has_ended() -> None:
    with met(robot={"flag_lag_s": 0.25, "start_lag_s": 0.2}) as (robot, arm):
        arm.command(move_to(NEAR))
        finish(arm)
        np.testing.assert_allclose(robot.arm.qpos, NEAR, atol=1e-6)


def test_a_contact_ends_the_move_by_the_condition_that_was_set_and_is_a_fault() -> None:
    faults = [Fault(kind="contact", command="102", seconds=0.2)]
    with met(robot={"faults": faults}, torque_margin=[160.0, 160.0, 88.0, 88.0, 55.0, 20.0, 20.0]) as (
        robot,
        arm,
    ):
        begin(arm, robot)
        with pytest.raises(
            FaultError, match=r"touched something: the torque at joint 2 changed by 60\.0 N m"
        ):
            finish(arm)
        assert stands(robot)


def test_a_push_that_no_condition_notices_cancels_the_move() -> None:
    faults = [Fault(kind="contact", command="102", seconds=0.2)]
    with met(robot={"faults": faults}, contact_force=500.0) as (robot, arm):
        begin(arm, robot)
        with pytest.raises(FaultError, match="touched something"):
            finish(arm)
        assert codes(robot)[-1] == 101 or 101 in codes(robot)[-3:]
        assert stands(robot)


def test_a_released_enabling_switch_ends_the_move_for_good() -> None:
    faults = [Fault(kind="not_ready", command="102", seconds=0.2)]
    with met(robot={"faults": faults}) as (robot, arm):
        begin(arm, robot)
        with pytest.raises(FaultError, match="not ready any more"):
            finish(arm)
        # Without it the controller might go on when the switch is pressed again.
        assert 101 in codes(robot)[codes(robot).index(102) :]


def test_a_robot_that_is_not_ready_refuses_the_move_and_may_be_asked_again() -> None:
    with met(robot={"speedup": 4.0}) as (robot, arm):
        robot._ready = False
        with pytest.raises(RefusedError, match="not ready to move"):
            arm.command(move_to(NEAR))
        robot._ready = True
        arm.command(move_to(NEAR))
        finish(arm)


def test_settings_that_would_cancel_a_move_are_never_sent_in_one() -> None:
    with met(robot={"speedup": 4.0}) as (robot, arm):
        arm.command(move_to(NEAR, speed=0.1))
        with pytest.raises(RefusedError, match="under way"):
            arm.command(move_to(START))
        finish(arm)
        np.testing.assert_allclose(robot.arm.qpos, NEAR, atol=1e-6)
    assert robot.cancelled_by == [] and codes(robot).count(102) == 1


def test_a_robot_that_makes_moves_synchronously_is_told_not_to_so_that_a_stop_arrives() -> None:
    with met(robot={"execution": 52}) as (robot, arm):
        began = time.monotonic()
        begin(arm, robot)
        assert time.monotonic() - began < 2.0
        assert arm.stop() and stands(robot)


def test_a_robot_that_takes_no_asynchronous_moves_is_refused() -> None:
    port = free_port()
    faults = [Fault(kind="refused", command="305")]
    with LoopbackRobot(port=port, qpos=START.tolist(), tries_for_s=30.0, faults=faults) as robot:
        with pytest.raises(RefusedError, match="without which nothing could be stopped"):
            driver(port).connect()
        assert robot.wait(5.0)


# A connection that fails.


def test_a_pulled_cable_leaves_at_most_the_piece_under_way() -> None:
    faults = [Fault(kind="cut", command="102", seconds=0.2)]
    with met(robot={"faults": faults, "speedup": 4.0}, largest_segment=0.1, **HASTY) as (robot, arm):
        begin(arm, robot)
        with pytest.raises(
            DeviceTimeoutError, match="goes on to the end of the piece; use the emergency stop"
        ):
            finish(arm)
        assert not arm.is_connected and arm.stop() is False
        end = time.monotonic() + 30.0
        while robot.arm.moves and time.monotonic() < end:
            time.sleep(0.01)
        # The robot noticed nothing, and went on to the end of the piece.
        assert not robot.over and robot.arm.qpos[0] == pytest.approx(0.1, abs=1e-6)
        with pytest.raises(NotConnectedError, match="smartPAD"):
            arm.read()


@pytest.mark.parametrize(
    ("kind", "error"),
    [
        ("silent", DeviceTimeoutError),
        ("partial", DeviceTimeoutError),
        ("slow", DeviceTimeoutError),
        ("garbage", ProtocolError),
        ("double", ProtocolError),
        ("nan", ProtocolError),
        ("drop", NotConnectedError),
    ],
)
def test_an_answer_that_does_not_come_or_means_nothing_ends_the_move_with_the_connection(
    kind: str, error: type[DeployError]
) -> None:
    """The state is asked for three times before the move, so that the fifth is in it."""
    command = "102" if kind == "drop" else "0"
    fault = Fault(kind=kind, command=command, count=1 if kind == "drop" else 5, seconds=0.6)
    with met(robot={"faults": [fault]}, **HASTY) as (robot, arm):
        arm.command(move_to(FAR, 0.05))
        with pytest.raises(error, match=r"given up.*A move was under way"):
            finish(arm)
        assert not arm.is_connected and arm.stop() is False
        assert robot.wait(5.0) and stands(robot)


def test_a_jump_of_a_joint_is_a_fault_and_cancels_the_move() -> None:
    faults = [Fault(kind="jump", command="0", count=6, radians=2.5)]
    with met(robot={"faults": faults}) as (robot, arm):
        arm.command(move_to(FAR, 0.05))
        with pytest.raises(FaultError, match=r"joint 4 turned by .* faster than it can.*told to stop"):
            finish(arm)
        assert stands(robot)


def test_a_move_that_takes_too_long_is_cancelled() -> None:
    with met(robot={"speedup": 0.05}, **{**HASTY, "reply_timeout_s": 10.0}) as (robot, arm):
        arm.command(move_to(START + np.array([0.1, 0, 0, 0, 0, 0, 0]), 0.5))
        with pytest.raises(DeviceTimeoutError, match="twice its computed time"):
            finish(arm)
        assert 101 in codes(robot)[codes(robot).index(102) :]


def test_answers_cut_by_the_network_are_put_together_and_slow_ones_waited_for() -> None:
    faults = [
        Fault(kind="split", command="0", count=4),
        Fault(kind="slow", command="201", seconds=0.2),
    ]
    with met(robot={"speedup": 4.0, "faults": faults}) as (robot, arm):
        arm.command(move_to(NEAR))
        finish(arm)
        np.testing.assert_allclose(robot.arm.qpos, NEAR, atol=1e-6)


def test_what_comes_unasked_ends_the_connection_before_it_can_answer_anything() -> None:
    port, peers = free_port(), list[socket.socket]()
    thread = threading.Thread(target=lambda: peers.append(dial(port)), daemon=True)
    thread.start()
    connection = RobotConnection("127.0.0.1", port, "127.0.0.1", 30.0)
    thread.join(30.0)
    peers[0].sendall(b"late")
    time.sleep(0.05)
    with pytest.raises(ProtocolError, match="something unasked"):
        connection.exchange(b"question", 4, 1.0)
    assert peers[0].recv(8) == b"" and not connection.is_open
    peers[0].close()


def test_the_application_ends_with_the_connection_and_must_be_started_again() -> None:
    port = free_port()
    arm = driver(port)
    for _ in range(2):
        with LoopbackRobot(port=port, qpos=START.tolist(), tries_for_s=30.0) as robot:
            with arm:
                np.testing.assert_allclose(arm.read().joint_positions, START, atol=1e-6)
            assert robot.wait(5.0)
        with pytest.raises(NotConnectedError):
            arm.read()


def test_a_robot_that_nobody_waits_for_gives_up_at_once() -> None:
    with LoopbackRobot(port=free_port()) as robot:
        assert robot.wait(5.0) and "nobody listens" in robot.ended_because


def test_a_robot_that_does_not_connect_is_told_by_the_deadline() -> None:
    with pytest.raises(NotConnectedError, match=r"did not connect .* within 0\.1 s; start the application"):
        driver(free_port(), connect_timeout_s=0.1).connect()


def test_a_port_that_is_taken_is_said_at_once() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        with pytest.raises(NotConnectedError, match="another program waits"):
            driver(taken.getsockname()[1]).connect()


def test_whoever_else_connects_is_sent_away() -> None:
    with waiting(controller="127.0.0.2", connect_timeout_s=0.5) as (port, ended):
        with dial(port) as stranger:
            assert stranger.recv(1) == b""
    assert isinstance(ended[0], NotConnectedError)


def test_a_second_robot_is_not_taken() -> None:
    with met() as (_, arm):
        port = arm._config.port  # type: ignore[attr-defined]
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection(("127.0.0.1", port))


@pytest.mark.parametrize("double_precision", [False, True])
def test_another_precision_than_the_robots_moves_nothing_and_is_said(double_precision: bool) -> None:
    port = free_port()
    with LoopbackRobot(
        port=port, qpos=START.tolist(), tries_for_s=30.0, double_precision=not double_precision
    ) as robot:
        with pytest.raises(DeployError, match=r"Is arm\.double_precision"):
            driver(port, double_precision=double_precision, reply_timeout_s=2.0).connect()
        assert all(not any(request) for request in robot.received)


# What both must agree about.


@pytest.mark.parametrize("offset", [0.026, 0.003])
def test_a_flange_elsewhere_than_configured_is_refused_at_the_start(offset: float) -> None:
    port = free_port()
    with LoopbackRobot(port=port, qpos=START.tolist(), tries_for_s=30.0, media_flange_m=offset):
        with pytest.raises(FaultError, match=r"flange_xyz.*to the mounted flange"):
            driver(port).connect()


def test_a_media_flange_and_a_tool_agree_with_the_robot() -> None:
    tool = [0.01, -0.02, 0.05, 0.3, -0.2, 0.1]
    frames = [[0.0] * 6, [10.0, -20.0, 50.0, 0.3, -0.2, 0.1]]
    robot = {"media_flange_m": 0.026, "tools": frames}
    with met(robot=robot, flange_xyz=[0, 0, 0.026], tool_index=1, tool_xyzabc=tool) as (_, arm):
        assert arm.describe()["flange_difference_mm"] < 0.01


def test_a_tool_that_the_robot_does_not_have_is_refused() -> None:
    port = free_port()
    with LoopbackRobot(port=port, qpos=START.tolist(), tries_for_s=30.0):
        with pytest.raises(RefusedError, match=r"tool 0 \(arm\.tool_index\): an invalid configuration"):
            driver(port, tool_index=0).connect()


def test_options_are_checked_when_the_profile_is_read() -> None:
    context = DriverContext(clock=MonotonicClock())
    for options, match in (
        ({"prot": 12225}, "arm.prot is unknown"),
        ({"port": 80}, "port must be from 1024"),
        ({"controller": "the robot"}, "controller must be an address"),
        ({"host": "::1"}, "host must be an address"),
        ({"tool_index": -1}, "tool_index must be from 0"),
        ({"acceleration_fraction": 0.0}, "acceleration_fraction must be from"),
        ({"contact_force": 0.5}, "contact_force must be from"),
        ({"largest_segment": 2.0}, "largest_segment"),
        ({"torque_margin": [1.0]}, "torque_margin must be 7 torques"),
    ):
        with pytest.raises(ProfileError, match=match):
            make_arm("libiiwa", options, context)


def test_the_shipped_profile_makes_both_drivers_without_touching_a_device() -> None:
    profile = load_profile("iiwa14_libiiwa_d435")
    context = DriverContext(clock=MonotonicClock())
    arm = make_arm(profile.arm_driver, profile.arm_options, context)
    camera = make_camera(profile.camera_driver, profile.camera_options, context)
    assert (arm.name, camera.name) == ("libiiwa", "realsense")
    assert not arm.is_connected and not arm.simulated and arm.can_stop


# The bytes, by hand.


@pytest.mark.parametrize("double_precision", [False, True])
def test_requests_and_states_are_big_endian_numbers_without_anything_else(double_precision: bool) -> None:
    kind = "d" if double_precision else "f"
    messages = Messages(double_precision)
    request = messages.request(Code.SPEED, [0.25])
    assert request == struct.pack(f">8{kind}", 201, 0.25, 0, 0, 0, 0, 0, 0)
    numbers = [1.0, *np.linspace(-0.6, 0.6, 7), *[9.0] * 7, *range(7), 100.0, 200.0, 300.0, 0.1, 0.2, 0.3]
    numbers += [5.0] * 6 + [-14.0, 0.0, 1.0, 1.0]
    state = messages.state(struct.pack(f">38{kind}", *numbers))
    assert (state.done, state.error, state.is_stopped_by_contact) == (True, -14, False)
    assert state.is_ready and state.is_active
    np.testing.assert_allclose(state.joint_positions, np.linspace(-0.6, 0.6, 7), atol=1e-7)
    np.testing.assert_allclose(state.external_torque, range(7))
    np.testing.assert_allclose(state.pose, [0.1, 0.2, 0.3, 0.1, 0.2, 0.3], atol=1e-7)


@pytest.mark.parametrize(
    ("index", "value"), [(0, 0.5), (35, 2.0), (36, -1.0), (37, 0.1), (34, -17.0), (34, 0.0)]
)
def test_flags_and_errors_that_the_application_does_not_have_are_no_state(index: int, value: float) -> None:
    numbers = [0.0] * 34 + [-10.0, 0.0, 1.0, 0.0]
    Messages(False).state(struct.pack(">38f", *numbers))
    numbers[index] = value
    with pytest.raises(ProtocolError, match="its"):
        Messages(False).state(struct.pack(">38f", *numbers))


@settings(max_examples=200, deadline=None)
@given(
    st.one_of(
        st.binary(min_size=152, max_size=152),
        st.lists(st.floats(width=32), min_size=38, max_size=38).map(lambda v: struct.pack(">38f", *v)),
        st.lists(
            st.sampled_from([0.0, 1.0, -10.0, math.nan, math.inf, -0.0, 1e38]), min_size=38, max_size=38
        ).map(lambda v: struct.pack(">38f", *v)),
    )
)
def test_whatever_comes_is_a_state_of_finite_numbers_or_an_error_of_ours(content: bytes) -> None:
    try:
        state = Messages(False).state(content)
    except ProtocolError:
        return
    for values in (state.joint_positions, state.external_torque, state.pose):
        assert np.isfinite(values).all()
    assert -16 <= state.error <= -10


def test_the_loopback_keeps_the_hazards_of_the_real_one() -> None:
    """By hand over the socket, with code of neither side."""
    with socket.create_server(("127.0.0.1", 0)) as pc:
        with LoopbackRobot(port=pc.getsockname()[1], qpos=START.tolist()) as robot:
            peer, _ = pc.accept()

            def ask(*numbers: float) -> tuple[float, ...]:
                peer.sendall(struct.pack(">8f", *numbers, *[0.0] * (8 - len(numbers))))
                reply = b""
                while len(reply) < 152:
                    reply += peer.recv(152 - len(reply))
                return struct.unpack(">38f", reply)

            first = ask(0)
            assert (first[0], *first[34:]) == (0.0, -10.0, 0.0, 1.0, 0.0)
            # Full speed: half a radian of joint 1 in less than 0.6 s. NaN keeps, and so does what is out of limits.
            assert ask(102, 0.5, math.nan, 9.0, *START[3:])[0] == 1.0
            time.sleep(0.6)
            after = ask(0)
            np.testing.assert_allclose(after[1:8], [0.5, *START[1:]], atol=1e-6)
            assert after[37] == 0.0 and after[34] == -10.0
            assert ask(201, math.nan)[0] == 1.0 and ask(201, 0.1)[0] == 1.0
            assert (ask(201, 2.0)[0], ask(0)[34], ask(201, 0.1)[34]) == (0.0, -11.0, -11.0)
            assert ask(102, 0.0, *START[1:])[37] == 1.0
            time.sleep(0.1)
            assert ask(305, 51)[0] == 1.0 and robot.cancelled_by == [305]
            assert ask(math.nan)[0] == ask(999)[0] == 0.0
            # A move that is made synchronously answers, and hears a stop, when it is over.
            ask(201, 0.5)
            ask(305, 52)
            began = time.monotonic()
            assert ask(102, 0.4, *START[1:])[37] == 0.0 and time.monotonic() - began > 0.1
            peer.sendall(b"half")
            assert robot.wait(5.0) and robot.ended_because == "4 bytes instead of 32"
            peer.close()


@pytest.mark.parametrize(
    ("request_numbers", "why"), [((-1.0,), "code -1.0"), ((212.0, 9.0), "out of bounds")]
)
def test_small_mistakes_end_the_application(request_numbers: tuple[float, ...], why: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as pc:
        with LoopbackRobot(port=pc.getsockname()[1]) as robot:
            peer, _ = pc.accept()
            with peer:
                peer.sendall(struct.pack(">8f", *request_numbers, *[0.0] * (8 - len(request_numbers))))
                assert robot.wait(5.0) and why in robot.ended_because


def test_the_rehearsal_command_refuses_an_unknown_fault_without_a_traceback() -> None:
    command = [sys.executable, "-m", "maniskill_tomato.deploy.libiiwa", "--fault", "explode"]
    result = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert result.returncode == 2
    assert result.stderr.startswith("error: fault must be one of")


def test_the_loopback_shares_nothing_with_the_driver() -> None:
    from maniskill_tomato.deploy.libiiwa import loopback, loopback_arm

    names = {"messages", "client", "robot_connection", "libiiwa_arm", "libiiwa_config"}
    for module in (loopback, loopback_arm):
        with open(str(module.__file__)) as file:
            text = file.read()
        assert not any(f"libiiwa.{name}" in text for name in names)
