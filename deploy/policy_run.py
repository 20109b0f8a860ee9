"""One run from a profile to its report: `result.json`, `report.html` and `report.png` with every look, `run.mcap`."""

import json
import logging
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from maniskill_tomato import __version__
from maniskill_tomato.deploy.clock import Clock
from maniskill_tomato.deploy.decision import TASK, default_policy
from maniskill_tomato.deploy.deploy_errors import RecordingError, StoppedError
from maniskill_tomato.deploy.fault_state import FaultState, early_fault
from maniskill_tomato.deploy.goal import Goal
from maniskill_tomato.deploy.interface import Float64
from maniskill_tomato.deploy.loop import Loop
from maniskill_tomato.deploy.profile import Profile
from maniskill_tomato.deploy.recording import McapRecorder
from maniskill_tomato.deploy.run_page import Look, run_page
from maniskill_tomato.deploy.run_records import Mode, Proposal, Recorder, RunResult, Step
from maniskill_tomato.deploy.workcell import Workcell, make_workcell
from maniskill_tomato.errors import TomatoError
from maniskill_tomato.files import write_atomically
from maniskill_tomato.folder_lock import only_writer
from maniskill_tomato.policies.adapters import check_control_mode
from maniskill_tomato.policies.opening import open_policy
from maniskill_tomato.policies.protocol import Policy
from maniskill_tomato.report_design import INK, rgb
from maniskill_tomato.robot.arm_model import ArmModel
from maniskill_tomato.robot.iiwa14 import IIWA14
from maniskill_tomato.warp_runtime import load_kernels

TILE: Final = (320, 240)
"""Largest size of one look, in [px]."""
LINE: Final = 15
"""Height of a line of the caption below it, in [px]."""
COLUMNS: Final = 5
MARK = (0, 230, 255)
"""Outline of the target; RGB."""


RECORDING = "run.mcap"
"""Name of the recording in the output folder."""

FAULT_RECORDING = "fault.mcap"
"""Of one that holds a fault alone: where no recording was asked for, or it cannot be written to."""

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


def run(
    config: RunConfig,
    confirm: Callable[[Proposal], bool] = lambda proposal: False,
    clock: Clock | None = None,
    keyboard: bool = False,
    recorders: Sequence[Recorder] = (),
) -> RunResult:
    """Connects, runs, disconnects, and writes `result.json`, `report.html`, `report.png` and `run.mcap`.

    Args:
        config: What to run.
        confirm: Asked before every move in the mode `confirm`.
        clock: Another clock than the profile's.
        keyboard: Whether keys in a terminal stop the run.
        recorders: Are told every look, beside the recording and the report.

    Returns:
        How it ended; faults during the run are told there.

    Raises:
        StoppedError: A signal came before the first look, when nothing had moved.
        DeployError: It could not begin: a profile, a device or a folder cannot be used.
        PolicyError: The policy cannot be used.
        RecordingError: The recording cannot be begun.
        CheckpointError: The folder cannot be made, or another process runs in it.
    """
    sheet = ContactSheet()
    prepared = prepare(config, clock)
    with only_writer(config.out, "runs"):
        result, facts = run_goal(config, prepared, None, [sheet, *recorders], confirm, keyboard)
        return kept_result(result, lambda: write_report(config.out, result, facts, sheet))


@dataclass(frozen=True, kw_only=True, eq=False)
class Prepared:
    """A run whose devices are not opened yet."""

    workcell: Workcell
    policy: Policy
    mode: Mode
    facts: dict[str, Any]
    """For the result."""


def prepare(config: RunConfig, clock: Clock | None = None) -> Prepared:
    """Opens the policy and makes the devices of a profile, without touching any.

    Raises:
        DeployError: The profile cannot be used, or the camera is not calibrated and a real arm shall move.
        PolicyError: The policy cannot be used.
    """
    profile = config.profile
    name = default_policy() if config.policy is None else config.policy
    policy = open_policy(name, env_id=TASK, seed=config.seed)
    check_control_mode(policy, "pd_look_at")
    workcell = make_workcell(profile, config.seed, clock)
    mode: Mode = config.mode or ("unattended" if workcell.simulated else "dry_run")
    if mode != "dry_run":
        workcell.check_calibration()
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
    return Prepared(workcell=workcell, policy=policy, mode=mode, facts=facts)


