"""Plots of a benchmark: progress over moves, success over thresholds, sweeps."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from maniskill_tomato.experiments.benchmark_metrics import THRESHOLDS
from maniskill_tomato.experiments.plots import INK, STYLE
from maniskill_tomato.experiments.view_episode import ViewEpisode

AXIS_LABELS = {
    "leaf_density": "leaf density",
    "start_visibility": "V_f of the start view, upper end",
    "segmentation": "share of target rays missed",
    "depth": "depth noise, multiples of the D435's",
    "pose": "target position error, std [m]",
}


def plot_progress(runs: Mapping[str, Sequence[ViewEpisode]], horizon: int, path: Path) -> None:
    """Share of solved episodes and mean of the best V_f so far, over the moves.

    Args:
        runs: Episodes by policy.
        horizon: Most moves of an episode.
        path: The picture to write.
    """
    moves = np.arange(1, horizon + 1)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(9.6, 4.4))
        left, right = figure.subplots(1, 2)
        for (label, episodes), style in zip(runs.items(), _styles(len(runs)), strict=True):
            needed = np.array([e.moves if e.success else np.inf for e in episodes])
            left.plot(moves, [(needed <= k).mean() for k in moves], label=label, **style)
            right.plot(moves, np.mean([e.best_so_far(horizon) for e in episodes], axis=0), **style)
        left.set(title="Solved episodes", xlabel="moves", ylim=(-0.02, 1.02))
        right.set(title="Best V_f so far, mean", xlabel="moves", ylim=(-0.02, 1.02))
        for axes in (left, right):
            axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        figure.legend(loc="outside lower center", ncols=5)
        figure.savefig(path)


def plot_thresholds(rows: Sequence[Mapping[str, Any]], threshold: float, path: Path) -> None:
    """Success over the V_f that counts as success.

    Args:
        rows: `summarise_policy` of each policy.
        threshold: The task's own, where episodes end.
        path: The picture to write.
    """
    with mpl.rc_context(STYLE):
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
        figure.savefig(path)


def plot_sweeps(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Success with its interval over each difficulty.

    Args:
        rows: Figures of the policies with `axis` and `value`.
        path: The picture to write.
    """
    axes_names = list(dict.fromkeys(row["axis"] for row in rows))
    labels = list(dict.fromkeys(row["policy"] for row in rows))
    with mpl.rc_context(STYLE):
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
        figure.savefig(path)


def _styles(count: int) -> list[dict[str, Any]]:
    """Colours that stay apart, solid for the first ten lines, then dashed."""
    colours = mpl.colormaps["tab10"].colors  # type: ignore[attr-defined]
    return [
        {"color": colours[i % 10], "linewidth": 1.7, "linestyle": "-" if i < 10 else (0, (4, 2))}
        for i in range(count)
    ]
