"""The inspection of a row from a profile to its list: `inspection.json`, a picture a fruit, `report.png` and
`report.html`."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from maniskill_tomato.deploy.clock import Clock
from maniskill_tomato.deploy.deploy_errors import ProfileError
from maniskill_tomato.deploy.inspection_report import front_view, fruit_picture, overview, write_page
from maniskill_tomato.deploy.interface import Float64
from maniskill_tomato.deploy.policy_run import (
    Prepared,
    RunConfig,
    StepFacts,
    as_json,
    as_png,
    kept_result,
    prepare,
    result_facts,
    run_goal,
    write_files,
)
from maniskill_tomato.deploy.robot_perception import ImagePerception
from maniskill_tomato.deploy.row_goal import WholeRow
from maniskill_tomato.deploy.run_records import Proposal, Recorder, RunResult
from maniskill_tomato.deploy.workcell import Workcell
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.folder_lock import only_writer
from maniskill_tomato.sensing.inspection import InspectedFruit
from maniskill_tomato.sensing.inspection_judge import JudgedFruit

PICTURES: Final = "fruits"
"""Folder of the fruits' pictures."""


@dataclass(frozen=True, kw_only=True)
class InspectionResult:
    """How an inspection ended."""

    run: RunResult
    fruits: tuple[dict[str, Any], ...]
    """The list, as in `inspection.json`."""
    totals: dict[str, Any]
    """What the twin makes of it; empty on hardware."""
    judged: tuple[JudgedFruit, ...]
    """The fruits of the list beside the twin's truth; empty on hardware."""


def inspect_row(
    config: RunConfig,
    row_moves: int = 120,
    confirm: Callable[[Proposal], bool] = lambda proposal: False,
    clock: Clock | None = None,
    keyboard: bool = False,
    recorders: Sequence[Recorder] = (),
) -> InspectionResult:
    """Connects, inspects, disconnects, and writes the list and the report; a run that was stopped too has a list.

    Args:
        config: What to run; the profile's target is not used.
        row_moves: The most moves for the row.
        confirm: Asked before every move in the mode `confirm`.
        clock: Another clock than the profile's.
        keyboard: Whether keys in a terminal stop the run.
        recorders: Keep every step, beside the recording.

    Raises:
        StoppedError: A signal came before the first look, when nothing had moved.
        DeployError: It could not begin: a profile, a device or a folder cannot be used.
        PolicyError: The policy cannot be used.
        RecordingError: The recording cannot be begun.
        CheckpointError: The folder cannot be made, or another process runs in it.
        InvalidInputError: `row_moves` is less than 1.
    """
    if row_moves < 1:
        raise InvalidInputError(f"row_moves must be 1 or more, got {row_moves}")
    prepared = prepare(config, clock)
    prepared.facts["row_moves"] = row_moves
    goal = whole_row(prepared.workcell, row_moves)
    steps = StepFacts()
    with only_writer(config.out, "runs"):
        result, facts = run_goal(config, prepared, goal, [steps, *recorders], confirm, keyboard)
        return _report(config, prepared, goal, steps, result, facts)


def _report(
    config: RunConfig,
    prepared: Prepared,
    goal: WholeRow,
    steps: StepFacts,
    result: RunResult,
    facts: dict[str, Any],
) -> InspectionResult:
    """Writes the list and its pages, with the truth beside them on the twin."""
    fruits = goal.fruits()
    entries = [_entry(fruit) for fruit in fruits]
    totals: dict[str, Any] = {}
    judged: list[JudgedFruit] = []
    world = prepared.workcell.twin()
    if world is not None:
        from maniskill_tomato.deploy.mock.twin_judge import judge, true_facts

        judged, totals = judge(world, fruits, goal.view_joints, config.profile.loop.threshold)
        plant = world.episode.plant
        entries = [{**entry, **true_facts(true, plant)} for entry, true in zip(entries, judged, strict=True)]

    def write() -> None:
        content = {**result_facts(result), **facts, **totals, "fruits": entries, "steps": steps.steps}
        pictures = [fruit_picture(fruit) for fruit in fruits]
        shown = [picture for picture in pictures if picture is not None]
        cameras: list[Float64] = [np.array(step["camera"]) for step in steps.steps]
        title = (
            f"{facts['profile']}, seed {facts['seed']}, {facts['policy_name']}: {result.reason}, "
            f"{len(fruits)} fruits after {result.moves} moves"
        )
        files = {
            entry["picture"]: as_png(picture)
            for entry, picture in zip(entries, pictures, strict=True)
            if picture is not None
        }
        files["report.png"] = as_png(overview(title, fruits, cameras, shown))
        # The list first: what matters most when the disk is nearly full.
        write_files(config.out, {"inspection.json": as_json(content), **files})
        html = config.out / "report.html"
        write_files(
            config.out, {html.name: write_page(html, content, entries, as_png(front_view(fruits, cameras)))}
        )

    result = kept_result(result, write)
    return InspectionResult(run=result, fruits=tuple(entries), totals=totals, judged=tuple(judged))


def whole_row(workcell: Workcell, row_moves: int) -> WholeRow:
    """The goal of an inspection.

    Raises:
        ProfileError: The profile's perception follows one target only.
    """
    perception, profile = workcell.perception, workcell.profile
    if not isinstance(perception, ImagePerception):
        raise ProfileError("perception.sight = 'rays' follows one target; an inspection needs 'images'")
    return WholeRow(perception, profile.loop, row_moves, workcell.arm.model)


def _entry(fruit: InspectedFruit) -> dict[str, Any]:
    best = fruit.best
    has_picture = best is not None and best.picture is not None
    return {
        "number": fruit.number,
        "position_m": np.round(fruit.position_w, 5).tolist(),
        "position_error_m": round(fruit.position_error_m, 5),
        "radius_m": round(fruit.radius_m, 5),
        "ripeness": "ripe" if fruit.is_ripe else "unripe",
        "visible_fraction": round(fruit.visible_fraction, 4),
        "fraction_error": round(fruit.fraction_error, 4),
        "fully_seen": fruit.is_fully_seen,
        "best_view": None if best is None else np.round(best.T_world_camera, 6).tolist(),
        "approach": None if fruit.approach_w is None else np.round(fruit.approach_w, 5).tolist(),
        "picture": f"{PICTURES}/{fruit.number:03d}.png" if has_picture else None,
        "views": fruit.views,
    }
