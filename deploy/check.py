"""The checks of `deploy check` before a first run: profile, devices, limits, policy, one picture."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from maniskill_tomato.deploy.capture import Capture
from maniskill_tomato.deploy.decision import TASK, decide, default_policy
from maniskill_tomato.deploy.deploy_errors import DeployError, RecordingError
from maniskill_tomato.deploy.interface import JointMove
from maniskill_tomato.deploy.profile import Profile
from maniskill_tomato.deploy.robot_perception import RobotBelief
from maniskill_tomato.deploy.workcell import Workcell, make_workcell
from maniskill_tomato.errors import TomatoError
from maniskill_tomato.files import write_atomically
from maniskill_tomato.policies.opening import open_policy
from maniskill_tomato.raycast.view_rays import NEAREST_DEPTH


@dataclass(frozen=True)
class Finding:
    """One line of the check."""

    what: str
    detail: str
    good: bool = True

    def __str__(self) -> str:
        return f"{'ok  ' if self.good else 'FAIL'}  {self.what:<12}  {self.detail}"


def check(profile: Profile, policy: str | None, seed: int, out: Path | None) -> Iterator[Finding]:
    """Looks at one thing after the other; nothing moves.

    Args:
        profile: Which devices.
        policy: As for `run`.
        seed: As for `run`.
        out: Folder for the picture; None to keep none.

    Yields:
        A finding each; after a device that cannot be used no more of it.
    """
    yield Finding("profile", f"{profile.name}: {profile.description}")
    name = default_policy() if policy is None else policy
    opened: Any = None
    try:
        opened = open_policy(name, env_id=TASK, seed=seed)
        yield Finding("policy", f"{name} ({opened.name})")
    except TomatoError as error:
        yield Finding("policy", str(error), good=False)
    try:
        workcell = make_workcell(profile, seed)
    except TomatoError as error:
        yield Finding("drivers", str(error), good=False)
        return
    where = np.round(profile.T_flange_camera[:3, 3] * 1e3, 1).tolist()
    yield Finding("calibration", f"camera at {where} mm from the flange, {_measured(profile)}")
    told = workcell.calibration_problems()
    for problem in told:
        yield Finding("calibration", problem, good=False)
    joints: Any = None
    try:
        with workcell.arm:
            yield Finding("arm", _facts(workcell.arm.describe()))
            joints = workcell.guarded_arm.read().joint_positions
            degrees = ", ".join(f"{v:.1f}" for v in np.rad2deg(joints))
            yield Finding("state", f"joints at ({degrees}) deg")
            stay = JointMove(joint_positions=joints, speed_fraction=profile.safety.speed_fraction)
            refusal = workcell.guarded_arm.safety.check(
                stay, workcell.guarded_arm.read(), workcell.clock.now()
            )
            detail = (
                f"the {workcell.arm.model.name} stands inside the envelope"
                if refusal is None
                else str(refusal)
            )
            yield Finding("limits", detail, refusal is None)
            can_stop = workcell.guarded_arm.can_stop
            detail = "can be stopped" if can_stop else "only the smartPAD or the emergency stop halts a move"
            yield Finding("stop", detail)
            with workcell.camera:
                for problem in workcell.calibration_problems():
                    if problem not in told:
                        yield Finding("calibration", problem, good=False)
                yield from _look(workcell, profile, joints, opened, out)
    except DeployError as error:
        yield Finding("device", str(error), good=False)


def _look(
    workcell: Workcell, profile: Profile, joints: Any, opened: Any, out: Path | None
) -> Iterator[Finding]:
    yield Finding("camera", _facts(workcell.camera.describe()))
    frame = Capture(workcell.camera, profile.capture, workcell.clock).take(-np.inf)
    share = float((frame.depth > 0.0).mean())
    near = float((frame.depth[frame.depth > 0.0] < 2.0 * NEAREST_DEPTH).mean()) if share else 0.0
    yield Finding(
        "picture",
        f"{frame.intrinsics.width} x {frame.intrinsics.height} px, {share:.0%} with depth, {near:.0%} of it "
        f"nearer than {2.0 * NEAREST_DEPTH:.1f} m",
    )
    if out is not None:
        path = out / "check.png"
        ok, content = cv2.imencode(".png", frame.color[..., ::-1])
        try:
            if ok:
                write_atomically(path, content.tobytes())
        except TomatoError as error:
            raise RecordingError(f"cannot write {path}: {error.__cause__ or error}") from error
        yield Finding("saved", str(path))
    perception = workcell.perception
    robot_belief = RobotBelief(profile.T_flange_camera, profile.loop.max_moves, model=workcell.arm.model)
    perception.begin(workcell.target_position())
    view = perception.look(frame, robot_belief.camera_pose(joints))
    if view is None:
        yield Finding("target", "no ripe fruit in the picture; point the camera at one", good=False)
        return
    yield Finding(
        "target",
        f"at {np.round(view.target_position, 3).tolist()} m, V_f {view.visible_fraction:.2f}, "
        f"{view.fruits_seen} ripe fruits in the picture",
    )
    if opened is None:
        return
    belief = robot_belief.observe(joints, view, profile.loop.max_moves)
    try:
        import torch

        opened.begin(belief, torch.zeros(1, dtype=torch.int64))
        action = decide(opened, belief)
        detail = f"answers {np.round(action, 3).tolist()} (right, up, forward; 1 is 0.12 m)"
        yield Finding("decision", detail)
    except TomatoError as error:
        yield Finding("decision", str(error), good=False)


def _measured(profile: Profile) -> str:
    facts = profile.calibration
    if facts is None:
        return "from the drawings"
    return (
        f"measured on {facts.taken or 'an unknown date'} with camera {facts.serial or 'without a number'}, "
        f"{facts.view_count} views, rms_px {facts.rms_px}"
    )


def _facts(facts: dict[str, Any]) -> str:
    return ", ".join(f"{key} {value}" for key, value in facts.items())


def print_findings(findings: Iterator[Finding], tell: Callable[[str], object] = print) -> bool:
    """Tells every finding as it comes; whether all are good."""
    good = True
    for finding in findings:
        tell(str(finding))
        good &= finding.good
    return good
