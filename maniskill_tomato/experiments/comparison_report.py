"""The page of a comparison over runs: a table, training curves over steps and over time, and the numbers as JSON."""

import base64
import html
import json
import textwrap
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

import maniskill_tomato
from maniskill_tomato.experiments.comparison import Group, training_curve
from maniskill_tomato.experiments.plots import LEAF, MUTED, SKY, STRAW, TOMATO
from maniskill_tomato.experiments.plots import STYLE as PLOT_STYLE
from maniskill_tomato.experiments.report_style import PAGE, STYLE
from maniskill_tomato.experiments.statistics import Interval, interquartile_interval

COLOURS = (TOMATO, SKY, LEAF, STRAW, "#8a5aa5", "#4a9a9a", "#8c6d4f", MUTED)
LABEL_WIDTH = 46
LEGEND_ROWS_PER_INCH = 4.0

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


def make_rows(groups: Sequence[Group]) -> list[ComparisonRow]:
    """A row for every group, and one more for every configuration that was evaluated on several tasks."""
    rows = [_row(group.env_id, [group]) for group in groups]
    by_label: dict[str, list[Group]] = {}
    for group in groups:
        if len(group.scores("success_rate")):
            by_label.setdefault(group.label, []).append(group)
    rows += [_row(f"{len(same)} tasks", same) for same in by_label.values() if len(same) > 1]
    return rows


def write_comparison(groups: Sequence[Group], out: Path) -> Path:
    """Writes comparison.json, comparison.md, curves-TASK.png and report.html into `out`.

    Returns:
        The path of report.html, which needs no other file.
    """
    out.mkdir(parents=True, exist_ok=True)
    rows = make_rows(groups)
    pictures = []
    for env_id in dict.fromkeys(group.env_id for group in groups):
        path = out / f"curves-{env_id}.png"
        plot_curves([group for group in groups if group.env_id == env_id], path)
        pictures.append((env_id, path))
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
    (out / "comparison.json").write_text(
        json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8"
    )
    markdown = f"{markdown_table(rows)}\n\n{METHOD} {note}\n"
    for env_id, path in pictures:
        markdown += f"\n![Training curves of {env_id}]({path.name})\n"
    (out / "comparison.md").write_text(markdown, encoding="utf-8")
    report = out / "report.html"
    report.write_text(_page(rows, groups, pictures, note), encoding="utf-8")
    return report


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
        parts.append(f"Not evaluated: {missing} of the runs.")
    return " ".join(parts)


def markdown_table(rows: Sequence[ComparisonRow]) -> str:
    """The rows as a Markdown table."""
    lines = [HEAD, ("---",) * len(HEAD), *(_cells(row) for row in rows)]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def plot_curves(groups: Sequence[Group], path: Path) -> None:
    """Success and length of training episodes over environment steps and over training time, with 95 % bands."""
    labels = [textwrap.fill(group.label, LABEL_WIDTH) for group in groups]
    legend = sum(label.count("\n") + 1 for label in labels) / LEGEND_ROWS_PER_INCH / 2 + 0.3
    panels = (("Training success", "success", 1.0), ("Steps per training episode", "steps", None))
    with mpl.rc_context(PLOT_STYLE):
        figure = Figure(figsize=(9.0, 5.4 + legend))
        for row, (title, column, top) in zip(figure.subplots(2, 2), panels, strict=True):
            for axes, wall_time in zip(row, (False, True), strict=True):
                empty = [_draw_curve(axes, group, column, wall_time, i) for i, group in enumerate(groups)]
                axes.set_title(title)
                axes.set_xlabel("training time [s]" if wall_time else "environment steps")
                axes.set_xlim(left=0.0)
                axes.set_ylim(bottom=0.0, top=top and 1.04 * top)
                if all(empty):
                    axes.text(0.5, 0.5, "not logged", transform=axes.transAxes, ha="center", color=MUTED)
        handles = [Line2D([], [], color=COLOURS[i % len(COLOURS)]) for i in range(len(groups))]
        figure.legend(handles, labels, loc="outside lower center", ncols=2)
        figure.savefig(path)


def _draw_curve(axes: Axes, group: Group, column: str, wall_time: bool, index: int) -> bool:
    """One line with its band; whether there was nothing to draw."""
    curve = training_curve(group, column, wall_time)
    if curve is None:
        return True
    colour = COLOURS[index % len(COLOURS)]
    axes.fill_between(curve.at, curve.low, curve.high, color=colour, alpha=0.18, linewidth=0.0)
    axes.plot(curve.at, curve.mean, color=colour, linewidth=1.6)
    return False


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


def interval_text(interval: Interval | None, factor: float, form: str, unit: str) -> str:
    """An interquartile mean with its interval, as `97.5 [95.0, 99.0] %`.

    Args:
        interval: None for runs that were not evaluated.
        factor: What the numbers are multiplied by.
        form: Format of each number.
        unit: What follows them.
    """
    if interval is None:
        return "not evaluated"
    text = form.format(factor * interval.estimate)
    if interval.low is None or interval.high is None:
        return text + unit
    return f"{text} [{form.format(factor * interval.low)}, {form.format(factor * interval.high)}]{unit}"


def _page(
    rows: Sequence[ComparisonRow], groups: Sequence[Group], pictures: Sequence[tuple[str, Path]], note: str
) -> str:
    head = "".join(f"<th>{cell}</th>" for cell in HEAD)
    sections = [
        f"<section><h2>Results</h2>{_table(head, [_cells(row) for row in rows])}"
        f'<p class="caption">{html.escape(f"{METHOD} {note}")}</p></section>'
    ]
    for env_id, path in pictures:
        data = base64.b64encode(path.read_bytes()).decode()
        caption = html.escape(
            f"Training on {env_id}: interquartile mean over the seeds and pointwise 95 % interval. Each point is "
            "the mean of the episodes that ended in the twentieth of the axis before it, exploration included."
        )
        image = f'<img alt="{caption}" src="data:image/png;base64,{data}">'
        sections.append(
            f"<section><h2>{html.escape(env_id)}</h2><figure>{image}<figcaption>{caption}</figcaption></figure></section>"
        )
    cells = [
        (
            group.env_id,
            group.label,
            str(run.seed),
            "not evaluated" if run.metrics is None else f"{run.metrics['success_rate']:.1%}",
            "not evaluated" if run.metrics is None else f"{run.metrics['mean_steps']:.2f}",
            "not known" if run.training_steps is None else f"{run.training_steps:,}",
            "not logged" if run.training_seconds is None else f"{run.training_seconds:.0f} s",
        )
        for group in groups
        for run in group.runs
    ]
    head = "".join(f"<th>{cell}</th>" for cell in ("task", "configuration", "seed", *HEAD[3:]))
    sections.append(f"<section><h2>Runs</h2>{_table(head, cells)}</section>")
    count = sum(len(group.runs) for group in groups)
    values: dict[str, Any] = {
        "style": STYLE,
        "title": "Comparison of training runs",
        "subtitle": f"{count} runs of {len(groups)} configurations",
        "body": "\n".join(sections),
        "version": html.escape(maniskill_tomato.__version__),
    }
    return PAGE.format(**values)


def _table(head: str, rows: Sequence[Sequence[str]]) -> str:
    body = "".join(
        f"<tr><th scope='row'>{html.escape(first)}</th>{''.join(f'<td>{html.escape(c)}</td>' for c in rest)}</tr>"
        for first, *rest in rows
    )
    return f"<div class='scroll'><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>"
