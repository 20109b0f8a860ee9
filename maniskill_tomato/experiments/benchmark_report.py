"""What a benchmark found, as JSON, as a page of tables, and as plots."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

import maniskill_tomato
from maniskill_tomato.experiments.episode_record import EpisodeRecord
from maniskill_tomato.experiments.metrics import THRESHOLDS, compare_policies, summarise_policy
from maniskill_tomato.experiments.policy_runs import Condition
from maniskill_tomato.files import write_atomically, write_json
from maniskill_tomato.report_design import INK, PLOT_STYLE, TEN, markdown_table, number, percent, save_figure

HEAD = (
    "policy",
    "success",
    "95 % interval",
    "within 5",
    "within 10",
    "moves",
    "regret",
    "SPL",
    "path [m]",
    "joints [rad]",
    "best V_f",
    "AUC",
    "contact",
    "decision [ms]",
)

METHOD = (
    "Moves count a failed episode as the whole horizon. Regret is moves beyond the oracle's and SPL weighs success by "
    "the ratio of the two, both over the episodes that the oracle solves. AUC is the mean of the largest V_f so far "
    "over the moves 1 to the horizon. Contact is the share of episodes in which the arm touched the plant. Success "
    "intervals are Wilson's. A decision is timed by the wall, without the observation, which every policy is given. "
    "Policies marked * know the truth."
)

TESTS = (
    "Each line compares two policies on the same episodes: by the exact McNemar test on success and by a sign-flip "
    "permutation test on moves, whose mean difference has a 95 % bootstrap interval. The p-values are not corrected "
    "for their number."
)

AXIS_LABELS = {
    "leaf_density": "leaf density",
    "start_visibility": "V_f of the start view, upper end",
    "segmentation": "share of target rays missed",
    "depth": "depth noise, multiples of the D435's",
    "pose": "target position error, std [m]",
}


Runs = Mapping[str, Sequence[EpisodeRecord]]


@dataclass(frozen=True, kw_only=True)
class BenchmarkFigures:
    """What was found."""

    rows: list[dict[str, Any]]
    """`summarise_policy` of each policy on the main condition."""
    tests: list[dict[str, Any]]
    """Paired tests there."""
    sweeps: list[dict[str, Any]]
    """The figures of each policy on each condition of the sweeps, with `axis` and `value`."""


def summarise_runs(
    runs: Mapping[str, Runs], conditions: Sequence[Condition], horizon: int
) -> BenchmarkFigures:
    """Works out the figures.

    Args:
        runs: Episodes by condition and policy; policies without episodes are left out.
        conditions: The main one first.
        horizon: Most moves of an episode.
    """
    main = {label: episodes for label, episodes in runs[conditions[0].name].items() if episodes}
    return BenchmarkFigures(
        rows=[summarise_policy(label, episodes, horizon) for label, episodes in main.items()],
        tests=compare_policies(main, horizon),
        sweeps=[
            {"axis": condition.axis, "value": condition.value, **summarise_policy(label, episodes, horizon)}
            for condition in conditions[1:]
            for label, episodes in runs[condition.name].items()
            if episodes
        ],
    )


def write_benchmark(
    figures: BenchmarkFigures,
    runs: Runs,
    out: Path,
    *,
    threshold: float,
    horizon: int,
    privileged: Sequence[str] = (),
    facts: Mapping[str, Any] | None = None,
    pictures: Sequence[Path] = (),
) -> tuple[str, Path]:
    """Writes benchmark.json, benchmark_details.json, benchmark.md and the plots.

    Args:
        figures: What was found.
        runs: The episodes of the main condition by policy, for the plots.
        out: Folder of the results.
        threshold: V_f above which an episode succeeds.
        horizon: Most moves of an episode.
        privileged: Policies that know the truth.
        facts: What else to say about how it was run.
        pictures: Further pictures in `out`.

    Returns:
        The main table and the path of benchmark.md.
    """
    facts = facts or {}
    version = maniskill_tomato.__version__
    write_json(out / "benchmark.json", figures.rows)
    details = {
        "package_version": version,
        "success_threshold": threshold,
        "horizon": horizon,
        **facts,
        "tests": figures.tests,
        "sweeps": figures.sweeps,
    }
    write_json(out / "benchmark_details.json", details)
    shown = [out / "progress.png", out / "thresholds.png"]
    plot_progress(runs, horizon, shown[0])
    plot_thresholds(figures.rows, threshold, shown[1])
    if figures.sweeps:
        shown.append(out / "sweeps.png")
        plot_sweeps(figures.sweeps, shown[-1])
    table = markdown_table(HEAD, [_cells(row, row["policy"] in privileged) for row in figures.rows])
    count = max(row["episodes"] for row in figures.rows)
    told = "".join(f"; {name.replace('_', ' ')}: {value}" for name, value in facts.items())
    parts = [
        "# Benchmark",
        f"{count} episodes, at most {horizon} moves, success at V_f > {threshold:g}; maniskill-tomato {version}{told}.",
        table,
        METHOD,
        *(f"![{path.stem.replace('_', ' ')}]({path.name})" for path in (*shown, *pictures)),
    ]
    if figures.tests:
        parts += ["## Paired tests", _tests_table(figures.tests), TESTS]
    for axis in dict.fromkeys(row["axis"] for row in figures.sweeps):
        rows = [row for row in figures.sweeps if row["axis"] == axis]
        parts += [f"## Sweep: {axis.replace('_', ' ')}", _sweep_table(rows)]
    page = out / "benchmark.md"
    write_atomically(page, ("\n\n".join(parts) + "\n").encode())
    return table, page


def plot_progress(runs: Mapping[str, Sequence[EpisodeRecord]], horizon: int, path: Path) -> None:
    """Share of solved episodes and mean of the best V_f so far, over the moves.

    Args:
        runs: Episodes by policy.
        horizon: Most moves of an episode.
        path: The picture to write.
    """
    moves = np.arange(1, horizon + 1)
    with mpl.rc_context(PLOT_STYLE):
        figure = Figure(figsize=(9.6, 4.4))
        left, right = figure.subplots(1, 2)
        for (label, episodes), style in zip(runs.items(), _styles(len(runs)), strict=True):
            needed = np.array([e.steps if e.success else np.inf for e in episodes])
            left.plot(moves, [(needed <= k).mean() for k in moves], label=label, **style)
            right.plot(moves, np.mean([e.best_so_far(horizon) for e in episodes], axis=0), **style)
        left.set(title="Solved episodes", xlabel="moves", ylim=(-0.02, 1.02))
        right.set(title="Best V_f so far, mean", xlabel="moves", ylim=(-0.02, 1.02))
        for axes in (left, right):
            axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        figure.legend(loc="outside lower center", ncols=5)
        save_figure(figure, path)


def plot_thresholds(rows: Sequence[Mapping[str, Any]], threshold: float, path: Path) -> None:
    """Success over the V_f that counts as success.

    Args:
        rows: `summarise_policy` of each policy.
        threshold: The task's own, where episodes end.
        path: The picture to write.
    """
    with mpl.rc_context(PLOT_STYLE):
        figure = Figure(figsize=(6.6, 4.4))
        axes = figure.subplots()
        for row, style in zip(rows, _styles(len(rows)), strict=True):
            shares = [row["success_rate_at_threshold"][f"{t:.2f}"] for t in THRESHOLDS]
            axes.plot(THRESHOLDS, shares, label=row["policy"], **style)
        axes.axvline(threshold, color=INK, linewidth=1.0, linestyle=(0, (4, 3)))
        axes.annotate(
            "episodes end here",
            (threshold, 0.02),
            xycoords=("data", "axes fraction"),
            xytext=(4, 0),
            textcoords="offset points",
            fontsize=8,
            color=INK,
        )
        axes.set(title="Episodes that reach a V_f", xlabel="V_f", ylim=(-0.02, 1.02))
        figure.legend(loc="outside lower center", ncols=4)
        save_figure(figure, path)


def plot_sweeps(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Success with its interval over each difficulty.

    Args:
        rows: Figures of the policies with `axis` and `value`.
        path: The picture to write.
    """
    axes_names = list(dict.fromkeys(row["axis"] for row in rows))
    labels = list(dict.fromkeys(row["policy"] for row in rows))
    with mpl.rc_context(PLOT_STYLE):
        columns = min(len(axes_names), 3)
        lines = -(-len(axes_names) // columns)
        figure = Figure(figsize=(3.4 * columns, 3.0 * lines + 0.5))
        panels = figure.subplots(lines, columns, squeeze=False).flat
        for axes, name in zip(panels, axes_names, strict=False):
            for label, style in zip(labels, _styles(len(labels)), strict=True):
                points = [r for r in rows if r["axis"] == name and r["policy"] == label]
                if not points:
                    continue
                x = [r["value"] for r in points]
                y = np.array([r["success_rate"] for r in points])
                bounds = np.array([r["success_rate_interval_95"] for r in points]).T
                first = label if name == axes_names[0] else None
                axes.plot(x, y, label=first, **style)
                axes.fill_between(x, *bounds, color=style["color"], alpha=0.12, linewidth=0)
            axes.set(xlabel=AXIS_LABELS.get(name, name), ylim=(-0.02, 1.02), title="Success")
        for axes in list(figure.axes)[len(axes_names) :]:
            axes.set_visible(False)
        figure.legend(loc="outside lower center", ncols=4)
        save_figure(figure, path)


def _cells(row: Mapping[str, Any], privileged: bool) -> tuple[str, ...]:
    low, high = row["success_rate_interval_95"]
    within = row["success_rate_within_moves"]
    return (
        row["policy"] + (" *" if privileged else ""),
        percent(row["success_rate"]),
        f"{percent(low)} to {percent(high)}",
        percent(within["5"]),
        percent(within["10"]),
        number(row["mean_moves"], 2),
        number(row["regret_moves"], 2),
        number(row["spl"], 3),
        number(row["mean_path_m"], 2),
        number(row["mean_joint_path_rad"], 1),
        number(row["mean_best_visible_fraction"], 3),
        number(row["auc"], 3),
        percent(row["contact_episode_rate"]),
        number(row["decision_ms"], 2),
    )


def _tests_table(tests: Sequence[Mapping[str, Any]]) -> str:
    head = ("A", "B", "episodes", "only A solves", "only B solves", "p", "moves A - B", "95 % interval", "p")
    rows = []
    for test in tests:
        low, high = test["moves_interval_95"]
        rows.append(
            (
                test["a"],
                test["b"],
                str(test["episodes"]),
                str(test["only_a"]),
                str(test["only_b"]),
                _p(test["success_p"]),
                f"{test['moves_difference']:+.2f}",
                f"{low:+.2f} to {high:+.2f}",
                _p(test["moves_p"]),
            )
        )
    return markdown_table(head, rows)


def _sweep_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Success and moves of each policy (lines) at each value (columns)."""
    values = list(dict.fromkeys(row["value"] for row in rows))
    lines = []
    for label in dict.fromkeys(row["policy"] for row in rows):
        found = {row["value"]: row for row in rows if row["policy"] == label}
        cells = [
            f"{percent(found[v]['success_rate'])}, {found[v]['mean_moves']:.2f}" if v in found else ""
            for v in values
        ]
        lines.append((label, *cells))
    return markdown_table(("policy", *(f"{v:g}" for v in values)), lines)


def _p(value: float) -> str:
    return "< 0.001" if value < 0.001 else f"{value:.3f}"


def _styles(count: int) -> list[dict[str, Any]]:
    """Colours that stay apart, solid for the first ten lines, then dashed."""
    return [
        {"color": TEN[i % 10], "linewidth": 1.7, "linestyle": "-" if i < 10 else (0, (4, 2))}
        for i in range(count)
    ]
