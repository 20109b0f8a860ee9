"""Counterparts of the thesis's figures of chapter 5, with all training seeds in each."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.experiments.episode_record import EpisodeRecord
from maniskill_tomato.experiments.plots import (
    plot_title,
    plot_training_curves,
    plot_trajectories,
    seed_colour,
)
from maniskill_tomato.experiments.training_study import Trial
from maniskill_tomato.experiments.variants import Experiment
from maniskill_tomato.learning.rl.envs import make_env
from maniskill_tomato.learning.rl.history import load_history
from maniskill_tomato.plants.growers import grow
from maniskill_tomato.plants.organs import SemanticClass
from maniskill_tomato.plants.spec import PlantPose, PlantSpec
from maniskill_tomato.rendering import vulkan_probe
from maniskill_tomato.report_design import CARD, INK, MUTED, TOMATO
from maniskill_tomato.report_plots import PLOT_STYLE, label_ends, line_style, save_figure
from maniskill_tomato.segmentation.datasets.picture_files import write_picture
from maniskill_tomato.tasks.thesis.thesis_config import ViewpointTaskConfig, thesis_task

THESIS_EPISODES = 6
"""Length of the thesis's evaluations, in episodes."""

LEFT_OUT = "Left out because this machine cannot render: the first and last views of the target. {hint}."

PLANT_COLOURS = {
    SemanticClass.STEM: "#6d8f5a",
    SemanticClass.LEAF: "#5f9a62",
    SemanticClass.FRUIT_RIPE: TOMATO,
}


def draw_all(experiment: Experiment, trials: Sequence[Trial], folder: Path) -> list[Path]:
    """Draws every figure that needs no renderer; returns the files.

    Args:
        experiment: What was tried.
        trials: Finished trainings of one variant over seeds.
        folder: Where to write.
    """
    folder.mkdir(parents=True, exist_ok=True)
    files = [folder / "training.png", folder / "plants.png"]
    plot_training_curves(
        {f"seed {trial.seed}": load_history(trial.folder) for trial in trials},
        files[0],
        experiment.windows,
        lambda unit: _thesis_marks(experiment, unit),
    )
    plot_plant_positions(experiment, files[1])
    for evaluation in experiment.evaluations:
        runs = {trial.seed: trial.records(evaluation) for trial in trials}
        files.append(folder / f"evaluation_{evaluation.name}.png")
        plot_evaluation(runs, _task(experiment).full_visibility, evaluation.title, files[-1])
        best = most_successful(runs)
        files.append(folder / f"trajectories_{evaluation.name}.png")
        plot_trajectories(runs[best], f"{evaluation.title}, training seed {best}", files[-1])
    return files


def take_views(experiment: Experiment, trial: Trial, folder: Path) -> str | None:
    """Takes `views_<evaluation>.png` for every evaluation: first view, last view, and the scene at the end.

    The episode is the first that the trial's policy solved, or the first one if it solved none (Fig. 5-9, 5-13, 5-21).

    Returns:
        A message if this machine cannot render, else None.
    """
    if (problem := vulkan_probe.rendering_problem()) is not None:
        return LEFT_OUT.format(hint=problem)
    from maniskill_tomato.experiments.film import make_film_options, photograph

    folder.mkdir(parents=True, exist_ok=True)
    for evaluation in experiment.evaluations:
        env = make_env(experiment.env_id, **make_film_options(evaluation.env_options))
        try:
            film = photograph(env, trial.policy(), episode_to_show(trial.records(evaluation)))
        finally:
            env.close()
        views = (film.first.wrist, film.last.wrist, film.last.outside)
        write_picture(folder / f"views_{evaluation.name}.png", np.concatenate(views, axis=1)[::2, ::2])
    return None


def episode_to_show(episodes: Sequence[EpisodeRecord]) -> int:
    """Seed of the first solved episode, else of the first one."""
    return next((e.seed for e in episodes if e.success), episodes[0].seed)


def most_successful(runs: Mapping[int, Sequence[EpisodeRecord]]) -> int:
    """The seed whose policy solved the most episodes; the first of equals."""
    return max(runs, key=lambda seed: sum(e.success for e in runs[seed]))


