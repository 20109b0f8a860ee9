"""Replays a recorded run through the current code and reports where its decisions differ.

The arm stands where it stood then, whatever is commanded now, and the camera shows the recorded pictures. Every
decision is therefore compared on the same pictures, even after one that differs.
"""

import base64
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch

from maniskill_tomato.deploy.clock import SimulatedClock
from maniskill_tomato.deploy.decision import TASK
from maniskill_tomato.deploy.deploy_errors import CutOffError, NotConnectedError, RecordingError
from maniskill_tomato.deploy.drivers import arm_model
from maniskill_tomato.deploy.fault_state import FaultState
from maniskill_tomato.deploy.guarded_arm import GuardedArm
from maniskill_tomato.deploy.inspection_run import whole_row
from maniskill_tomato.deploy.interface import Arm, ArmState, Camera, Float64, Frame, FrameTruth, JointMove
from maniskill_tomato.deploy.loop import Loop
from maniskill_tomato.deploy.profile import Profile, TargetConfig, parse_profile
from maniskill_tomato.deploy.recording_reader import (
    FORMATS,
    color_picture,
    decode_png,
    depth_picture,
    read_messages,
    unpack,
)
from maniskill_tomato.deploy.robot_perception import open_perception
from maniskill_tomato.deploy.run_records import RunResult, Step
from maniskill_tomato.deploy.safety import Safety
from maniskill_tomato.deploy.stops import Stops
from maniskill_tomato.deploy.workcell import Workcell
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.policies.opening import open_policy
from maniskill_tomato.policies.registry import POLICIES
from maniskill_tomato.raycast.view_rays import ViewRays
from maniskill_tomato.robot.arm_model import ArmModel
from maniskill_tomato.robot.d435 import CameraIntrinsics
from maniskill_tomato.robot.iiwa14 import IIWA14

TOLERANCE: Final = 1e-5
"""Actions, V_f and joint positions [rad] that differ by less are the same."""

BEFORE: Final = 1e-3
"""The arm stands still this long before a picture, in [s]."""


@dataclass(frozen=True, eq=False, kw_only=True)
class RecordedStep:
    """A look as the recording has it."""

    frame: Frame
    facts: dict[str, Any]
    """The message of `/step`."""


@dataclass(frozen=True, eq=False, kw_only=True)
class RecordedRun:
    """A recording, read."""

    info: dict[str, Any]
    """What was run."""
    profile: Profile
    steps: tuple[RecordedStep, ...]
    is_cut_off: bool
    """Whether the file ends early; `steps` are those that are whole."""
    fault: FaultState | None = None
    """What was known of a fault; None if there was none."""


@dataclass(frozen=True, kw_only=True)
class Difference:
    """A look at which today's code does something else."""

    step: int
    what: str
    """`action`, `visible_fraction`, `commanded`, `outcome` or `end`."""
    recorded: Any
    now: Any

    def __str__(self) -> str:
        return f"look {self.step}: {self.what} was {self.recorded}, is now {self.now}"


@dataclass(frozen=True, kw_only=True)
class Replay:
    """What came of it."""

    steps: int
    """Looks compared."""
    differences: tuple[Difference, ...]
    result: RunResult
    """How today's run ended."""


def load_recording(path: Path) -> RecordedRun:
    """Reads a recording of `deploy run` or `deploy inspect`; of one that was cut off, the looks that are whole.

    Raises:
        RecordingError: It is missing, damaged, of another kind, or holds neither a whole look nor a fault.
    """
    info: dict[str, Any] | None = None
    steps: list[RecordedStep] = []
    parts: dict[str, Any] = {}
    fault: FaultState | None = None
    is_cut_off = False
    try:
        for topic, message in read_messages(path):
            if topic == "/info":
                info = message
            elif topic == "/step":
                try:
                    steps.append(RecordedStep(frame=_frame(parts, message), facts=message))
                except (KeyError, TypeError, ValueError, AttributeError) as error:
                    raise RecordingError(f"{path}: look {len(steps)} is incomplete ({error})") from error
                parts = {}
            elif topic == "/fault":
                try:
                    fault = FaultState.from_json(message)
                except (KeyError, TypeError, ValueError, AttributeError) as error:
                    raise RecordingError(
                        f"{path}: what it says of a fault is incomplete ({error})"
                    ) from error
            elif topic != "/log":
                parts[topic] = message
    except CutOffError:
        is_cut_off = True
    if info is None or info.get("format") not in FORMATS:
        raise RecordingError(f"{path} is no recording of `deploy run` ({' or '.join(FORMATS)})")
    if not steps and fault is None:
        why = "it is cut off" if is_cut_off else "the run ended"
        raise RecordingError(f"{path} holds no look; {why} before its first")
    name = Path(f"{info.get('profile', 'recorded')}.toml")
    mount = info.get("T_flange_camera")
    profile = parse_profile(str(info["profile_text"]), path.parent / name, mount)
    return RecordedRun(info=info, profile=profile, steps=tuple(steps), is_cut_off=is_cut_off, fault=fault)


