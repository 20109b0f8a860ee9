"""A move is held against its plan while it is under way: over real sockets, with arms that do something else."""

import math
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from maniskill_tomato.deploy.clock import MonotonicClock, SimulatedClock
from maniskill_tomato.deploy.deploy_errors import DeployError, DeviceTimeoutError, FaultError, StaleError
from maniskill_tomato.deploy.drivers import DriverContext, make_arm
from maniskill_tomato.deploy.guarded_arm import GuardedArm
from maniskill_tomato.deploy.interface import Arm, ArmState, Float64, JointMove
from maniskill_tomato.deploy.libiiwa.loopback import LoopbackRobot
from maniskill_tomato.deploy.loopback_faults import Fault
from maniskill_tomato.deploy.move_watch import Departure, MoveWatch
from maniskill_tomato.deploy.safety import Safety
from maniskill_tomato.deploy.safety_config import SafetyConfig
from maniskill_tomato.deploy.sunrise.loopback import LoopbackController
from maniskill_tomato.robot.iiwa14 import IIWA14, READY_QPOS

CONFIG = SafetyConfig(max_state_age=10.0, plant_clearance=None)
AWAY = np.array([0.3, -0.1, 0.2, 0.1, 0.2, -0.1, 0.4])


@contextmanager
def sunrise(*faults: Fault, **options: Any) -> Iterator[tuple[LoopbackController, GuardedArm]]:
    clock = MonotonicClock()
    with LoopbackController(qpos=READY_QPOS.tolist(), faults=faults) as controller:
        host, port = controller.address
        patient = {"connect_pause_s": 0.0, "reply_timeout_s": 30.0, "move_margin_s": 30.0, **options}
        arm = make_arm("sunrise", {"host": host, "port": port, **patient}, DriverContext(clock=clock))
        arm.simulated = True  # Nothing real moves; a busy machine needs the patience of CONFIG.
        with arm:
            yield controller, GuardedArm(arm, Safety(CONFIG), clock)


def go(guard: GuardedArm, turn: Float64, speed_fraction: float = 0.1) -> Float64:
    """Makes a move; where to."""
    target = guard.read().joint_positions + turn
    guard.command(JointMove(joint_positions=target, speed_fraction=speed_fraction))
    while not guard.wait(0.1):
        pass
    return target


def moves_sent(controller: LoopbackController) -> int:
    return sum(line.startswith("doPTP") for line in controller.received)


@pytest.mark.parametrize(
    ("fault", "error", "word"),
    [
        (Fault(kind="hurry", command="doPTP"), FaultError, "faster than asked"),
        (Fault(kind="stray", command="doPTP", radians=0.6), FaultError, "beside the planned line"),
        (Fault(kind="stall", command="doPTP"), DeviceTimeoutError, "no joint has turned"),
        (Fault(kind="crawl", command="doPTP"), DeviceTimeoutError, "far longer than its speed says"),
        (Fault(kind="frozen", command="doPTP"), DeviceTimeoutError, "its readings are frozen"),
    ],
    ids=lambda value: value.kind if isinstance(value, Fault) else "",
)
def test_an_arm_that_does_something_else_is_noticed_in_the_first_piece_and_gets_no_other(
    fault: Fault, error: type[DeployError], word: str
) -> None:
    with sunrise(fault) as (controller, guard):
        with pytest.raises(error, match=word) as told:
            go(guard, AWAY, speed_fraction=0.03 if fault.kind == "frozen" else 0.1)
        assert "nothing more of the move is sent" in str(told.value)
        assert "emergency stop" in str(told.value)
        assert moves_sent(controller) == 1
        with pytest.raises(DeployError):
            go(guard, 0.1 * AWAY)
        assert moves_sent(controller) == 1


def test_what_goes_wrong_in_a_later_piece_is_noticed_in_that_piece() -> None:
    with sunrise(Fault(kind="hurry", command="doPTP", count=2)) as (controller, guard):
        with pytest.raises(FaultError, match="faster than asked"):
            go(guard, AWAY)
        assert moves_sent(controller) == 2


