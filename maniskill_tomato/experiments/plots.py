"""Plots of training and evaluation, the counterparts of the thesis's Figures 5-1 to 5-8."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d.art3d import Poly3DCollection  # type: ignore[import-untyped]
from numpy.typing import ArrayLike, NDArray

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.experiments.episode_record import EpisodeRecord
from maniskill_tomato.learning.rl.history import TrainingCurves
from maniskill_tomato.report_design import AXIS, CARD, INK, LEAF, MUTED, SERIES, SKY, TOMATO
from maniskill_tomato.report_plots import PLOT_STYLE, WIDE, label_ends, line_style, save_figure
from maniskill_tomato.robot.d435 import T_flange_camera_color_optical, color_intrinsics
from maniskill_tomato.robot.kinematics import viewpoint_transform

FRUSTUM_DEPTH = 0.11
"""Length of a drawn camera, in [m]."""

SHOWN_TRAJECTORIES = 3


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """How episodes of one outcome look, so that colour is not needed to tell them apart."""

    name: str
    colour: str
    marker: str
    hatch: str


OUTCOMES = {
    True: Outcome(name="target fully visible", colour=LEAF, marker="o", hatch=""),
    False: Outcome(name="not", colour=TOMATO, marker="X", hatch="/////"),
}

_ABOVE: dict[str, Any] = {
    "loc": "lower right",
    "bbox_to_anchor": (1.0, 1.0),
    "ncols": 3,
    "borderaxespad": 0.2,
    "handletextpad": 0.3,
}
"""Where a plot of episodes has its key."""


def seed_colour(index: int) -> str:
    """One colour for each training seed, reused beyond eight."""
    return SERIES[index % len(SERIES)]


def moving_average(values: ArrayLike, window: int) -> NDArray[np.float64]:
    """Means of `window` successive values; entry i ends at value `i + window - 1`.

    A series shorter than the window is averaged as a whole. Shape (max(len - window + 1, 1),), or (0,) for no
    values.
    """
    series = np.asarray(values, dtype=np.float64)
    if len(series) == 0:
        return series
    window = min(window, len(series))
    sums = np.concatenate(([0.0], np.cumsum(series)))
    averages: NDArray[np.float64] = (sums[window:] - sums[:-window]) / window
    return averages


def default_windows(episodes: int, steps: int) -> tuple[int, int]:
    """Windows in episodes and steps: a 20th and a 17th of the run, which is 12 and 75 for the thesis's guided
    one."""
    return max(12, episodes // 20), max(75, steps // 17)


def averaged_curve(values: NDArray[Any], window: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """The moving average of a series, and the number (from 1) of the value at which each mean ends."""
    average = moving_average(values, window)
    return np.arange(len(values) - len(average), len(values)) + 1, average


def plot_training_curves(
    runs: TrainingCurves | Mapping[str, TrainingCurves],
    path: Path,
    windows: tuple[int, int] | None = None,
    marks: Callable[[str], Mapping[str, float]] = lambda unit: {},
) -> None:
    """Moving averages of episode loss and reward, step reward and step V_f (Fig. 5-1 to 5-4, 5-14 to 5-17).

    Args:
        runs: The history of a run, or those of several by their labels.
        path: The picture to write.
        windows: Window sizes in episodes and in steps; the thesis used 12 and 75, or 30 and 180.
        marks: Places to mark on the axis of `episode` or `step`, by their captions.
    """
    several = {"": runs} if isinstance(runs, TrainingCurves) else dict(runs)
    longest = max(several.values(), key=lambda curves: len(curves.step_reward))
    windows = windows or default_windows(len(longest.episodes["steps"]), len(longest.step_reward))
    panels: tuple[tuple[str, Callable[[TrainingCurves], NDArray[Any]], str, str], ...] = (
        ("Episode loss", lambda c: c.episodes["loss_sum"], "episode", MUTED),
        ("Episode reward", lambda c: c.episodes["episodic_return"], "episode", SKY),
        ("Step reward", lambda c: c.step_reward, "step", SKY),
        ("Step visible fraction", lambda c: c.step_visible_fraction, "step", TOMATO),
    )
    with mpl.rc_context(PLOT_STYLE):
        figure = Figure(figsize=(WIDE[0], 5.6))
        for axes, (title, values_of, unit, colour) in zip(figure.subplots(2, 2).flat, panels, strict=True):
            window = windows[0 if unit == "episode" else 1]
            most = 1
            ends: dict[str, tuple[float, float]] = {}
            for index, (label, curves) in enumerate(several.items()):
                values = values_of(curves)
                most = max(most, len(values))
                at, average = averaged_curve(values, window)
                style = {"color": colour, "linewidth": 1.5}
                axes.plot(at, average, **(line_style(index, len(at)) if len(several) > 1 else style))
                if len(several) > 1 and len(at):
                    ends[label] = (float(at[-1]), float(average[-1]))
            for caption, place in marks(unit).items():
                _mark(axes, place, caption)
            axes.set_title(title)
            note = f"mean of {min(window, most)} {unit}s"
            axes.set_title(note, loc="right", fontsize=8.5, fontweight="normal", color=MUTED)
            axes.set_xlabel(unit)
            axes.xaxis.set_major_locator(MaxNLocator(nbins=6, integer=True))
            label_ends(axes, ends)
        save_figure(figure, path)


def plot_steps(episodes: Sequence[EpisodeRecord], path: Path) -> None:
    """Steps that each episode needed (Fig. 5-6)."""
    with mpl.rc_context(PLOT_STYLE):
        figure = Figure(figsize=WIDE)
        axes = figure.subplots()
        for solved, look in OUTCOMES.items():
            some = [k for k, e in enumerate(episodes) if e.success == solved]
            if not some:
                continue
            axes.bar(
                [k + 1 for k in some],
                [episodes[k].steps for k in some],
                width=0.78,
                facecolor=look.colour if solved else CARD,
                edgecolor=look.colour,
                hatch=look.hatch,
                linewidth=0.8,
                label=f"{look.name} ({len(some)})",
            )
        axes.set_title("Steps per episode")
        axes.set_xlabel("episode")
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.set_ylabel("steps")
        axes.yaxis.set_major_locator(MaxNLocator(integer=True))
        axes.legend(**_ABOVE)
        save_figure(figure, path)


def plot_visible_fraction(episodes: Sequence[EpisodeRecord], threshold: float, path: Path) -> None:
    """Visible fraction at the start and the largest one reached, for each episode (Fig. 5-7)."""
    with mpl.rc_context(PLOT_STYLE):
        figure = Figure(figsize=WIDE)
        axes = figure.subplots()
        index = np.arange(1, len(episodes) + 1)
        start = [e.visible_fraction[0] for e in episodes]
        largest = [e.max_visible_fraction for e in episodes]
        axes.vlines(index, start, largest, color=AXIS, linewidth=1.2, zorder=1)
        axes.scatter(index, start, s=14, marker="_", color=MUTED, zorder=2, label="start")
        for solved, look in OUTCOMES.items():
            some = [k for k, e in enumerate(episodes) if e.success == solved]
            if not some:
                continue
            axes.scatter(
                [k + 1 for k in some],
                [largest[k] for k in some],
                s=24,
                marker=look.marker,
                color=look.colour,
                zorder=3,
                label=f"{look.name} ({len(some)})",
            )
        axes.axhline(threshold, color=INK, linewidth=1.0, linestyle=(0, (4, 3)))
        axes.annotate(
            f"fully visible, V_f > {threshold:g}",
            (1.0, threshold),
            xycoords=("axes fraction", "data"),
            xytext=(-2, -11),
            textcoords="offset points",
            ha="right",
            fontsize=8,
            color=INK,
        )
        axes.set_ylim(-0.03, 1.05)
        axes.set_title("Largest visible fraction per episode")
        axes.set_xlabel("episode")
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.set_ylabel("V_f")
        axes.legend(**_ABOVE)
        save_figure(figure, path)


def plot_trajectories(episodes: Sequence[EpisodeRecord], title: str, path: Path) -> None:
    """Ways of the end-effector with the camera at the first, middle and last pose (Fig. 5-8).

    As in the thesis the first camera is opaque, the middle one transparent and the last one between.

    Args:
        episodes: The first three of them are drawn.
        title: What they are.
        path: The picture to write.
    """
    shown = list(episodes[:SHOWN_TRAJECTORIES])
    if not shown:
        raise InvalidInputError("a figure of trajectories needs at least one episode")
    frusta = [[frustum_points(v, FRUSTUM_DEPTH) for v in e.viewpoints[marked_views(e)]] for e in shown]
    targets = np.stack([e.target[0] for e in shown])
    points = np.concatenate(
        [targets, *(e.viewpoints[:, :3] for e in shown), *(f for cameras in frusta for f in cameras)]
    )
    low, high = points.min(axis=0) - 0.05, points.max(axis=0) + 0.05
    with mpl.rc_context(PLOT_STYLE):
        figure = Figure(figsize=(9.0, 5.0))
        for column, (elevation, azimuth) in enumerate(((22, -128), (62, -100)), start=1):
            space: Any = figure.add_subplot(1, 2, column, projection="3d")
            for index, (episode, cameras) in enumerate(zip(shown, frusta, strict=True)):
                x, y, z = episode.viewpoints[:, :3].T
                label = f"episode {index + 1}: {episode.steps} steps, " + (
                    "solved" if episode.success else "not solved"
                )
                space.plot(x, y, z, **{**line_style(index), "markeredgewidth": 0.0}, label=label)
                for camera, opacity in zip(cameras, camera_opacities(len(cameras)), strict=True):
                    space.add_collection3d(
                        Poly3DCollection(
                            frustum_faces(camera),
                            facecolors=seed_colour(index),
                            edgecolors=seed_colour(index),
                            linewidths=0.7,
                            alpha=opacity,
                        )
                    )
            space.scatter(*targets.T, s=90, color=TOMATO, marker="P", label="target")
            space.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
            for axis in (space.xaxis, space.yaxis, space.zaxis):
                axis.set_pane_color(CARD)
                axis.line.set_color(AXIS)
            space.set_box_aspect(high - low, zoom=0.9)
            space.view_init(elevation, azimuth)
            space.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")
            space.tick_params(labelsize=7)
        handles, labels = figure.axes[0].get_legend_handles_labels()
        plot_title(figure, title)
        figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
        save_figure(figure, path)


def marked_views(episode: EpisodeRecord) -> list[int]:
    """The first, the middle and the last view of an episode, each once."""
    return sorted({0, episode.steps // 2, episode.steps})


def camera_opacities(count: int) -> list[float]:
    """Opacities of the cameras of `marked_views`: opaque first, transparent middle, half-transparent last."""
    return [0.75, 0.12, 0.4] if count == 3 else [0.75, 0.4][:count]


def frustum_points(viewpoint: NDArray[np.float64], depth: float) -> NDArray[np.float64]:
    """Apex and base of the colour camera's viewing pyramid in the world frame, in [m].

    Args:
        viewpoint: End-effector x, y, z [m], roll, pitch, yaw [rad], world frame. Shape (6,).
        depth: Distance of the base from the camera, in [m].

    Returns:
        The optical centre, then the corners of the 640 x 480 picture: top left, top right, bottom right,
        bottom left. Shape (5, 3).
    """
    camera = color_intrinsics()
    w, h = float(camera.width), float(camera.height)
    corners = camera.ray_directions([(0.0, 0.0), (w, 0.0), (w, h), (0.0, h)]) * depth
    points = np.concatenate([np.zeros((1, 3)), corners])
    T_world_ee = viewpoint_transform(torch.as_tensor(viewpoint, dtype=torch.float64)[None])[0].numpy()
    T_world_optical = T_world_ee @ np.asarray(T_flange_camera_color_optical)
    world: NDArray[np.float64] = points @ T_world_optical[:3, :3].T + T_world_optical[:3, 3]
    return world


def frustum_faces(points: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """The four sides and the base of `frustum_points` as polygons, each of shape (3 or 4, 3)."""
    apex, corners = points[0], points[1:]
    sides = [np.stack((apex, corners[i], corners[(i + 1) % 4])) for i in range(4)]
    return [*sides, corners]


def plot_title(figure: Figure, title: str) -> None:
    """What all panels of a figure show, above them."""
    figure.suptitle(title[0].upper() + title[1:], fontsize=11, color=INK, x=0.01, ha="left")


def _mark(axes: Axes, x: float, text: str) -> None:
    axes.axvline(x, color=MUTED, linewidth=0.9, linestyle=(0, (4, 3)))
    axes.annotate(
        text,
        (x, 1.0),
        xycoords=("data", "axes fraction"),
        xytext=(-3, -2),
        textcoords="offset points",
        ha="right",
        va="top",
        fontsize=7.5,
        color=MUTED,
    )
