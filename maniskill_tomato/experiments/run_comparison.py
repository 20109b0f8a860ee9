"""Runs compared: grouped by configuration over seeds, with interquartile means, intervals and a page."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

import maniskill_tomato
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.experiments.comparison_plots import PANELS, best_groups, plot_curves
from maniskill_tomato.experiments.configs import RunComparisonConfig
from maniskill_tomato.experiments.evaluation import evaluate_run
from maniskill_tomato.experiments.statistics import Interval, interquartile_interval, interval_text
from maniskill_tomato.experiments.training_runs import Group, Run, find_runs, load_run
from maniskill_tomato.files import write_atomically, write_json
from maniskill_tomato.learning.rl.presets import PRESETS, TrainConfig, modernise
from maniskill_tomato.report_design import (
    figure,
    markdown_table,
    page,
    paragraph,
    percent,
    section,
    side_by_side,
    table,
    tile,
    tiles,
)
from maniskill_tomato.run_facts import run_facts

HEAD = ("task", "configuration", "seeds", "success", "mean steps", "training steps", "training time")

METHOD = (
    "Success and steps are interquartile means over the seeds (floor(n / 4) values left out at either end) with 95 % "
    "percentile intervals of a bootstrap over the seeds, stratified by task; failures count with all their steps. The "
    "interval says how much training runs differ, and is rough for fewer than five; runs that agree exactly give one "
    "of no width. Training steps and time are means."
)


@dataclass(frozen=True, kw_only=True)
class ComparisonRow:
    """One configuration on one task, or on all of its tasks together."""

    task: str
    label: str
    seeds: tuple[int, ...]
    """Seeds of the evaluated runs, or of all where none was evaluated."""
    success_rate: Interval | None
    """None if no run was evaluated."""
    mean_steps: Interval | None
    training_steps: float | None
    """Mean over the runs."""
    training_seconds: float | None
    """Mean over the runs, in [s]; None if one of them did not log it."""


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """What a comparison found and wrote."""

    table: str
    """As Markdown."""
    report: Path
    """report.html, which needs no other file."""


def compare_runs(config: RunComparisonConfig) -> Comparison:
    """Compares training runs; writes comparison.json, curves-TASK-N.png and report.html.

    Raises:
        InvalidInputError: A folder holds no run, or a run cannot be read, compared or evaluated.
    """
    loaded = [load_run(path) for path in find_runs(config.runs)]
    if config.evaluate is not None:
        torch.set_num_threads(1)
        for index, run in enumerate(loaded):
            if run.metrics is None:
                evaluate_run(run, config.evaluate, config.eval_seed)
                loaded[index] = load_run(run.path)
    return write_comparison(group_runs(loaded), config.out)


def make_rows(groups: Sequence[Group]) -> list[ComparisonRow]:
    """A row for every group, and one more for every configuration that was evaluated on several tasks."""
    rows = [_row(group.env_id, [group]) for group in groups]
    by_label: dict[str, list[Group]] = {}
    for group in groups:
        if len(group.scores("success_rate")):
            by_label.setdefault(group.label, []).append(group)
    rows += [_row(f"{len(same)} tasks", same) for same in by_label.values() if len(same) > 1]
    return rows


def write_comparison(groups: Sequence[Group], out: Path) -> Comparison:
    """Writes comparison.json, curves-TASK-N.png and report.html into `out`."""
    out.mkdir(parents=True, exist_ok=True)
    rows = make_rows(groups)
    pictures = []
    for env_id in dict.fromkeys(group.env_id for group in groups):
        of_task = [group for group in groups if group.env_id == env_id]
        pictures.append((of_task, plot_curves(of_task, out / f"curves-{env_id}.png")))
    note = evaluation_note(groups)
    content = {
        "package_version": maniskill_tomato.__version__,
        "rows": [asdict(row) for row in rows],
        "runs": [
            {
                "path": str(run.path),
                "env_id": group.env_id,
                "label": group.label,
                "seed": run.seed,
                "success_rate": run.metrics and run.metrics["success_rate"],
                "mean_steps": run.metrics and run.metrics["mean_steps"],
                "training_steps": run.training_steps,
                "training_seconds": run.training_seconds,
            }
            for group in groups
            for run in group.runs
        ],
        "note": note,
    }
    write_json(out / "comparison.json", content)
    cells = [_cells(row) for row in rows]
    report = out / "report.html"
    write_atomically(report, _page(cells, rows, groups, pictures, note).encode())
    return Comparison(table=markdown_table(HEAD, cells), report=report)


def evaluation_note(groups: Sequence[Group]) -> str:
    """On which episodes the runs were evaluated, and a warning where they were not the same."""
    used = sorted(
        {
            (int(run.metrics["episodes"]), int(run.metrics["seed"]))
            for group in groups
            for run in group.runs
            if run.metrics is not None
        }
    )
    listed = " and ".join(f"{episodes} episodes from seed {seed}" for episodes, seed in used)
    missing = sum(run.metrics is None for group in groups for run in group.runs)
    parts = [f"Evaluated on {listed}." if used else "No run was evaluated."]
    if len(used) > 1:
        parts.append("These are different episodes, so that small differences mean nothing.")
    if used and missing:
        parts.append(f"Not evaluated: {missing} of the runs. --evaluate 100 judges them.")
    return " ".join(parts)


def _row(task: str, groups: Sequence[Group]) -> ComparisonRow:
    def interval(metric: str) -> Interval | None:
        strata = [scores for group in groups if len(scores := group.scores(metric))]
        return interquartile_interval(strata) if strata else None

    runs = [run for group in groups for run in group.runs]
    runs = [run for run in runs if run.metrics is not None] or runs
    return ComparisonRow(
        task=task,
        label=groups[0].label,
        seeds=tuple(sorted({run.seed for run in runs})),
        success_rate=interval("success_rate"),
        mean_steps=interval("mean_steps"),
        training_steps=_mean([run.training_steps for run in runs]),
        training_seconds=_mean([run.training_seconds for run in runs]),
    )


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if len(known) == len(values) else None


def _cells(row: ComparisonRow) -> tuple[str, ...]:
    return (
        row.task,
        row.label,
        ", ".join(str(seed) for seed in row.seeds),
        interval_text(row.success_rate, 100.0, "{:.1f}", " %"),
        interval_text(row.mean_steps, 1.0, "{:.2f}", ""),
        "not known" if row.training_steps is None else f"{row.training_steps:,.0f}",
        "not logged" if row.training_seconds is None else f"{row.training_seconds:.0f} s",
    )


def group_runs(runs: Sequence[Run]) -> list[Group]:
    """The runs by task and configuration, in the order of their first appearance within a task.

    Raises:
        InvalidInputError: Two runs have the same task, configuration and seed.
    """
    found: dict[tuple[str, str], list[Run]] = {}
    for run in runs:
        same = found.setdefault((run.env_id, json.dumps(run.config, sort_keys=True)), [])
        for other in same:
            if other.seed == run.seed:
                raise InvalidInputError(
                    f"{other.path} and {run.path} have the same task, configuration and seed; give one of them"
                )
        same.append(run)
    configs = [members[0].config for members in found.values()]
    groups = [
        Group(
            env_id=env_id,
            label=_label(members[0].config, configs),
            runs=sorted(members, key=lambda run: run.seed),
        )
        for (env_id, _), members in found.items()
    ]
    return sorted(groups, key=lambda group: group.env_id)


def _label(config: dict[str, Any], others: Sequence[dict[str, Any]]) -> str:
    """The algorithm or nearest preset, and what differs from that preset or between runs of the algorithm."""
    algorithm = config.get("algorithm")
    options = {k: v for k, v in config.items() if k not in ("algorithm", "env_options")}
    shown: dict[str, Any] = {}
    if algorithm is None:
        algorithm, shown = _nearest_preset(options)
    else:
        same = [other for other in others if other.get("algorithm") == algorithm]
        shown = {k: v for k, v in options.items() if any(other.get(k) != v for other in same)}
    parts = [str(algorithm), *(f"{name} {_short(value)}" for name, value in shown.items())]
    if "env_options" in config:
        parts.append(json.dumps(config["env_options"], sort_keys=True))
    return ", ".join(parts)


def _nearest_preset(options: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    """The preset that shares most options, and the options that it does not share."""
    defaults = TrainConfig(total_timesteps=1).to_dict()
    complete = {**defaults, "total_timesteps": None, **modernise(options)}
    differences: dict[str, dict[str, Any]] = {}
    for name, preset in PRESETS.items():
        values = preset.to_dict()
        differences[name] = {k: v for k, v in complete.items() if k not in values or values[k] != v}
    nearest = min(differences, key=lambda name: len(differences[name]))
    return nearest, differences[nearest]


def _short(value: object) -> str:
    if isinstance(value, float):
        return f"{value:g}"
    return "x".join(_short(v) for v in value) if isinstance(value, list) else str(value)


def _page(
    cells: Sequence[Sequence[str]],
    rows: Sequence[ComparisonRow],
    groups: Sequence[Group],
    pictures: Sequence[tuple[Sequence[Group], Sequence[Path]]],
    note: str,
) -> str:
    runs = [(group, run) for group in groups for run in group.runs]
    lines = [
        (
            group.env_id,
            group.label,
            str(run.seed),
            "not evaluated" if run.metrics is None else percent(run.metrics["success_rate"]),
            "not evaluated" if run.metrics is None else f"{run.metrics['mean_steps']:.2f}",
            "not known" if run.training_steps is None else f"{run.training_steps:,}",
            "not logged" if run.training_seconds is None else f"{run.training_seconds:.0f} s",
            "" if run.metrics is None else str(run.metrics["episodes"]),
        )
        for group, run in runs
    ]
    return page(
        "Comparison of training runs",
        f"{len(runs)} runs of {len(groups)} configurations",
        [
            _tiles(rows),
            section(
                f"Results, n = {len(runs)} runs",
                table(HEAD, cells, words=(1,)),
                paragraph(f"{METHOD} {note}", "caption"),
            ),
            *(_curves_section(of_task, paths) for of_task, paths in pictures),
            section("Runs", table((*HEAD[:2], "seed", *HEAD[3:], "episodes"), lines, words=(1,), tall=True)),
        ],
        run_facts(),
    )


def _tiles(rows: Sequence[ComparisonRow]) -> str:
    """The best configuration of each task."""
    cells = []
    for task in dict.fromkeys(row.task for row in rows):
        judged = [(row, row.success_rate) for row in rows if row.task == task and row.success_rate]
        if judged:
            best, success = max(judged, key=lambda pair: pair[1].estimate)
            low, high = success.low, success.high
            cells.append(
                tile(
                    percent(success.estimate, 0),
                    f"success on {task}, best configuration: {best.label}",
                    f"interquartile mean over n = {len(best.seeds)} seed{'' if len(best.seeds) == 1 else 's'}",
                    "" if low is None or high is None else f"95 % interval {percent(low)} to {percent(high)}",
                )
            )
    return tiles(*cells) if cells else ""


def _curves_section(groups: Sequence[Group], paths: Sequence[Path]) -> str:
    drawn = best_groups(groups)
    seeds = " or ".join(str(count) for count in sorted({len(group.runs) for group in drawn}))
    left = f" The {len(drawn)} best of {len(groups)} configurations; the table names all." * (
        len(drawn) < len(groups)
    )
    how = f"interquartile mean over n = {seeds} seeds a configuration, pointwise 95 % interval.{left}"
    return section(
        groups[0].env_id,
        side_by_side(
            *(
                figure(path, f"{title} [{y_label}] over {x_label}: {how}")
                for path, (_, _, title, x_label, y_label) in zip(paths, PANELS, strict=True)
            )
        ),
        paragraph(
            "Each point is the mean of the training episodes that ended in the twentieth of the axis before it, "
            "exploration included.",
            "caption",
        ),
    )
