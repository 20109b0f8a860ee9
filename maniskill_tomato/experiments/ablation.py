"""What each option of the learner is worth: a preset against itself with one option changed, over seeds and tasks."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

import maniskill_tomato
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.experiments.configs import AblationConfig
from maniskill_tomato.experiments.statistics import Interval, ends, interquartile_interval, interval_text
from maniskill_tomato.experiments.training_study import SOLVED, WINDOW, Trial, run_trials
from maniskill_tomato.experiments.variants import Evaluation, Variant, choose_variants
from maniskill_tomato.files import write_json
from maniskill_tomato.folder_lock import only_writer
from maniskill_tomato.learning.rl.presets import get_preset
from maniskill_tomato.report_design import figure, markdown_table, paragraph, report, section, side_by_side
from maniskill_tomato.report_design import table as html_table
from maniskill_tomato.report_plots import plot_intervals
from maniskill_tomato.run_facts import run_facts
from maniskill_tomato.tasks import THESIS_IDS

JUDGED = Evaluation(name="evaluation", title="the plant and the pose of the training")

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


def ablation_rows(variants: Sequence[Variant], results: Sequence[Result]) -> list[AblationRow]:
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


def run_ablation(config: AblationConfig, tell: Callable[[str], None] = lambda line: None) -> str:
    """Runs what is missing, and writes ablation.json and report.html after every run.

    Args:
        config: What to compare.
        tell: Told one line after each run.

    Returns:
        The table as Markdown.

    Raises:
        InvalidInputError: An option cannot be used, or a folder holds a run of other settings.
        SeedsFailedError: Some runs failed; the others are done by then.
        CheckpointError: Another process measures in the folder.
    """
    with only_writer(config.out, "measures"):
        return _run_ablation(config, tell)


def _run_ablation(config: AblationConfig, tell: Callable[[str], None]) -> str:
    variants = choose_variants(config.variants)
    trials = plan_trials(config, variants)
    results: list[Result] = []
    text = ""
    for number, (trial, found) in enumerate(run_trials(trials, config.jobs), start=1):
        results.append(_result(trial, found))
        text = write_ablation(config, variants, results)
        tell(
            f"{number} of {len(trials)}: {trial.env_id} {trial.variant.name}, seed {trial.seed}: "
            f"success {results[-1]['success_rate']:.0%}, {results[-1]['training_cpu_seconds']:.0f} s of CPU"
        )
    return text


def plan_trials(config: AblationConfig, variants: Sequence[Variant]) -> list[Trial]:
    """All runs, seed by seed, so that an early look compares every variant.

    Raises:
        InvalidInputError: A preset or task cannot be used, or a variant does not fit the preset.
    """
    for env_id in config.env_ids:
        if env_id not in THESIS_IDS:
            raise InvalidInputError.choice("a task", env_id, THESIS_IDS)
    get_preset(config.preset)
    length: dict[str, Any] = (
        {} if config.total_timesteps is None else {"total_timesteps": config.total_timesteps}
    )
    return [
        Trial(
            env_id=env_id,
            variant=variant,
            config=dataclasses.replace(variant.config(config.preset), **length),
            seed=seed,
            folder=config.out / env_id / variant.name / f"seed-{seed}",
            evaluations=(JUDGED,),
            episodes=config.episodes,
        )
        for seed in config.seeds
        for env_id in config.env_ids
        for variant in variants
        if env_id in variant.tasks
    ]


def write_ablation(config: AblationConfig, variants: Sequence[Variant], results: Sequence[Result]) -> str:
    """Writes ablation.json and report.html; returns the table as Markdown."""
    rows = ablation_rows(variants, results)
    ordered = sorted(results, key=lambda r: (r["env_id"], r["variant"], r["seed"]))
    episodes = sorted({int(r["episodes"]) for r in results})
    content = {
        "package_version": maniskill_tomato.__version__,
        "preset": config.preset,
        "evaluation_episodes": episodes,
        "method": METHOD,
        "rows": [asdict(row) for row in rows],
        "runs": ordered,
    }
    write_json(config.out / "ablation.json", content)
    table = markdown_table(HEAD, [_cells(row) for row in rows])
    listed = " and ".join(map(str, episodes))
    plots = [_plot(task, rows, config.out) for task in dict.fromkeys(row.task for row in rows)]
    told = f"Preset {config.preset}, {listed} evaluation episodes for each run. {METHOD}"
    report(
        config.out,
        "What each option of the learner is worth",
        f"{len(results)} trainings of {len({row.variant for row in rows})} variants of {config.preset}",
        [
            paragraph(
                "Each variant is the preset with one option changed. It is trained anew from every seed, and judged by "
                "evaluation episodes without exploration. A variant is better or worse than the preset only where "
                "the intervals lie apart."
            ),
            section(
                f"Variants, n = {len(results)} trainings",
                html_table(HEAD, [_cells(row) for row in rows], words=(1,)),
                paragraph(told, "caption"),
            ),
            section("Success", side_by_side(*plots)),
        ],
        run_facts(),
    )
    return f"{table}\n\nPreset `{config.preset}`, {listed} evaluation episodes for each run. {METHOD}\n"


def _plot(task: str, rows: Sequence[AblationRow], out: Path) -> str:
    """The success of the variants on a task, as HTML."""
    own = [row for row in rows if row.task == task]
    path = out / f"success-{task.replace(' ', '-')}.png"
    plot_intervals(
        {row.title: ends(row.success_rate) for row in own}, task, "share of episodes solved", path, (0.0, 1.0)
    )
    seeds = " or ".join(str(n) for n in sorted({row.runs for row in own}))
    return figure(
        path,
        f"Share of episodes solved on {task} (0 to 1): interquartile mean and 95 % interval, n = {seeds} trainings a "
        "line.",
    )


def _result(trial: Trial, found: Mapping[str, Any]) -> dict[str, Any]:
    """What the tables and ablation.json say of a run."""
    judged, training = found["evaluations"][JUDGED.name], found["training"]
    return {
        "env_id": trial.env_id,
        "variant": trial.variant.name,
        "seed": trial.seed,
        "episodes": trial.episodes,
        "success_rate": judged["success_rate"],
        "mean_steps": judged["mean_steps"],
        "training_steps": training["steps"],
        "updates": training["updates"],
        "training_seconds": training["seconds"],
        "training_cpu_seconds": training["cpu_seconds"],
        "steps_to_solved": training["steps_to_solved"],
    }


def _row(task: str, variant: Variant, strata: Sequence[Sequence[Result]]) -> AblationRow:
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