def plot_evaluation(
    runs: Mapping[int, Sequence[EpisodeRecord]], threshold: float, title: str, path: Path
) -> None:
    """Steps and largest V_f per episode (Fig. 5-6, 5-7): the thesis's six episodes, and all that were run.

    Args:
        runs: The evaluation episodes of each training seed, equally many.
        threshold: V_f above which an episode is solved.
        title: What is evaluated.
        path: The picture to write.
    """
    with mpl.rc_context(PLOT_STYLE):
        figure = Figure(figsize=(9.0, 5.4))
        grid = figure.subplots(2, 2)
        offsets = np.linspace(-0.25, 0.25, len(runs)) if len(runs) > 1 else np.zeros(1)
        count = max(len(episodes) for episodes in runs.values())
        for row, (name, attribute) in enumerate(
            (("steps", "steps"), ("largest V_f", "max_visible_fraction"))
        ):
            few, many = grid[row]
            ends: dict[str, tuple[float, float]] = {}
            for index, (seed, episodes) in enumerate(runs.items()):
                first = episodes[:THESIS_EPISODES]
                style = line_style(index, len(episodes))
                few.scatter(
                    np.arange(1, len(first) + 1) + offsets[index],
                    [getattr(e, attribute) for e in first],
                    s=30,
                    marker=style["marker"],
                    facecolors=[seed_colour(index) if e.success else CARD for e in first],
                    edgecolors=seed_colour(index),
                    linewidths=1.3,
                    zorder=3,
                )
                solved = sum(e.success for e in episodes)
                values = sorted(getattr(e, attribute) for e in episodes)
                many.plot(np.arange(1, len(episodes) + 1), values, **style)
                ends[f"seed {seed}: {solved} of {len(episodes)} solved"] = (len(episodes), float(values[-1]))
            few.set(xlabel="episode", ylabel=name)
            few.xaxis.set_major_locator(MaxNLocator(integer=True))
            many.set(xlabel="episodes, sorted", ylabel=name)
            for axes in (few, many):
                if row == 0:
                    axes.set_ylim(0.0, 31.0)
                else:
                    axes.set_ylim(-0.03, 1.05)
                    axes.axhline(threshold, color=INK, linewidth=1.0, linestyle=(0, (4, 3)))
            label_ends(many, ends)
        grid[0][0].set_title(f"First {THESIS_EPISODES} episodes (filled: solved)")
        grid[0][1].set_title(f"All {count} episodes")
        plot_title(figure, title)
        save_figure(figure, path)


def plot_plant_positions(experiment: Experiment, path: Path) -> None:
    """Where the plant stands in the training and in each evaluation (Fig. 5-5, 5-10, 5-18)."""
    task = _task(experiment)
    with mpl.rc_context(PLOT_STYLE):
        figure = Figure(figsize=(3.1 * len(experiment.evaluations), 5.6))
        grid = figure.subplots(2, len(experiment.evaluations), sharex="row", sharey="row")
        for (front, above), evaluation in zip(grid.T, experiment.evaluations, strict=True):
            options = evaluation.env_options
            choice = PlantSpec.parse(options.get("plant"), task.plant)
            pose = PlantPose.parse(options.get("plant_pose"), task.plant_pose)
            _draw_plant(above, choice, pose, (0, 1), depth_axis=2)
            _draw_plant(front, choice, pose, (1, 2), depth_axis=0)
            front.invert_xaxis()
            _draw_starts(above, task, (0, 1))
            _draw_starts(front, task, (1, 2))
            above.scatter(0.0, 0.0, s=60, marker="s", color=INK)
            front.set(xlabel="y [m]", ylabel="z [m]", xlim=(0.75, -0.55), ylim=(0.0, 1.9), aspect="equal")
            above.set(xlabel="x [m]", ylabel="y [m]", xlim=(-0.2, 1.3), ylim=(-0.5, 0.75), aspect="equal")
            front.set_title(evaluation.title.split(" (")[0], fontsize=9)
            above.set_title(
                f"x {pose.x:g} m, y {pose.y:g} m, turned {pose.yaw:g} rad",
                fontsize=8,
                fontweight="normal",
                color=MUTED,
            )
        save_figure(figure, path)


def _draw_plant(
    axes: Axes, choice: PlantSpec, pose: PlantPose, shown: tuple[int, int], depth_axis: int
) -> None:
    """The plant's triangles along an axis of the world, the nearest last."""
    if not isinstance(choice.seed, int):
        raise InvalidInputError("a plant that changes with every episode has no one position to draw")
    c, s = np.cos(pose.yaw), np.sin(pose.yaw)
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    triangles: list[NDArray[np.float64]] = []
    colours: list[str] = []
    for organ in grow(choice, choice.seed).organs:
        world = organ.vertices.astype(np.float64) @ rotation.T + np.array([pose.x, pose.y, 0.0])
        triangles.append(world[organ.faces])
        colours += [PLANT_COLOURS.get(organ.semantic_class, "#a3b95f")] * len(organ.faces)
    corners = np.concatenate(triangles)
    towards_viewer = 1.0 if depth_axis == 2 else -1.0
    order = np.argsort(towards_viewer * corners[:, :, depth_axis].mean(axis=1))
    axes.add_collection(
        PolyCollection(
            list(corners[order][:, :, list(shown)]),
            facecolors=[colours[i] for i in order],
            edgecolors="none",
            rasterized=True,
        )
    )


def _draw_starts(axes: Axes, task: ViewpointTaskConfig, shown: tuple[int, int]) -> None:
    """The box that episodes start in (Eq. 5-1, 5-7)."""
    (x0, x1), (y0, y1) = (task.start_position[axis] for axis in shown)
    axes.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, fill=False, edgecolor=INK, linestyle=(0, (3, 2))))


def _thesis_marks(experiment: Experiment, unit: str) -> dict[str, float]:
    """Where the thesis's own training or exploration ended, in episodes or steps."""
    marks: dict[str, float] = {}
    if unit == "step" and experiment.total_steps is not None:
        marks["thesis:\nlast step"] = experiment.total_steps
    if experiment.exploration_ends is not None:
        marks["thesis:\nexploration over"] = experiment.exploration_ends[0 if unit == "episode" else 1]
    return marks


def _task(experiment: Experiment) -> ViewpointTaskConfig:
    return thesis_task(experiment.env_id, experiment.env_options.get("scene", "hidden"))