def replay(recorded: RecordedRun, policy: str | None = None) -> Replay:
    """Runs the loop over a recording.

    Args:
        recorded: Which.
        policy: Another policy than the recorded one.

    Raises:
        DeployError: The recording's profile or policy cannot be used today, or it holds a fault and no look.
    """
    if not recorded.steps:
        raise RecordingError("the recording holds a fault and no look; there is nothing to replay")
    clock = SimulatedClock(recorded.steps[0].frame.stamp - BEFORE)
    playback = _Playback(recorded.steps, clock)
    comparison = _Comparison(recorded.steps)
    opened = open_policy(policy or _recorded_policy(recorded), env_id=TASK, seed=int(recorded.info["seed"]))
    workcell, row_moves = _played_workcell(recorded, playback), recorded.info.get("row_moves")
    goal = None if row_moves is None else whole_row(workcell, int(row_moves))
    result = Loop(workcell, opened, Stops(), "unattended", [comparison], goal=goal).run()
    differences = list(comparison.differences)
    last = recorded.steps[-1].facts["outcome"]
    if comparison.count < len(recorded.steps):
        differences.append(
            Difference(step=comparison.count, what="end", recorded="went on", now=result.reason)
        )
    elif playback.exhausted and last not in ("moved", "refused", "broken off"):
        differences.append(Difference(step=comparison.count, what="end", recorded=last, now="goes on"))
    return Replay(steps=comparison.count, differences=tuple(differences), result=result)


def _recorded_policy(recorded: RecordedRun) -> str:
    name = str(recorded.info["policy"])
    try:
        POLICIES.check_recorded(name, "the recording", f"name it with --policy {name}")
    except InvalidInputError as error:
        raise RecordingError(str(error)) from error
    return name


def _played_workcell(recorded: RecordedRun, playback: "_Playback") -> Workcell:
    profile, clock = recorded.profile, playback.clock
    target = profile.target
    truth = recorded.steps[0].frame.truth
    if target.source == "twin" and truth is not None:
        x, y, z = (float(c) for c in truth.target_position)
        target = TargetConfig(source="given", position=(x, y, z))
    profile = replace(
        profile,
        target=target,
        # A look's other attempts were not recorded.
        capture=replace(profile.capture, attempts=1),
        loop=replace(profile.loop, settle=0.0),
    )
    arm = _PlayedArm(playback, arm_model(str(recorded.info.get("arm_model", IIWA14.name))))
    return Workcell(
        profile=profile,
        clock=clock,
        arm=arm,
        camera=_PlayedCamera(playback),
        guarded_arm=_PlayedGuard(arm, Safety(profile.safety, profile.T_flange_camera, arm.model), clock),
        perception=open_perception(profile.perception.sight, profile.perception.segmenter),
    )


class _Playback:
    """Where in the recording the devices are."""

    def __init__(self, steps: tuple[RecordedStep, ...], clock: SimulatedClock) -> None:
        self.steps, self.clock = steps, clock
        self.at = 0
        self._next = 0
        self.exhausted = False

    def next_frame(self) -> Frame:
        if self._next >= len(self.steps):
            self.exhausted = True
            raise NotConnectedError("the recording ends here")
        self.at, self._next = self._next, self._next + 1
        frame = self.steps[self.at].frame
        self.clock.set(max(self.clock.now(), frame.stamp))
        return frame

    def arrive(self) -> None:
        """The arm goes where it stood at the next look."""
        if self._next < len(self.steps):
            self.at = self._next
            self.clock.set(max(self.clock.now(), self.steps[self.at].frame.stamp - BEFORE))

    @property
    def joints(self) -> Float64:
        return np.array(self.steps[self.at].facts["joint_positions"])