def run_goal(
    config: RunConfig,
    prepared: Prepared,
    goal: Goal | None,
    recorders: Sequence[Recorder],
    confirm: Callable[[Proposal], bool] = lambda proposal: False,
    keyboard: bool = False,
) -> tuple[RunResult, dict[str, Any]]:
    """Connects, runs and disconnects.

    Args:
        config: What to run.
        prepared: From `prepare`.
        goal: What the run is after; None for the profile's target.
        recorders: Keep every step, beside the recording.
        confirm: Asked before every move in the mode `confirm`.
        keyboard: Whether keys in a terminal stop the run.

    Returns:
        How it ended, and what a result tells beside that.

    Raises:
        StoppedError: A signal came before the first look, when nothing had moved.
    """
    profile, workcell = config.profile, prepared.workcell
    stops = workcell.listen(config.out, keyboard)
    with suppress(OSError):
        (config.out / FAULT_RECORDING).unlink()
    mount, facts = profile.T_flange_camera, prepared.facts
    info = {**facts, "profile_text": profile.text, "T_flange_camera": mount.tolist()}
    recorder: McapRecorder | None = None

    def keep(fault: FaultState) -> str:
        return keep_fault(fault, recorder, config.out, info, workcell.clock, mount, workcell.arm.model)

    with ExitStack() as stack:
        # The first to be entered is the last to be left: no signal ends the program before the devices are let go.
        stack.enter_context(stops)
        with stops.interrupting():
            arm = stack.enter_context(workcell.arm)
            camera = stack.enter_context(workcell.camera)
            if prepared.mode != "dry_run":
                workcell.check_calibration()
            for problem in workcell.calibration_problems():
                _logger.warning("only a dry run: %s", problem)
            facts = {**facts, "devices": {"arm": arm.describe(), "camera": camera.describe()}}
            info |= facts
        every = list(recorders)
        if config.record:
            # A signal waits until the file is one that can be finished.
            recorder = McapRecorder(config.out / RECORDING, info, workcell.clock, mount, workcell.arm.model)
            every.append(stack.enter_context(recorder))
        try:
            # What is slow the first time is done before the loop's first beat, from which on the heartbeat is watched.
            with stops.interrupting():
                load_kernels()
                workcell.perception.warm_up(camera.intrinsics)
            result = Loop(workcell, prepared.policy, stops, prepared.mode, every, confirm, goal).run()
        except StoppedError:
            raise
        except Exception as error:
            # Before the loop's first look, in which nothing moves.
            keep(early_fault(error))
            raise
        finally:
            stops.rest()
        if result.fault is not None:
            result = replace(result, fault_file=keep(result.fault))
    return result, facts


def keep_fault(
    fault: FaultState,
    recorder: McapRecorder | None,
    out: Path,
    info: dict[str, Any],
    clock: Clock,
    T_flange_camera: Float64,
    model: ArmModel = IIWA14,
) -> str:
    """Writes what is known of a fault into the run's recording, or into one of its own. Never raises.

    Args:
        fault: What is known.
        recorder: Of the run; None if it has none.
        out: Folder of the run.
        info: What was run, for a recording of its own.
        clock: Of the run.
        T_flange_camera: The colour camera's optical frame in `link_ee`. Shape (4, 4).
        model: Of the arm.

    Returns:
        Name of the file that holds it; empty if the disk takes none.
    """
    try:
        if recorder is not None:
            recorder.fault(fault)
            return recorder.path.name
    except RecordingError as error:
        _logger.warning("%s", error)
    path = out / FAULT_RECORDING
    try:
        with McapRecorder(path, info, clock, T_flange_camera, model) as alone:
            alone.fault(fault)
        return path.name
    except (TomatoError, OSError) as error:
        _logger.error("the state at the fault is lost: %s", error)
        with suppress(OSError):
            path.unlink(missing_ok=True)
        return ""


def kept_result(result: RunResult, write: Callable[[], None]) -> RunResult:
    """Writes a report; the result, which becomes a fault where the disk does not take it."""
    try:
        write()
    except RecordingError as error:
        result = replace(result, report_error=str(error))
        if not result.is_fault:
            result = replace(result, reason=error.reason, detail=str(error), is_fault=True)
    return result


class StepFacts:
    """A recorder that keeps what a result tells of every look."""

    def __init__(self) -> None:
        self.steps: list[dict[str, Any]] = []

    def step(self, step: Step) -> None:
        self.steps.append(
            {
                "number": step.number,
                "visible_fraction": round(step.view.visible_fraction, 4),
                "camera": np.round(step.T_world_camera[:3, 3], 4).tolist(),
                "action": None if step.action is None else [round(v, 4) for v in step.action],
                "outcome": step.outcome,
                "detail": step.detail,
                "timing_ms": step.timing_ms,
            }
        )

    def event(self, stamp: float, text: str) -> None:
        pass