@contextmanager
def libiiwa(**robot: Any) -> Iterator[tuple[LoopbackRobot, GuardedArm]]:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    options = {"controller": "127.0.0.1", "host": "127.0.0.1", "port": port, "reply_timeout_s": 10.0}
    clock = MonotonicClock()
    with LoopbackRobot(port=port, qpos=READY_QPOS.tolist(), tries_for_s=20.0, **robot) as loopback:
        arm = make_arm("libiiwa", {**options, "move_margin_s": 30.0}, DriverContext(clock=clock))
        arm.simulated = True
        with arm:
            yield loopback, GuardedArm(arm, Safety(CONFIG), clock)


def test_where_a_move_can_be_cancelled_an_arm_that_is_too_fast_is_halted_on_its_way() -> None:
    with libiiwa(speedup=5.0) as (robot, guard):
        target = guard.read().joint_positions + AWAY
        guard.command(JointMove(joint_positions=target, speed_fraction=0.1))
        with pytest.raises(FaultError, match="faster than asked.*it was told to stop"):
            while not guard.wait(0.1):
                pass
        while not guard.wait(0.1):
            pass
        stands = robot.arm.qpos
        time.sleep(0.2)
        np.testing.assert_array_equal(robot.arm.qpos, stands)
        assert np.abs(target - stands).max() > 0.1


@pytest.mark.parametrize("world", [sunrise, libiiwa])
def test_an_honest_arm_is_never_stopped_and_keeps_far_from_every_tolerance(world: Any) -> None:
    with world() as (_, guard):
        rng = np.random.default_rng(5)
        for fraction in (0.1, 0.3):
            target = go(guard, rng.uniform(-0.2, 0.2, 7), fraction)
            np.testing.assert_allclose(guard.read().joint_positions, target, atol=1e-6)
            assert guard.watch is not None
            # `late` and `still` tell how busy this machine is.
            assert max(guard.watch.worst[kind] for kind in ("off_path", "back", "fast")) < 0.5


STRAIGHT = np.array([0.4, 0.0, 0.0, 0.0, 0.0, 0.0, 0.2])
SLOW = JointMove(joint_positions=STRAIGHT, speed_fraction=0.1)
SECONDS = 0.4 / (0.1 * math.radians(85.0))


def seen(
    path: Any, until: float, dt: float = 0.05, stamp_error: float = 0.0
) -> tuple[float, Departure | None]:
    """Looks at `path(t)`, joint positions over time, until something is noticed; when, and what."""
    watch = MoveWatch(np.zeros(7), SLOW, SECONDS, 100.0, IIWA14)
    for t in np.arange(dt, until, dt):
        departure = watch.see(path(t), 100.0 + t - stamp_error, 100.0 + t)
        if departure is not None:
            return float(t), departure
    return until, None


def at(share: float) -> Float64:
    return min(share, 1.0) * STRAIGHT


@pytest.mark.parametrize(
    ("path", "kind", "by"),
    [
        (lambda t: at(1.3 * t / SECONDS), "fast", 2.3),
        (lambda t: at(2.0 * t / SECONDS), "fast", 0.3),
        # At its own time, but then ten times too fast to make up for a pause.
        (lambda t: at(0.0) if t < 1.5 else at((t - 1.5) * 10.0 / SECONDS), "fast", 1.7),
        (lambda t: at(t / SECONDS) + 0.05 * math.sin(t) * np.eye(7)[3], "off_path", 0.75),
        (lambda t: at(t / SECONDS) if t < 1.0 else at((2.0 - t) / SECONDS), "back", 1.3),
        (lambda t: 1.2 * at(t / SECONDS) if t > 2.6 else at(t / SECONDS), "off_path", 2.8),
        (lambda t: at(t / SECONDS) if t < 1.0 else at(1.0 / SECONDS), "still", 3.1),
        (lambda t: at(t / SECONDS / 10.0), "late", 2.6),
        (lambda t: at(0.98), "fast", 0.1),
        (lambda t: at(t / SECONDS) if t < 2.68 else at(0.99), "unended", 8.1),
    ],
)
def test_each_departure_is_named_and_noticed_in_time(path: Any, kind: str, by: float) -> None:
    when, departure = seen(path, 12.0)
    assert departure is not None and departure.kind == kind
    assert when <= by