class _PlayedArm(Arm):
    name = "playback"
    simulated = True
    can_stop = True

    def __init__(self, playback: _Playback, model: ArmModel) -> None:
        self._playback, self.model = playback, model

    @property
    def is_connected(self) -> bool:
        return True

    def connect(self) -> None: ...

    def disconnect(self) -> None: ...

    def read(self, max_age_s: float = 0.5) -> ArmState:
        return ArmState(
            joint_positions=self._playback.joints,
            joint_velocities=np.zeros(7),
            stamp=self._playback.clock.now(),
        )

    def command(self, move: JointMove) -> JointMove:
        self._playback.arrive()
        return move

    def wait(self, timeout_s: float) -> bool:
        return True

    def stop(self) -> bool:
        return True


class _PlayedGuard(GuardedArm):
    """The arm arrives where it arrived then, whatever is commanded now."""

    def wait(self, timeout_s: float) -> bool:
        self._under_way, self._watches = None, False
        return True


class _PlayedCamera(Camera):
    name = "playback"
    simulated = True

    def __init__(self, playback: _Playback) -> None:
        self._playback = playback

    @property
    def intrinsics(self) -> CameraIntrinsics:
        return self._playback.steps[0].frame.intrinsics

    @property
    def is_connected(self) -> bool:
        return True

    def connect(self) -> None: ...

    def disconnect(self) -> None: ...

    def read(self, max_age_s: float = 0.5, after: float | None = None) -> Frame:
        return self._playback.next_frame()


class _Comparison:
    """A recorder that holds today's steps against the recorded ones."""

    def __init__(self, steps: tuple[RecordedStep, ...]) -> None:
        self._steps = steps
        self.count = 0
        self.differences: list[Difference] = []

    def step(self, step: Step) -> None:
        facts = self._steps[step.number].facts
        self.count = step.number + 1
        commanded = None if step.commanded is None else step.commanded.tolist()
        for what, recorded, now in (
            ("visible_fraction", facts["visible_fraction"], step.view.visible_fraction),
            ("action", facts["action"], None if step.action is None else list(step.action)),
            ("commanded", facts["commanded"], commanded),
        ):
            if not _same(recorded, now):
                self.differences.append(Difference(step=step.number, what=what, recorded=recorded, now=now))
        if facts["outcome"] not in (step.outcome, "broken off", "dry_run", "declined"):
            self.differences.append(
                Difference(step=step.number, what="outcome", recorded=facts["outcome"], now=step.outcome)
            )

    def event(self, stamp: float, text: str) -> None:
        pass


def _same(recorded: Any, now: Any) -> bool:
    if recorded is None or now is None:
        return recorded is now
    return bool(np.allclose(np.array(recorded), np.array(now), rtol=0.0, atol=TOLERANCE))


def _frame(parts: dict[str, Any], facts: dict[str, Any]) -> Frame:
    intrinsics = CameraIntrinsics(**facts["intrinsics"])
    return Frame(
        color=color_picture(parts),
        depth=depth_picture(parts, (intrinsics.height, intrinsics.width)),
        intrinsics=intrinsics,
        stamp=float(facts["stamp"]),
        number=int(facts["frame_number"]),
        truth=_truth(parts["/truth"]) if "/truth" in parts else None,
    )


def _truth(message: dict[str, Any]) -> FrameTruth:
    rays = {name: torch.from_numpy(unpack(packed)) for name, packed in message["rays"].items()}
    return FrameTruth(
        labels=decode_png(base64.b64decode(message["labels"])).astype(np.int32),
        target_label=int(message["target_label"]),
        target_position=np.array(message["target_position"], dtype=np.float64),
        visible_fraction=float(message["visible_fraction"]),
        ripe_labels=tuple(int(label) for label in message["ripe_labels"]),
        rays=ViewRays(rays["direction_c"], rays["distance"], rays["label"]),
        fruit_labels=tuple(int(label) for label in message.get("fruit_labels", ())),
        stem_labels=tuple(int(label) for label in message.get("stem_labels", ())),
        ripe_fractions=tuple(float(v) for v in message.get("ripe_fractions", ())),
    )


def each_difference(found: Replay, most: int = 20) -> Iterator[str]:
    """Lines for people."""
    for difference in found.differences[:most]:
        yield str(difference)
    if len(found.differences) > most:
        yield f"and {len(found.differences) - most} more"