class ContactSheet(StepFacts):
    """Keeps a small picture of every look too."""

    def __init__(self) -> None:
        super().__init__()
        self.looks: list[Look] = []

    def step(self, step: Step) -> None:
        super().step(step)
        self.looks.append(_look(step))

    def picture(self, title: str) -> NDArray[np.uint8]:
        """All looks side by side under a title; no text is cut. Shape (H, W, 3)."""
        if not self.looks:
            return np.full((60, 400, 3), 255, dtype=np.uint8)
        columns = min(COLUMNS, len(self.looks))
        width = max(look.picture.shape[1] for look in self.looks)
        sheet_width = columns * (width + 8) + 8
        captions = [
            [(look.title, 0.42), *((line, 0.36) for line in wrap_text(look.outcome, width - 8, 0.36))]
            for look in self.looks
        ]
        height = max(
            look.picture.shape[0] + LINE * len(lines) + 6
            for look, lines in zip(self.looks, captions, strict=True)
        )
        head = wrap_text(title, sheet_width - 20, 0.55)
        top = 12 + 22 * len(head)
        rows = math.ceil(len(self.looks) / columns)
        sheet = np.full((top + rows * (height + 8), sheet_width, 3), 255, dtype=np.uint8)
        for k, line in enumerate(head):
            write_text(sheet, line, (10, 22 * (k + 1)), 0.55)
        for k, (look, lines) in enumerate(zip(self.looks, captions, strict=True)):
            y, x = top + (k // columns) * (height + 8), 8 + (k % columns) * (width + 8)
            h, w = look.picture.shape[:2]
            sheet[y : y + h, x : x + w] = look.picture
            for row, (line, size) in enumerate(lines, start=1):
                write_text(sheet, line, (x + 4, y + h + LINE * row), size)
        return sheet


def write_report(out: Path, result: RunResult, facts: dict[str, Any], sheet: ContactSheet) -> None:
    """Writes `result.json`, `report.png` and `report.html`.

    Raises:
        RecordingError: The disk does not take them.
    """
    content = {**result_facts(result), **facts, "steps": sheet.steps}
    title = (
        f"{facts.get('profile')}, seed {facts.get('seed')}, {facts.get('policy_name')}: {result.reason}, "
        f"V_f {result.visible_fraction:.2f} after {result.moves} moves"
    )
    # The result first: what matters most when the disk is nearly full.
    write_files(out, {"result.json": as_json(content), "report.png": as_png(sheet.picture(title))})
    write_files(out, {"report.html": run_page(result, facts, sheet.looks, sheet.steps)})


def result_facts(result: RunResult) -> dict[str, Any]:
    """A result in plain numbers, rounded."""
    content = result.to_json()
    for name in ("seconds", "device_seconds", "visible_fraction", "best_visible_fraction"):
        content[name] = round(content[name], 4)
    if result.true_visible_fraction is not None:
        content["true_visible_fraction"] = round(result.true_visible_fraction, 4)
    return content


def as_json(content: dict[str, Any]) -> bytes:
    """A JSON file's content."""
    return (json.dumps(content, indent=2) + "\n").encode()


def as_png(picture: NDArray[np.uint8]) -> bytes:
    """A PNG file's content. Shape (H, W, 3)."""
    ok, encoded = cv2.imencode(".png", picture[..., ::-1])
    if not ok:
        raise RecordingError(f"a picture of shape {picture.shape} cannot be packed as PNG")
    return encoded.tobytes()


def write_files(out: Path, files: Mapping[str, bytes]) -> None:
    """Writes files of a report.

    Raises:
        RecordingError: The disk does not take them.
    """
    try:
        for name, content in files.items():
            (out / name).parent.mkdir(parents=True, exist_ok=True)
            write_atomically(out / name, content)
    except (TomatoError, OSError) as error:
        raise RecordingError(f"cannot write the report into {out}: {error.__cause__ or error}") from error


def _look(step: Step) -> Look:
    color = step.frame.color.copy()
    scale = min(TILE[0] / color.shape[1], TILE[1] / color.shape[0])
    size = (round(color.shape[1] * scale), round(color.shape[0] * scale))
    small: Any = cv2.resize(color, size, interpolation=cv2.INTER_AREA)
    mask: Any = cv2.resize(step.view.mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(small, outlines, -1, MARK, 2)
    centre = step.T_world_camera[:3, :3].T @ (step.target_position - step.T_world_camera[:3, 3])
    if centre[2] > 0.0:
        i = step.frame.intrinsics
        u = round((i.fx * centre[0] / centre[2] + i.cx) * scale)
        v = round((i.fy * centre[1] / centre[2] + i.cy) * scale)
        cv2.drawMarker(small, (u, v), MARK, cv2.MARKER_CROSS, 9, 1)
    return Look(
        picture=small,
        title=f"{step.number}: V_f {step.view.visible_fraction:.2f}",
        outcome=step.outcome if not step.detail else f"{step.outcome}: {step.detail}",
    )


def wrap_text(text: str, width: int, size: float) -> list[str]:
    """A text in lines that `write_text` fits into a width; a word that is wider is broken.

    Args:
        text: One line.
        width: In [px].
        size: As for `write_text`.
    """

    def fits(line: str) -> bool:
        return int(cv2.getTextSize(line, cv2.FONT_HERSHEY_SIMPLEX, size, 1)[0][0]) <= width

    lines = [""]
    for word in text.split():
        joined = f"{lines[-1]} {word}".strip()
        if fits(joined):
            lines[-1] = joined
            continue
        if lines[-1]:
            lines.append("")
        while not fits(word):
            part = next(n for n in range(len(word) - 1, 0, -1) if n == 1 or fits(word[:n]))
            lines[-1], word = word[:part], word[part:]
            lines.append("")
        lines[-1] = word
    return lines


def write_text(image: NDArray[np.uint8], text: str, at: tuple[int, int], size: float) -> None:
    cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, rgb(INK), 1, cv2.LINE_AA)
