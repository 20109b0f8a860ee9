"""Moves that end and pictures since then, for programs with a loop of their own; on the twin."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from maniskill_tomato.deploy.arm_session import ArmSession
from maniskill_tomato.deploy.deploy_errors import NotConnectedError, RefusedError, StoppedError
from maniskill_tomato.deploy.profile import parse_profile
from maniskill_tomato.deploy.workcell import make_workcell
from twin_profile import TWIN_PROFILE

TURN = np.array([0.0, 0.02, 0.0, -0.02, 0.0, 0.01, 0.05])


def session(may_move: bool = True, extra: str = "") -> ArmSession:
    return ArmSession(make_workcell(parse_profile(TWIN_PROFILE + extra, Path("twin.toml"))), may_move)


def test_a_move_ends_where_it_was_sent_and_pictures_come_after_it() -> None:
    arm = session()
    assert not arm.is_connected
    with pytest.raises(NotConnectedError):
        arm.joint_positions()
    arm.connect()
    start = arm.joint_positions()
    first, joints = arm.look()
    assert np.array_equal(joints, start)
    same, _ = arm.look()
    assert same is first
    other, _ = arm.look(again=True)
    assert other.number > first.number and other.stamp > first.stamp
    sent = arm.go_to(start + TURN)
    assert np.allclose(sent, start + TURN, atol=1e-9)
    assert np.abs(arm.joint_positions() - sent).max() < 1e-3
    frame, joints = arm.look()
    assert frame.stamp > other.stamp and np.abs(joints - sent).max() < 1e-3
    assert np.array_equal(arm.go_to(joints), joints)  # It is there already.
    arm.disconnect()
    assert not arm.is_connected


@pytest.mark.parametrize("bad", [np.full(7, np.nan), np.full(7, np.inf), np.array([0, 2.0, 0, 0, 0, 0, 0])])
def test_an_unsafe_move_is_refused_and_the_arm_stays(bad: Any) -> None:
    arm = session()
    arm.connect()
    start = arm.joint_positions()
    with pytest.raises(RefusedError):
        arm.go_to(bad)
    assert np.array_equal(arm.joint_positions(), start)


def test_an_interrupted_move_is_stopped_and_none_follows_until_the_next_connection(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    arm = session()
    arm.connect()
    start = arm.joint_positions()
    wait = arm.workcell.guarded_arm.wait

    def interrupted(timeout_s: float) -> bool:
        wait(0.05)
        raise KeyboardInterrupt

    goal = start + 4.0 * TURN
    monkeypatch.setattr(arm.workcell.guarded_arm, "wait", interrupted)
    with pytest.raises(KeyboardInterrupt):
        arm.go_to(goal)
    monkeypatch.undo()
    arm.workcell.clock.sleep(5.0)
    stopped = arm.joint_positions()
    assert 0.0 < np.abs(stopped - start).max() < np.abs(goal - start).max() - 0.01
    with pytest.raises(StoppedError):
        arm.go_to(goal)
    arm.connect()
    assert np.allclose(arm.go_to(goal), goal)


def test_a_real_arm_moves_only_for_a_program_that_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    workcell = make_workcell(parse_profile(TWIN_PROFILE, Path("twin.toml")))
    monkeypatch.setattr(workcell.camera, "simulated", False)
    monkeypatch.setattr(workcell.arm, "simulated", False)  # As far as anybody can tell.
    arm = ArmSession(workcell, may_move=False)
    arm.connect()
    start = arm.joint_positions()
    with pytest.raises(RefusedError, match="only looks"):
        arm.go_to(start + TURN)
    assert np.array_equal(arm.joint_positions(), start)
    arm.look()


def test_no_device_stays_connected_if_one_cannot_be(monkeypatch: pytest.MonkeyPatch) -> None:
    arm = session()

    def gone() -> None:
        raise NotConnectedError("no camera")

    monkeypatch.setattr(arm.workcell.camera, "connect", gone)
    with pytest.raises(NotConnectedError, match="no camera"):
        arm.connect()
    assert not arm.workcell.arm.is_connected
