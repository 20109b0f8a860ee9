"""The table of an ablation: interquartile means over seeds with stratified bootstrap intervals."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

import maniskill_tomato
from maniskill_tomato.experiments.ablation import SOLVED, WINDOW, LearnerVariant
from maniskill_tomato.experiments.comparison_report import interval_text
from maniskill_tomato.experiments.statistics import Interval, interquartile_interval
from maniskill_tomato.files import write_atomically

HEAD = (
    "task",
    "variant",
    "seeds",
    "success",
    "mean steps",
    "steps to 95 %",
    "training wall",
    "training CPU",
)

METHOD = (
    "Success and mean steps are interquartile means over the seeds with 95 % percentile intervals of a bootstrap over "
    f"the seeds, stratified by task. Steps to {100 * SOLVED:.0f} %: median number of environment steps until that "
    f"share of the last {WINDOW} training episodes succeeded, those included that exploration led, and in how many "
    "runs it did. Training times are means; wall time depends on what else the machine did."
)

Result = Mapping[str, Any]


@dataclass(frozen=True, kw_only=True)
class AblationRow:
    """One variant on one task, or on all tasks together."""

    task: str
    variant: str
    title: str
    seeds: tuple[int, ...]
    success_rate: Interval
    mean_steps: Interval
    steps_to_solved: float | None
    """Median over the runs that got there; None if none did."""
    solved_runs: int
    runs: int
    training_seconds: float
    training_cpu_seconds: float


def ablation_rows(variants: Sequence[LearnerVariant], results: Sequence[Result]) -> list[AblationRow]:
    """A row for every task and variant, and one over all tasks for variants that were run on several."""
    tasks = sorted({result["env_id"] for result in results})
    rows = []
    for task in tasks:
        for variant in variants:
            own = [r for r in results if (r["env_id"], r["variant"]) == (task, variant.name)]
            if own:
                rows.append(_row(task, variant, [own]))
    for variant in variants:
        strata = [
            own
            for t in tasks
            if (own := [r for r in results if (r["env_id"], r["variant"]) == (t, variant.name)])
        ]
        if len(tasks) > 1 and len(strata) == len(tasks):
            rows.append(_row(f"{len(tasks)} tasks", variant, strata))
    return rows


def write_ablation(
    preset: str, variants: Sequence[LearnerVariant], results: Sequence[Result], out: Path
) -> str:
    """Writes ablation.json and ablation.md into `out`; returns the table."""
    rows = ablation_rows(variants, results)
    table = markdown_table(rows)
    ordered = sorted(results, key=lambda r: (r["env_id"], r["variant"], r["seed"]))
    episodes = sorted({int(r["episodes"]) for r in results})
    content = {
        "package_version": maniskill_tomato.__version__,
        "preset": preset,
        "evaluation_episodes": episodes,
        "method": METHOD,
        "rows": [asdict(row) for row in rows],
        "runs": [{k: v for k, v in r.items() if k != "config"} for r in ordered],
    }
    write_atomically(out / "ablation.json", (json.dumps(content, indent=2, allow_nan=False) + "\n").encode())
    listed = " and ".join(map(str, episodes))
    text = f"{table}\n\nPreset `{preset}`, {listed} evaluation episodes for each run. {METHOD}\n"
    write_atomically(out / "ablation.md", text.encode())
    return table


def markdown_table(rows: Sequence[AblationRow]) -> str:
    """The rows as a Markdown table."""
    lines = [HEAD, ("---",) * len(HEAD), *(_cells(row) for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _row(task: str, variant: LearnerVariant, strata: Sequence[Sequence[Result]]) -> AblationRow:
    results = [result for stratum in strata for result in stratum]
    solved = [r["steps_to_solved"] for r in results if r["steps_to_solved"] is not None]
    return AblationRow(
        task=task,
        variant=variant.name,
        title=variant.title,
        seeds=tuple(sorted({int(r["seed"]) for r in results})),
        success_rate=interquartile_interval([[r["success_rate"] for r in stratum] for stratum in strata]),
        mean_steps=interquartile_interval([[r["mean_steps"] for r in stratum] for stratum in strata]),
        steps_to_solved=float(np.median(solved)) if solved else None,
        solved_runs=len(solved),
        runs=len(results),
        training_seconds=float(np.mean([r["training_seconds"] for r in results])),
        training_cpu_seconds=float(np.mean([r["training_cpu_seconds"] for r in results])),
    )


def _cells(row: AblationRow) -> tuple[str, ...]:
    reached = "never" if row.steps_to_solved is None else f"{row.steps_to_solved:,.0f}"
    return (
        row.task,
        row.title,
        ", ".join(map(str, row.seeds)),
        interval_text(row.success_rate, 100.0, "{:.1f}", " %"),
        interval_text(row.mean_steps, 1.0, "{:.2f}", ""),
        f"{reached} ({row.solved_runs} of {row.runs})",
        f"{row.training_seconds:.0f} s",
        f"{row.training_cpu_seconds:.0f} s",
    )