@pytest.mark.parametrize(
    "path",
    [
        lambda t: at(t / SECONDS),
        lambda t: at(1.1 * t / SECONDS),
        lambda t: at(0.6 * t / SECONDS),
        lambda t: at((t - 1.5) / SECONDS) if t > 1.5 else at(0.0),
        # Pieces with pauses between them.
        lambda t: at((math.floor(t / 1.3) * 1.0 + min(t % 1.3, 1.0)) / SECONDS),
        lambda t: at(t / SECONDS) + 0.007 * math.sin(30.0 * t),
    ],
)
def test_what_a_real_controller_may_do_is_not_held_against_it(path: Any) -> None:
    for dt in (0.02, 0.1, 0.45):
        assert seen(path, 6.0, dt)[1] is None


@pytest.mark.parametrize("fraction", [0.1, 0.03, 0.01, 0.005])
@pytest.mark.parametrize("turn", [0.05, 0.4, 1.5])
def test_an_arm_that_begins_and_ends_a_slow_move_smoothly_is_never_stopped(
    fraction: float, turn: float
) -> None:
    way = turn * np.eye(7)[0]
    seconds = 1.875 * turn / (fraction * math.radians(85.0))
    for dt in (0.02, 0.1, 0.45):
        move = JointMove(joint_positions=way, speed_fraction=fraction)
        watch = MoveWatch(np.zeros(7), move, seconds, 100.0, IIWA14)
        for t in np.arange(dt, seconds + 1.0, dt):
            x = min((t - 0.2) / seconds, 1.0) if t > 0.2 else 0.0
            share = x**3 * (10.0 - 15.0 * x + 6.0 * x**2)
            departure = watch.see(share * way, 100.0 + t, 100.0 + t)
            assert departure is None, f"after {t:.2f} of {seconds:.1f} s: {departure}"


@pytest.mark.parametrize("fraction", [0.1, 0.03, 0.01, 0.005])
def test_an_arm_that_does_not_begin_a_slow_move_is_noticed_long_before_its_end(fraction: float) -> None:
    seconds = 1.875 * 0.4 / (fraction * math.radians(85.0))
    move = JointMove(joint_positions=STRAIGHT, speed_fraction=fraction)
    watch = MoveWatch(np.zeros(7), move, seconds, 100.0, IIWA14)
    seen = ((t, watch.see(np.zeros(7), 100.0 + t, 100.0 + t)) for t in np.arange(0.1, seconds, 0.1))
    t, departure = next((t, departure) for t, departure in seen if departure is not None)
    assert departure.is_late
    assert t <= max(2.2, seconds / 8.0)


def test_a_loop_that_was_held_up_blames_nothing_on_the_arm_and_late_answers_no_speed() -> None:
    watch = MoveWatch(np.zeros(7), SLOW, SECONDS, 100.0, IIWA14)
    assert watch.see(at(0.1), 100.3, 100.3) is None
    assert watch.see(at(0.1), 190.0, 190.0) is None
    # Measured right after an answer that was itself on its way for 0.5 s.
    assert watch.see(at(0.3), 190.5, 191.0) is None
    assert watch.see(at(0.5), 191.0, 191.05) is None


class StaleArm(Arm):
    """Answers with the state that it had before the move."""

    name = "stale"
    model = IIWA14
    simulated = True

    def __init__(self, clock: SimulatedClock) -> None:
        self.clock, self.stopped, self.moved_at = clock, False, math.inf

    @property
    def is_connected(self) -> bool:
        return True

    def connect(self) -> None: ...

    def disconnect(self) -> None: ...

    def read(self, max_age_s: float = 0.5) -> ArmState:
        stamp = min(self.clock.now(), self.moved_at)
        return ArmState(joint_positions=READY_QPOS, joint_velocities=np.zeros(7), stamp=stamp)

    def command(self, move: JointMove) -> JointMove:
        self.moved_at = self.clock.now()
        return move

    def wait(self, timeout_s: float) -> bool:
        self.clock.sleep(timeout_s)
        return False

    def stop(self) -> bool:
        self.stopped = True
        return True


def test_readings_whose_time_stands_still_are_stale_in_the_middle_of_a_move() -> None:
    clock = SimulatedClock(100.0)
    arm = StaleArm(clock)
    guard = GuardedArm(arm, Safety(SafetyConfig()), clock)
    with pytest.raises(StaleError, match="middle of a move"):
        go(guard, 0.1 * AWAY)
    assert arm.stopped
    assert clock.now() < 101.0
