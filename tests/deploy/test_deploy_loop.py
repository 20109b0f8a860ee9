"""The loop over the digital twin: how runs end, and what every fault does."""

import itertools
import os
import re
import signal
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_type_hints

import numpy as np
import pytest
import torch
from torch import Tensor

from maniskill_tomato.assets import asset_path
from maniskill_tomato.deploy.clock import SimulatedClock
from maniskill_tomato.deploy.decision import TASK, default_policy
from maniskill_tomato.deploy.deploy_errors import DeployError, ProfileError, RefusedError, StoppedError
from maniskill_tomato.deploy.guarded_arm import GuardedArm
from maniskill_tomato.deploy.interface import Frame, JointMove
from maniskill_tomato.deploy.loop import Loop
from maniskill_tomato.deploy.mock.episode import load_episode
from maniskill_tomato.deploy.move_choice import Choice, MoveChooser, MoveRequest
from maniskill_tomato.deploy.profile import Profile, load_profile, parse_profile
from maniskill_tomato.deploy.profile_files import profile_names
from maniskill_tomato.deploy.robot_perception import TRUE_MASKS, ImagePerception, Sighting
from maniskill_tomato.deploy.run_records import KeptSteps, Proposal, RunResult
from maniskill_tomato.deploy.stops import Stops
from maniskill_tomato.deploy.way import Way, WayPlanner
from maniskill_tomato.deploy.workcell import Workcell, make_workcell
from maniskill_tomato.errors import PolicyError
from maniskill_tomato.policies.opening import open_policy
from maniskill_tomato.policies.protocol import Planner, Policy
from maniskill_tomato.robot.d435 import T_flange_camera_color_optical
from maniskill_tomato.robot.kinematics import forward_kinematics
from maniskill_tomato.sensing.belief import Belief

