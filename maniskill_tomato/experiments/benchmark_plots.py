"""The plots of a benchmark: success and V_f over the moves, over the V_f that counts, and over one difficulty."""

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from maniskill_tomato.experiments.episode_record import EpisodeRecord
from maniskill_tomato.experiments.metrics import THRESHOLDS
from maniskill_tomato.report_design import GRID, INK
from maniskill_tomato.report_plots import (
    MOST_LINES,
    PANEL,
    PLOT_STYLE,
    label_ends,
    line_style,
    panel_size,
    save_figure,
)

AXIS_LABELS = {
    "leaf_density": "leaf density",
    "start_visibility": "V_f of the start view, upper end",
    "segmentation": "share of target rays missed",
    "depth": "depth noise, multiples of the D435's",
    "pose": "target position error, std [m]",
}

Runs = Mapping[str, Sequence[EpisodeRecord]]


def best_rows(rows: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """The policies that a plot draws: at most `MOST_LINES`, those that solve most in the fewest moves, in the given
    order."""
    ranked = sorted(rows, key=lambda row: (-row["success_rate"], row["mean_moves"]))
    kept = {row["policy"] for row in ranked[:MOST_LINES]}
    return [row for row in rows if row["policy"] in kept]


def plot_progress(runs: Runs, horizon: int, path: Path) -> None:
    """Share of solved episodes over the moves.

    Args:
        runs: Episodes by policy.
        horizon: Most moves of an episode.
        path: The picture to write.
    """

    def solved(episodes: Sequence[EpisodeRecord]) -> list[float]:
        needed = np.array([e.steps if e.success else np.inf for e in episodes])
        return [float((needed <= k).mean()) for k in range(1, horizon + 1)]

    lines = {label: solved(episodes) for label, episodes in runs.items()}
    _plot_lines(range(1, horizon + 1), lines, "Solved episodes", "moves", "share of episodes", path)


def plot_best_view(runs: Runs, horizon: int, path: Path) -> None:
    """Mean of the best V_f so far over the moves; arguments as for `plot_progress`."""
    lines = {
        label: np.mean([e.best_so_far(horizon) for e in episodes], axis=0).tolist()
        for label, episodes in runs.items()
    }
    _plot_lines(range(1, horizon + 1), lines, "Best V_f so far, mean", "moves", "V_f", path)


def plot_thresholds(rows: Sequence[Mapping[str, Any]], threshold: float, path: Path) -> None:
    """Success over the V_f that counts as success.

    Args:
        rows: `summarise_policy` of each policy.
        threshold: The task's own, where episodes end.
        path: The picture to write.
    """
    lines = {
        row["policy"]: [row["success_rate_at_threshold"][f"{t:.2f}"] for t in THRESHOLDS] for row in rows
    }
    _plot_lines(
        THRESHOLDS,
        lines,
        "Episodes that reach a V_f",
        "V_f",
        "share of episodes",
        path,
        ("ends here", threshold),
    )


def plot_sweep(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Success with its interval over one difficulty, a panel for each policy with the others in grey.

    Args:
        rows: Figures of the policies with `axis` and `value`, of one axis.
        path: The picture to write.
    """
    labels = list(dict.fromkeys(row["policy"] for row in rows))
    name = rows[0]["axis"]
    columns = min(len(labels), 4)
    lines = -(-len(labels) // columns)
    points = {label: [row for row in rows if row["policy"] == label] for label in labels}
    with mpl.rc_context(PLOT_STYLE):
        canvas = Figure(figsize=(max(2.3 * columns, PANEL[0]), 2.1 * lines + 0.4))
        panels = canvas.subplots(lines, columns, squeeze=False, sharex=True, sharey=True)
        for axes, (index, label) in zip(panels.flat, enumerate(labels), strict=False):
            for other in labels:
                x = [row["value"] for row in points[other]]
                y = [row["success_rate"] for row in points[other]]
                if other != label:
                    axes.plot(x, y, color=GRID, linewidth=1.0, zorder=1)
            x = [row["value"] for row in points[label]]
            bounds = np.array([row["success_rate_interval_95"] for row in points[label]]).T
            style = line_style(index)
            axes.fill_between(x, *bounds, color=style["color"], alpha=0.15, linewidth=0)
            axes.plot(x, [row["success_rate"] for row in points[label]], **style, zorder=3)
            axes.set_title(textwrap.fill(label, 24), fontsize=9)
            axes.set_ylim(-0.02, 1.04)
        for axes in panels.flat[len(labels) :]:
            axes.set_visible(False)
        canvas.supxlabel(textwrap.fill(AXIS_LABELS.get(name, str(name)), 60), fontsize=9)
        canvas.supylabel("share of episodes solved", fontsize=9)
        save_figure(canvas, path)


def _plot_lines(
    x: Sequence[float],
    lines: Mapping[str, Sequence[float]],
    title: str,
    x_label: str,
    y_label: str,
    path: Path,
    mark: tuple[str, float] | None = None,
) -> None:
    """Lines from 0 to 1 with their names at their ends; `mark` names a place on the x axis."""
    with mpl.rc_context(PLOT_STYLE):
        canvas = Figure(figsize=panel_size(lines))
        axes = canvas.subplots()
        for index, values in enumerate(lines.values()):
            axes.plot(x, values, **line_style(index, len(x)))
        axes.set(title=title, xlabel=x_label, ylabel=y_label, ylim=(-0.02, 1.04))
        if all(isinstance(value, int) for value in x):
            axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        if mark is not None:
            axes.axvline(mark[1], color=INK, linewidth=1.0, linestyle=(0, (4, 3)))
            axes.annotate(
                mark[0],
                (mark[1], 0.02),
                xycoords=("data", "axes fraction"),
                xytext=(-4, 0),
                textcoords="offset points",
                ha="right",
                fontsize=8,
            )
        label_ends(axes, {label: (float(x[-1]), float(values[-1])) for label, values in lines.items()})
        save_figure(canvas, path)
