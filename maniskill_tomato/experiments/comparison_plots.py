"""Training curves of configurations over their seeds, over steps and over time."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from maniskill_tomato.experiments.statistics import interquartile_band, interquartile_mean
from maniskill_tomato.experiments.training_runs import Float64, Group
from maniskill_tomato.report_design import MUTED
from maniskill_tomato.report_plots import (
    MOST_LINES,
    PLOT_STYLE,
    label_ends,
    line_style,
    panel_size,
    save_figure,
)

CURVE_POINTS = 120
CURVE_WINDOW = 0.05
"""Share of the axis that a training curve averages over."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Curve:
    """A figure over the course of training: interquartile mean over runs, with its band."""

    at: Float64
    """Environment steps or seconds. Shape (points,)."""
    mean: Float64
    """Shape (points,)."""
    low: Float64
    """Equal to the mean for a single run. Shape (points,)."""
    high: Float64
    """Shape (points,)."""


PANELS = (
    ("success", False, "Training success", "environment steps", "share of episodes"),
    ("success", True, "Training success", "training time [s]", "share of episodes"),
    ("steps", False, "Steps per training episode", "environment steps", "steps"),
    ("steps", True, "Steps per training episode", "training time [s]", "steps"),
)
"""The plots of a task: column of episodes.csv, whether over time, title, and names of both axes."""


def plot_curves(groups: Sequence[Group], path: Path) -> list[Path]:
    """Success and length of training episodes over environment steps and over training time, with 95 % bands.

    Args:
        groups: The configurations of a task. At most `MOST_LINES` of them are drawn, those that succeed most.
        path: The name of the pictures; each gets its number before the ending.

    Returns:
        The four pictures.
    """
    drawn = best_groups(groups)
    written = []
    for number, (column, wall_time, title, x_label, y_label) in enumerate(PANELS, start=1):
        with mpl.rc_context(PLOT_STYLE):
            canvas = Figure(figsize=panel_size(group.label for group in drawn))
            axes = canvas.subplots()
            ends: dict[str, tuple[float, float]] = {}
            for index, group in enumerate(drawn):
                curve = training_curve(group, column, wall_time)
                if curve is None:
                    continue
                style = line_style(index, len(curve.at))
                axes.fill_between(
                    curve.at, curve.low, curve.high, color=style["color"], alpha=0.15, linewidth=0.0
                )
                axes.plot(curve.at, curve.mean, **style)
                ends[group.label] = (float(curve.at[-1]), float(curve.mean[-1]))
            axes.set(title=title, xlabel=x_label, ylabel=y_label)
            axes.set_xlim(left=0.0)
            axes.set_ylim(bottom=0.0, top=1.04 if column == "success" else None)
            if not ends:
                axes.text(0.5, 0.5, "not logged", transform=axes.transAxes, ha="center", color=MUTED)
            label_ends(axes, ends)
            written.append(path.with_name(f"{path.stem}-{number}{path.suffix}"))
            save_figure(canvas, written[-1])
    return written


def best_groups(groups: Sequence[Group]) -> list[Group]:
    """At most `MOST_LINES` of the configurations, those that succeed most in evaluation, in the given order."""

    def success(group: Group) -> float:
        scores = group.scores("success_rate")
        return float(scores.mean()) if len(scores) else -1.0

    kept = sorted(range(len(groups)), key=lambda i: -success(groups[i]))[:MOST_LINES]
    return [groups[i] for i in sorted(kept)]


def training_curve(group: Group, column: str, wall_time: bool) -> Curve | None:
    """A column of episodes.csv over the course of training, averaged over a window and then over the runs.

    Each point is the mean of the episodes that ended within the last twentieth of the axis before it; the axis
    ends where the shortest run of the group does. The band is the pointwise 95 % interval.

    Args:
        group: The runs.
        column: The column, for instance `success`.
        wall_time: Over training time in [s] instead of environment steps.

    Returns:
        None if a run has no finished episode or, for `wall_time`, no clock.
    """
    series: list[tuple[Float64, Float64]] = []
    for run in group.runs:
        at = run.episodes["end_step"]
        if len(at) == 0 or (wall_time and run.clock is None):
            return None
        if wall_time and run.clock is not None:
            at = np.interp(at, run.clock[:, 0], run.clock[:, 1])
        series.append((at, run.episodes[column]))
    end = min(float(at[-1]) for at, _ in series)
    grid = np.linspace(end / CURVE_POINTS, end, CURVE_POINTS)
    smooth = np.stack([trailing_mean(at, values, grid, CURVE_WINDOW * end) for at, values in series])
    known = np.isfinite(smooth).all(axis=0)
    smooth, grid = smooth[:, known], grid[known]
    mean = interquartile_mean(smooth, axis=0)
    low, high = interquartile_band(smooth)
    return Curve(at=grid, mean=mean, low=low, high=high)


def trailing_mean(at: Float64, values: Float64, grid: Float64, window: float) -> Float64:
    """Mean of the values whose place is in (g - window, g] for every g of `grid`; NaN where there is none.

    Args:
        at: Places of the values, rising. Shape (N,).
        values: Shape (N,).
        grid: Shape (G,).
        window: Width of the window, in units of `at`.

    Returns:
        Shape (G,).
    """
    sums = np.concatenate(([0.0], np.cumsum(values)))
    first = np.searchsorted(at, grid - window, side="right")
    after = np.searchsorted(at, grid, side="right")
    counts = after - first
    means: Float64 = np.where(counts > 0, (sums[after] - sums[first]) / np.maximum(counts, 1), np.nan)
    return means