EPISODE = 9

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
max_moves = 6
{loop}
"""


def profile(twin: str = "", loop: str = "", more: str = "") -> Profile:
    return parse_profile(TEXT.format(twin=twin, loop=loop) + more, Path("test.toml"))


class Towards(Planner):
    """Always the same move."""

    name = "towards"

    def __init__(self, action: tuple[float, ...] = (0.3, 0.2, 0.1)) -> None:
        self.action = action
        self.asked = 0

    def act(self, belief: Belief) -> Tensor:
        self.asked += 1
        return torch.tensor([self.action])


def go(
    of: Profile,
    policy: Policy | None = None,
    clock: Any = None,
    stops: Stops | None = None,
    seed: int = EPISODE,
    **options: Any,
) -> tuple[RunResult, Workcell]:
    workcell = make_workcell(of, seed, clock)
    options.setdefault("mode", "unattended")
    clock_works = not isinstance(clock, JumpingClock)
    with workcell.arm, workcell.camera, stops or Stops() as listening:
        loop = Loop(workcell, policy or Towards(), listening, **options)
        result = loop.run()
        world: Any = workcell.arm
        speeds = np.abs(world._world.arm.joint_velocities)
        assert not clock_works or speeds.max() < 1e-3, "the arm stands at the end"
    return result, workcell


def test_a_planner_finds_the_tomato_and_the_run_ends_with_success() -> None:
    result, _ = go(profile(loop="threshold = 0.8"), open_policy("nbv", env_id=TASK), seed=6)
    assert result.success and result.reason == "success" and not result.is_fault
    assert result.visible_fraction > 0.8 >= max(result.visible_fractions[:-1])
    assert result.moves == len(result.visible_fractions) - 1
    assert result.end_state == "the arm stands and holds its position"


def test_a_view_that_never_gets_better_ends_with_the_budget() -> None:
    result, _ = go(profile("depth_noise = 0.0"), open_policy("stay", env_id=TASK), seed=12)
    assert (result.reason, result.moves, result.is_fault, result.success) == ("budget", 6, False, False)
    # The first move turns the camera to where the target was measured; from then on every picture is the same.
    assert len(set(result.visible_fractions[1:])) == 1
    assert result.true_visible_fraction is not None
    np.testing.assert_allclose(result.visible_fractions, result.true_visible_fraction, atol=0.01)


@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        ("unplugged", "not_connected"),
        ("frozen", "stale"),
        ("late", "stale"),
        ("black", "bad_picture"),
        ("wrong_size", "bad_picture"),
        ("silent", "timeout"),
    ],
)
def test_a_camera_that_fails_ends_the_run_before_the_next_move(fault: str, reason: str) -> None:
    result, _ = go(profile(f'faults = {{ camera = "{fault}", camera_from_read = 2 }}'))
    assert (result.reason, result.is_fault, result.moves) == (reason, True, 2), result.detail


def test_without_depth_the_arm_goes_back_once_and_no_farther() -> None:
    """A leaf may cover the lens; a camera that gives no depth where it gave some before is broken."""
    faults = 'depth_noise = 0.0\nfaults = { camera = "zero_depth", camera_from_read = 2%s }'
    kept = KeptSteps()
    broken, workcell = go(profile(faults % ""), recorders=[kept])
    assert (broken.reason, broken.is_fault, broken.moves) == ("bad_picture", True, 3), broken.detail
    assert [step.outcome for step in kept.steps] == ["moved"] * 3 and kept.steps[2].action is None
    arm: Any = workcell.arm
    np.testing.assert_allclose(arm._world.arm.joint_positions, kept.steps[1].joint_positions, atol=1e-6)
    # Three attempts at one view fail, then there is depth again: the run goes on from the view before.
    covered, _ = go(profile(faults % ", camera_reads = 3", "threshold = 0.99"))
    assert not covered.is_fault and covered.moves == 6
    # The same picture, by a map that knows one view more.
    assert covered.visible_fractions[1] == pytest.approx(covered.visible_fractions[3], abs=0.01)


def test_from_the_end_of_a_way_in_parts_without_depth_the_arm_goes_back_the_way_it_came(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    aside = np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])

    def two_parts(self: Any, request: MoveRequest, *others: Any) -> Choice:
        first, second = (
            JointMove(joint_positions=request.joint_positions + k * aside, speed_fraction=0.1) for k in (1, 2)
        )
        return Choice(move=first, refusal=None, then=(second,))

    monkeypatch.setattr(MoveChooser, "choose", two_parts)
    workcell, kept = (
        make_workcell(profile('faults = { camera = "zero_depth", camera_from_read = 1 }'), EPISODE),
        KeptSteps(),
    )
    sent: list[Any] = []
    with workcell.arm, workcell.camera, Stops() as stops:
        arm: Any = workcell.guarded_arm
        command = arm.command

        def told(move: JointMove, *others: Any) -> JointMove:
            sent.append(move.joint_positions)
            done: JointMove = command(move, *others)
            return done

        monkeypatch.setattr(arm, "command", told)
        Loop(workcell, open_policy("stay", env_id=TASK), stops, "unattended", [kept]).run()
    start = kept.steps[0].joint_positions
    expected = [start + aside, start + 2 * aside, start + aside, start]
    np.testing.assert_allclose(np.stack(sent), np.stack(expected), atol=1e-6)


@pytest.mark.parametrize("fault", ["late", "black", "zero_depth", "wrong_size", "silent"])
def test_one_bad_picture_is_taken_again(fault: str) -> None:
    exact = "depth_noise = 0.0\n"
    clean, _ = go(profile(exact, "threshold = 0.99"))
    faults = f'faults = {{ camera = "{fault}", camera_from_read = 1, camera_reads = 1 }}'
    result, _ = go(profile(exact + faults, "threshold = 0.99"))
    assert result.reason == clean.reason and not result.is_fault
    assert result.visible_fractions == clean.visible_fractions


@pytest.mark.parametrize(
    ("fault", "reason", "words"),
    [
        ("silent", "timeout", "did not answer"),
        ("slow", "timeout", "does not move as planned"),
        ("nan", "fault", "not finite"),
        ("jump", "fault", "joint_2 jumped by 0.400 rad"),
        ("drop", "not_connected", "broke during the move"),
        ("stuck", "fault", "holds it back"),
    ],
)
def test_an_arm_that_fails_ends_the_run(fault: str, reason: str, words: str) -> None:
    result, workcell = go(profile(f'faults = {{ arm = "{fault}", arm_from_move = 1 }}'))
    assert (result.reason, result.is_fault) == (reason, True), result.detail
    assert words in result.detail
    assert result.moves == 2


def test_a_controller_that_takes_no_moves_ends_the_run_as_refused() -> None:
    result, _ = go(profile('faults = { arm = "refuse" }', "refused_after = 3"))
    assert (result.reason, result.moves, result.refused_moves) == ("refused", 3, 3)
    assert "nak" in result.detail


def test_refusals_with_a_move_between_them_are_not_in_a_row() -> None:
    workcell = make_workcell(profile(loop="refused_after = 2"), EPISODE)
    arm: Any = workcell.arm
    command, calls = arm.command, itertools.count()

    def refuse_every_second(move: JointMove) -> JointMove:
        if next(calls) % 2 == 0:
            raise RefusedError("nak")
        sent: JointMove = command(move)
        return sent

    arm.command = refuse_every_second
    with workcell.arm, workcell.camera, Stops() as stops:
        result = Loop(workcell, open_policy("stay"), stops, "unattended").run()
    assert (result.reason, result.moves, result.refused_moves) == ("budget", 6, 3), result.detail


class TrueMasks(ImagePerception):
    """Perfect masks, of fruits that a test may hold back or put in another order."""

    def __init__(self) -> None:
        super().__init__(TRUE_MASKS, None)
        self.looks = 0

    def look(self, frame: Frame, T_world_camera: Any) -> Sighting:
        self.looks += 1
        assert frame.truth is not None
        ripe = self.found(list(frame.truth.ripe_labels), frame.truth.target_label)
        truth = replace(frame.truth, ripe_labels=tuple(ripe))
        return super().look(replace(frame, truth=truth), T_world_camera)

    def found(self, ripe: list[int], target: int) -> list[int]:
        return ripe


class Hidden(TrueMasks):
    """A segmenter that loses the target after the first picture."""

    def found(self, ripe: list[int], target: int) -> list[int]:
        return ripe if self.looks == 1 else []


class Swapped(TrueMasks):
    """A segmenter that lists the same fruits in another order every time."""

    def found(self, ripe: list[int], target: int) -> list[int]:
        turn = self.looks % len(ripe)
        return ripe[turn:] + ripe[:turn]


class Withheld(TrueMasks):
    """A segmenter that never finds the target, only its neighbours."""

    def found(self, ripe: list[int], target: int) -> list[int]:
        return [label for label in ripe if label != target]


class Late(TrueMasks):
    """A segmenter that finds no fruit in the first pictures, or in none."""

    def __init__(self, first: int | None) -> None:
        super().__init__()
        self.first = first

    def found(self, ripe: list[int], target: int) -> list[int]:
        return [] if self.first is None or self.looks < self.first else ripe


def with_perception(of: Profile, perception: Any, policy: Policy) -> RunResult:
    workcell = replace(make_workcell(of, EPISODE), perception=perception)
    with workcell.arm, workcell.camera, Stops() as stops:
        return Loop(workcell, policy, stops, "unattended").run()


def test_a_target_that_stays_out_of_sight_is_lost() -> None:
    result = with_perception(profile(loop="lost_after = 3"), Hidden(), open_policy("stay", env_id=TASK))
    assert (result.reason, result.moves, result.is_fault) == ("target_lost", 3, False)


class Blinking(TrueMasks):
    """A segmenter that finds the target in every third picture."""

    def found(self, ripe: list[int], target: int) -> list[int]:
        return ripe if self.looks % 3 == 1 else []


def test_looks_without_the_target_count_as_lost_only_in_a_row() -> None:
    result = with_perception(profile(loop="lost_after = 3"), Blinking(), open_policy("stay"))
    assert (result.reason, result.moves) == ("budget", 6), result.detail


def test_fruits_that_change_places_in_the_list_change_nothing() -> None:
    plain = with_perception(profile(), TrueMasks(), open_policy("nbv", env_id=TASK))
    swapped = with_perception(profile(), Swapped(), open_policy("nbv", env_id=TASK))
    assert swapped.visible_fractions == plain.visible_fractions
    assert swapped.reason == plain.reason


@pytest.mark.parametrize(("policy", "seed"), [("nbv", 7), ("nbv", 9), (None, 7), (None, 9)])
def test_a_neighbour_does_not_pass_for_a_target_that_is_not_found(policy: str | None, seed: int) -> None:
    """Fruits of one truss, and the segmenter never finds the one that is looked for: no success on another one.

    Once by a planner, whose views stay the same, and once by the policy that ships.
    """
    of = profile(loop="").text.replace("max_moves = 6", "max_moves = 11")
    workcell = make_workcell(parse_profile(of, Path("longer.toml")), seed)
    workcell = replace(workcell, perception=Withheld())
    kept = KeptSteps()
    looks_by = open_policy(policy or default_policy(), env_id=TASK)
    with workcell.arm, workcell.camera, Stops() as stops:
        result = Loop(workcell, looks_by, stops, "unattended", [kept]).run()
    assert not result.success and not result.is_fault
    assert max(step.view.fruits_seen for step in kept.steps) > 0
    assert result.best_visible_fraction < 0.3, "a sliver at most, where a fruit can hardly be located"


def test_a_robot_whose_first_pictures_show_no_fruit_looks_round_for_one() -> None:
    text = TEXT.format(twin="", loop="lost_after = 4").replace('source = "twin"', 'source = "seen"')
    seen = parse_profile(text, Path("seen.toml"))
    nothing = with_perception(seen, Late(None), open_policy("nbv", env_id=TASK))
    assert (nothing.reason, nothing.is_fault) == ("no_target", False), nothing.detail
    assert nothing.moves == 3 and nothing.best_visible_fraction == 0.0
    late = with_perception(seen, Late(3), open_policy("nbv", env_id=TASK))
    assert late.visible_fractions[:2] == (0.0, 0.0)
    assert late.reason in ("success", "budget") and late.best_visible_fraction > 0.5, late.detail


def test_without_a_given_target_the_largest_fruit_in_the_picture_is_taken() -> None:
    text = TEXT.format(twin="", loop="").replace('source = "twin"', 'source = "seen"')
    kept = KeptSteps()
    seen = parse_profile(text, Path("seen.toml"))
    result, workcell = go(seen, open_policy("nbv", env_id=TASK), recorders=[kept])
    assert not result.is_fault and result.reason in ("success", "budget", "refused")
    assert result.visible_fractions[0] > 0.0
    # What the twin tells of V_f is that of the fruit that was chosen, not of the episode's.
    episode, last = load_episode("held_out", EPISODE), kept.steps[-1]
    T = episode.T_world_plant.double().numpy()
    centres = np.array([f.centre for f in episode.plant.fruits]) @ T[:3, :3].T + T[:3, 3]
    chosen = int(np.linalg.norm(centres - last.target_position, axis=1).argmin())
    assert np.linalg.norm(centres[chosen] - last.target_position) < 0.015
    truth = workcell.twin().visible_fractions([chosen], last.joint_positions)[0]
    assert result.true_visible_fraction == pytest.approx(truth, abs=1e-6)


def test_another_target_gets_refusals_and_ways_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []

    def no_way(self: Any, places: Any, target: Any, *others: Any) -> Way:
        asked.append(target)
        return Way(pieces=(), place=None, blocked=())

    monkeypatch.setattr(WayPlanner, "to_view", no_way)
    monkeypatch.setattr(
        MoveChooser, "choose", lambda *_: Choice(move=None, refusal=None, out_of_reach="too far")
    )
    text = TEXT.format(twin="depth_noise = 0.0", loop="refused_after = 8").replace(
        'source = "twin"', 'source = "seen"'
    )
    text = text.replace("max_moves = 6", "max_moves = 12").replace("width = 160", "width = 424")
    kept = KeptSteps()
    result, _ = go(
        parse_profile(text.replace("height = 120", "height = 240"), Path("seen.toml")),
        seed=5,
        recorders=[kept],
    )
    assert (result.reason, result.moves, result.refused_moves) == ("budget", 12, 12), result.detail
    targets = np.unique([step.target_position.round(6) for step in kept.steps], axis=0)
    assert len(targets) == 2 == len(asked), "each is asked for once, for the arm does not move"
    one = go(parse_profile(text.replace('source = "seen"', 'source = "twin"'), Path("given.toml")), seed=5)[0]
    assert (one.reason, one.moves) == ("refused", 8)


@pytest.mark.parametrize(
    ("action", "words"),
    [
        ((float("nan"), 0.0, 0.0), "not finite"),
        ((0.0, float("inf"), 0.0), "not finite"),
        ((0.0, 1.2, 0.0), r"outside [-1, 1]"),
        ((0.0, 0.0, 0.0, 0.0, 0.0, 0.0), "another task"),
    ],
)
def test_a_policy_that_answers_nonsense_moves_nothing(action: tuple[float, ...], words: str) -> None:
    result, workcell = go(profile(), Towards(action))
    assert (result.reason, result.is_fault, result.moves) == ("policy", True, 0)
    assert words in result.detail
    arm: Any = workcell.arm
    assert arm._commands == 0


def test_policies_for_other_tasks_and_with_the_truth_are_refused(tmp_path: Path) -> None:
    with pytest.raises(PolicyError, match="trained on TomatoViewpointGuided-v1, not on TomatoViewpoint-v1"):
        open_policy(str(asset_path("policies/TomatoViewpointGuided-v1.pt")), env_id=TASK)
    with pytest.raises(PolicyError, match="in simulation only"):
        open_policy("oracle", env_id=TASK)
    with pytest.raises(PolicyError, match=r"no policy at .*one of .*nbv"):
        open_policy(str(tmp_path / "missing.pt"), env_id=TASK)
    damaged = tmp_path / "damaged.pt"
    damaged.write_bytes(b"PK\x03\x04 nothing")
    with pytest.raises(PolicyError, match="not a readable checkpoint"):
        open_policy(str(damaged), env_id=TASK)
    assert open_policy(default_policy(), env_id=TASK) is not None


class JumpingClock(SimulatedClock):
    """Goes back by ten seconds once."""

    def __init__(self, after: float) -> None:
        super().__init__(1000.0)
        self._after, self._jumped = after, False

    def now(self) -> float:
        if not self._jumped and super().now() > 1000.0 + self._after:
            self._jumped = True
            self.set(super().now() - 10.0)
        return super().now()


@pytest.mark.parametrize("after", [0.02, 0.5, 4.0])
def test_a_clock_that_jumps_back_is_a_fault(after: float) -> None:
    result, _ = go(profile(), clock=JumpingClock(after))
    assert (result.reason, result.is_fault) == ("fault", True)
    assert "clock went back" in result.detail


class KillingClock(SimulatedClock):
    """Sends this process a signal in the middle of the second move."""

    def __init__(self, number: int) -> None:
        super().__init__(1000.0)
        self.number, self.sleeps = number, 0

    def sleep(self, seconds: float) -> None:
        super().sleep(seconds)
        self.sleeps += 1
        if self.sleeps == 60:
            os.kill(os.getpid(), self.number)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_a_signal_in_the_middle_of_a_move_stops_the_arm(number: int) -> None:
    # As in a terminal, also where `nohup` started the tests.
    usual = signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
    before = signal.signal(number, usual)
    try:
        result, workcell = go(profile(), clock=KillingClock(number))
        assert signal.getsignal(number) is usual
    finally:
        signal.signal(number, before)
    assert (result.reason, result.detail, result.is_fault) == ("stopped", signal.Signals(number).name, False)
    assert result.end_state == "the arm was stopped and holds its position"


def test_a_run_that_was_started_by_nohup_goes_on_when_its_terminal_closes() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        result, _ = go(profile(), clock=KillingClock(signal.SIGHUP))
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)
    assert result.reason in ("success", "budget")


def test_an_arm_that_is_told_to_stop_and_moves_on_is_not_said_to_stand() -> None:
    slow = profile(more="[safety]\nspeed_fraction = 0.03\n")
    workcell = make_workcell(slow, EPISODE, KillingClock(signal.SIGTERM))
    arm: Any = workcell.arm
    arm.stop = lambda: True
    with workcell.arm, workcell.camera, Stops() as stops:
        result = Loop(workcell, Towards(), stops, "unattended").run()
    assert result.reason == "stopped"
    assert re.match(r"the arm was told to stop and still moves at 0\.\d+ rad/s", result.end_state)


class StoppedWhileDeciding(Towards):
    """Something asks for a stop while the policy thinks."""

    def __init__(self, how: str, stop_file: Path) -> None:
        super().__init__()
        self.how, self.stop_file = how, stop_file

    def act(self, belief: Belief) -> Tensor:
        if self.how == "file":
            self.stop_file.touch()
        elif self.how == "heartbeat":
            time.sleep(0.5)
        else:
            os.kill(os.getpid(), signal.Signals[self.how])
        return super().act(belief)


@pytest.mark.parametrize("how", ["SIGTERM", "SIGINT", "file", "heartbeat"])
def test_a_stop_while_the_policy_decides_lets_no_move_out(how: str, tmp_path: Path) -> None:
    stop_file = tmp_path / "STOP"
    workcell = make_workcell(profile(), EPISODE)
    arm: Any = workcell.arm
    sent: list[JointMove] = []
    command = arm.command

    def spied(move: JointMove) -> JointMove:
        sent.append(move)
        moved: JointMove = command(move)
        return moved

    arm.command = spied
    stops = Stops(stop_file=stop_file, heartbeat_s=0.2 if how == "heartbeat" else 60.0)
    with workcell.arm, workcell.camera, stops:
        stops.beat()
        result = Loop(workcell, StoppedWhileDeciding(how, stop_file), stops, "unattended").run()
    assert sent == []
    assert result.reason == ("heartbeat" if how == "heartbeat" else "stopped")
    assert result.is_fault is (how == "heartbeat")
    # The guard stays stopped until another run begins.
    with workcell.arm, pytest.raises(DeployError, match="STOP|SIG|stood still"):
        state = workcell.guarded_arm.read()
        stay = JointMove(joint_positions=state.joint_positions, speed_fraction=0.1)
        workcell.guarded_arm.command(stay)
    assert sent == []


def test_a_stop_file_ends_the_run_before_anything_moves(tmp_path: Path) -> None:
    (tmp_path / "STOP").touch()
    result, workcell = go(profile(), stops=Stops(stop_file=tmp_path / "STOP"))
    assert (result.reason, result.moves) == ("stopped", 0)
    assert "STOP" in result.detail


def test_a_stop_while_the_policy_decides_asks_nobody_for_a_yes() -> None:
    asked: list[Proposal] = []

    def ask(proposal: Proposal) -> bool:
        asked.append(proposal)
        return True

    policy = StoppedWhileDeciding("SIGTERM", Path("unused"))
    result, _ = go(profile(), policy, mode="confirm", confirm=ask)
    assert (result.reason, result.detail, asked) == ("stopped", "SIGTERM", [])


def test_a_signal_that_comes_just_before_a_person_is_waited_for_ends_the_waiting() -> None:
    with Stops() as stops:
        os.kill(os.getpid(), signal.SIGINT)
        with pytest.raises(StoppedError, match="SIGINT"), stops.waiting_for_a_person():
            pytest.fail("nobody is asked")


@pytest.mark.parametrize(
    "what", ["folder", "link to nothing", "link to itself", "link that is too long", "no folder"]
)
def test_whatever_stands_where_the_stop_file_would_stops_the_run(what: str, tmp_path: Path) -> None:
    place = tmp_path / "out" / "STOP"
    place.parent.mkdir()
    stops = Stops(stop_file=place)
    assert stops.asked() is None
    if what == "folder":
        place.mkdir()
    elif what == "no folder":
        place.parent.rmdir()
        place.parent.touch()
    else:
        ends = {"link to nothing": "nowhere", "link to itself": "STOP", "link that is too long": "x" * 300}
        place.symlink_to(ends[what])
    assert stops.asked() == f"stop file {place}"


class Sleepy(Towards):
    """A policy that hangs."""

    def act(self, belief: Belief) -> Tensor:
        time.sleep(1.0)
        return super().act(belief)


def test_a_loop_that_stands_still_loses_its_heartbeat_and_stops_the_arm() -> None:
    stopped: list[bool] = []
    stops = Stops(heartbeat_s=0.4, on_lost_heartbeat=lambda: stopped.append(True))
    result, _ = go(profile(), Sleepy(), stops=stops)
    assert (result.reason, result.is_fault) == ("heartbeat", True)
    assert len(stopped) == 1


def test_the_heartbeat_is_watched_from_the_first_beat_on_and_lost_when_it_should() -> None:
    lost_at: list[float] = []
    with Stops(heartbeat_s=0.2, on_lost_heartbeat=lambda: lost_at.append(time.monotonic())) as stops:
        time.sleep(0.5)
        assert stops.asked() is None
        began = time.monotonic()
        assert stops.beat() is None
        while not lost_at and time.monotonic() < began + 30.0:
            time.sleep(0.01)
        assert stops.asked() == "heartbeat"
    assert 0.2 <= lost_at[0] - began < 5.0


def test_people_may_take_longer_than_the_heartbeat_to_confirm_and_can_stop_instead(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    thought = [0.0]
    clock = SimpleNamespace(monotonic=lambda: time.monotonic() + thought[0])
    monkeypatch.setattr("maniskill_tomato.deploy.stops.time", clock)

    def slowly(proposal: Proposal) -> bool:
        if proposal.number == 0:
            thought[0] = 1000.0
            time.sleep(2.5)  # The heartbeat is looked at every second.
        return proposal.number == 0

    stops = Stops(heartbeat_s=500.0)
    result, _ = go(profile(), stops=stops, mode="confirm", confirm=slowly)
    assert (result.reason, result.moves) == ("declined", 2)
    stops = Stops()

    def stopping(proposal: Proposal) -> bool:
        stops.request("SIGINT")
        return True

    result, workcell = go(profile(), stops=stops, mode="confirm", confirm=stopping)
    arm: Any = workcell.arm
    assert result.reason == "stopped" and arm._commands == 0, "a yes does not outweigh a stop"


def test_a_dry_run_shows_the_first_move_and_sends_nothing() -> None:
    result, workcell = go(profile(), mode="dry_run")
    assert (result.reason, result.is_fault) == ("dry_run", False)
    assert "would go to (" in result.detail and "safety would" in result.detail
    arm: Any = workcell.arm
    assert arm._commands == 0


def test_only_confirmed_moves_are_made() -> None:
    asked: list[Proposal] = []

    def twice(proposal: Proposal) -> bool:
        asked.append(proposal)
        return len(asked) <= 2

    result, workcell = go(profile(loop="threshold = 0.99"), mode="confirm", confirm=twice)
    assert result.reason == "declined"
    assert [p.number for p in asked] == [0, 1, 2]
    arm: Any = workcell.arm
    assert arm._commands == 2
    assert all(0.0 < p.camera_step < 0.13 for p in asked)


def test_every_shipped_profile_can_be_read_and_errors_name_the_key(tmp_path: Path) -> None:
    assert {"mock", "mock_rendered", "iiwa14_d435"} <= set(profile_names())
    for name in profile_names():
        assert load_profile(name).description
    assert load_profile("iiwa14_d435").safety.workspace.high == (0.8, 0.7, 1.3)
    for wrong, words in (
        ("[safety]\nspeed = 1", "safety.speed is unknown; test.toml: safety may have"),
        ("[safety]\nspeed_fraction = 0.9", "speed_fraction must be at most max_speed_fraction"),
        ("[safety]\njoint_margin = 'much'", "safety.joint_margin must be a finite number"),
        ("[stop]\nfile = 'a/b'", "file must be a plain file name"),
        ("[wheels]\n", "wheels is unknown"),
        ("[calibration]\nT_flange_camera = [[1, 2], [3, 4]]", "calibration.T_flange_camera must be a 4 x 4"),
        ("[calibration]\nfile = 'none.json'", "deploy calibrate"),
        ("[target]\nsource = 'given'\nposition = [500.0, 0.0, 900.0]", "within 1.6 m of the base"),
        ("[capture]\nattempts = 1.5", "capture.attempts must be a whole number"),
    ):
        with pytest.raises(ProfileError) as error:
            text = TEXT.replace('[target]\nsource = "twin"\n', "") if "[target]" in wrong else TEXT
            parse_profile(text.format(twin="", loop="") + wrong, Path("test.toml"))
        assert words in str(error.value)
    with pytest.raises(ProfileError, match=r"arm\.driver is missing"):
        parse_profile("[camera]\ndriver = 'mock'", Path("x.toml"))
    with pytest.raises(ProfileError, match="is no TOML"):
        parse_profile("[arm", Path("x.toml"))
    with pytest.raises(ProfileError, match="give the path of a TOML file or one of"):
        load_profile("nothing")
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ProfileError, match="cannot be read as text"):
        load_profile(str(tmp_path / "binary.toml"))


def test_safety_has_the_camera_where_the_profile_says_that_it_was_measured() -> None:
    """A wall at the lens of a camera that sits 60 mm farther out than in the drawings."""
    mount = np.array(T_flange_camera_color_optical)
    mount[2, 3] += 0.06
    start = load_episode("held_out", EPISODE).start_joints
    lens = (forward_kinematics(torch.as_tensor(start[None]))[0].numpy() @ mount)[:3, 3]
    wall = (
        f"[safety]\nobstacles = [{{ low = {(lens - 0.005).tolist()}, high = {(lens + 0.005).tolist()} }}]\n"
        "obstacle_clearance = 0.01\n"
    )
    stay = JointMove(joint_positions=start, speed_fraction=0.1)
    for calibration, reason in (
        ("", None),
        (f"[calibration]\nT_flange_camera = {mount.tolist()}\n", "obstacle"),
    ):
        workcell = make_workcell(profile(more=wall + calibration), EPISODE)
        with workcell.arm:
            refusal = workcell.guarded_arm.safety.check(
                stay, workcell.guarded_arm.read(), workcell.clock.now()
            )
        assert (refusal.reason if refusal else None) == reason


def test_only_the_guarded_arm_commands_an_arm() -> None:
    import maniskill_tomato.deploy as package

    callers = {
        path.name
        for path in Path(str(package.__file__)).parent.rglob("*.py")
        if "_arm.command(" in path.read_text()
    }
    # The loop's `_arm` is a `GuardedArm`, which its type says; drivers define `command` but do not call one.
    assert callers == {"guarded_arm.py", "loop.py"}
    assert get_type_hints(Workcell)["guarded_arm"] is GuardedArm
