"""One run from a profile to its report."""

import logging
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from maniskill_tomato import __version__
from maniskill_tomato.deploy.clock import Clock
from maniskill_tomato.deploy.deploy_errors import ProfileError, RecordingError
from maniskill_tomato.deploy.loop_config import Mode, Proposal
from maniskill_tomato.deploy.policies import TASK, default_policy
from maniskill_tomato.deploy.profile import Profile
from maniskill_tomato.deploy.recording import McapRecorder
from maniskill_tomato.deploy.run_records import Recorder, RunResult, Step
from maniskill_tomato.deploy.run_report import Contact, write_report
from maniskill_tomato.deploy.stops import Stops
from maniskill_tomato.deploy.workcell import make_workcell, prepare_folder
from maniskill_tomato.policies.opening import open_policy

RECORDING = "run.mcap"
"""Name of the recording in the output folder."""

_logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True, eq=False)
class RunConfig:
    """What to run."""

    profile: Profile
    out: Path
    """Folder of result, recording and report."""
    policy: str | None = None
    """A planner's name or a policy's file; None for the one that ships."""
    seed: int = 0
    """Of the twin's episode and of planners that draw."""
    mode: Mode | None = None
    """None: unattended on the twin, dry run on hardware."""
    record: bool = True
    """Whether to write an MCAP file."""


class _Several:
    """Passes steps on to several recorders."""

    def __init__(self, recorders: list[Recorder]) -> None:
        self._recorders = recorders

    def step(self, step: Step) -> None:
        for recorder in self._recorders:
            recorder.step(step)

    def event(self, stamp: float, text: str) -> None:
        for recorder in self._recorders:
            recorder.event(stamp, text)


def run(
    config: RunConfig,
    confirm: Callable[[Proposal], bool] = lambda proposal: False,
    clock: Clock | None = None,
    keyboard: bool = False,
) -> RunResult:
    """Connects, runs, disconnects, and writes `result.json`, `report.png` and `run.mcap`.

    Args:
        config: What to run.
        confirm: Asked before every move in the mode `confirm`.
        clock: Another clock than the profile's.
        keyboard: Whether keys in a terminal stop the run.

    Returns:
        How it ended; faults during the run are told there.

    Raises:
        DeployError: It could not begin: a profile, a device or a folder cannot be used.
        PolicyError: The policy cannot be used.
        RecordingError: The folder or the recording cannot be begun.
    """
    profile = config.profile
    name = default_policy() if config.policy is None else config.policy
    policy = open_policy(name, env_id=TASK, seed=config.seed)
    workcell = make_workcell(profile, config.seed, clock)
    mode: Mode = config.mode or ("unattended" if workcell.simulated else "dry_run")
    if not workcell.simulated and not profile.calibrated:
        if mode != "dry_run":
            raise ProfileError(
                "the camera's place on the flange is not calibrated: run `maniskill-tomato deploy calibrate` and name "
                "its file in calibration.file; without it only a dry run is allowed"
            )
        _logger.warning("not calibrated: the camera's place on the flange is that of the drawings")
    facts: dict[str, Any] = {
        "profile": profile.name,
        "policy": name,
        "policy_name": policy.name,
        "perception": workcell.perception.name,
        "seed": config.seed,
        "mode": mode,
        "simulated": workcell.simulated,
        "version": __version__,
    }
    stop_file = prepare_folder(profile, config.out)
    contact = Contact()
    with ExitStack() as stack:
        arm = stack.enter_context(workcell.arm)
        camera = stack.enter_context(workcell.camera)
        devices = {"arm": arm.describe(), "camera": camera.describe()}
        recorders: list[Recorder] = [contact]
        if config.record:
            mount = profile.T_flange_camera.tolist()
            info = {**facts, "profile_text": profile.text, "T_flange_camera": mount, "devices": devices}
            recorders.append(stack.enter_context(McapRecorder(config.out / RECORDING, info)))
        stops = stack.enter_context(
            Stops(
                stop_file=stop_file,
                keyboard=keyboard,
                heartbeat_s=profile.stop.heartbeat,
                on_lost_heartbeat=workcell.guarded_arm.stop,
            )
        )
        result = workcell.loop(policy, stops, mode, _Several(recorders), confirm).run()
    try:
        write_report(config.out, result, {**facts, "devices": devices}, contact)
    except RecordingError as error:
        _logger.error("%s", error)
        if not result.is_fault:
            result = replace(result, reason=error.reason, detail=str(error), is_fault=True)
    return result
