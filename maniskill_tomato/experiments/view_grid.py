"""A grid of pictures: what the wrist camera saw first, and what each policy saw last."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray

from maniskill_tomato.experiments.episode_record import EpisodeRecord
from maniskill_tomato.experiments.film import Image, make_film_options, wrist_picture
from maniskill_tomato.experiments.policy_runs import Condition
from maniskill_tomato.learning.rl.envs import make_env
from maniskill_tomato.report_design import LEAF, TOMATO
from maniskill_tomato.report_plots import PLOT_STYLE, save_figure

EPISODES = 5
SHRINK = 2
"""Every second pixel of 640x480 is shown."""


def draw_view_grid(
    runs: Mapping[str, Sequence[EpisodeRecord]], condition: Condition, threshold: float, path: Path
) -> None:
    """Draws the first episodes, a row each: the start view, then the last view of every policy.

    Args:
        runs: Episodes by policy.
        condition: Under which they were run.
        threshold: V_f above which an episode succeeds.
        path: The picture to write.

    Raises:
        RenderingUnavailableError: This machine cannot render.
    """
    by_seed = {label: {e.seed: e for e in found} for label, found in runs.items() if found}
    common = sorted(set.intersection(*(set(found) for found in by_seed.values())))[:EPISODES]
    env = make_env(condition.env_id, **make_film_options(condition.env_options))
    rows: list[list[tuple[str, float, Image]]] = []
    try:
        for seed in common:
            env.reset(seed=seed)
            episodes = {label: found[seed] for label, found in by_seed.items()}
            views = [("start", next(iter(episodes.values())), 0)]
            views += [(label, episode, -1) for label, episode in episodes.items()]
            rows.append(
                [
                    (label, float(episode.visible_fraction[k]), _picture(env, episode, k))
                    for label, episode, k in views
                ]
            )
    finally:
        env.close()
    _draw(rows, threshold, path)


def _picture(env: Any, episode: EpisodeRecord, view: int) -> Image:
    """What the wrist camera saw at a view of an episode."""
    assert episode.qpos is not None
    world = env.unwrapped
    qpos: NDArray[np.float64] = episode.qpos[view]
    world.agent.robot.set_qpos(torch.as_tensor(qpos, dtype=torch.float32, device=world.device)[None])
    return wrist_picture(world)[::SHRINK, ::SHRINK]


def _draw(rows: Sequence[Sequence[tuple[str, float, Image]]], threshold: float, path: Path) -> None:
    columns = len(rows[0])
    with mpl.rc_context(PLOT_STYLE):
        figure = Figure(figsize=(1.65 * columns, 1.35 * len(rows) + 0.3))
        panels = figure.subplots(len(rows), columns, squeeze=False)
        for i, row in enumerate(rows):
            for axes, (label, seen, picture) in zip(panels[i], row, strict=True):
                axes.imshow(picture)
                axes.set(xticks=[], yticks=[])
                axes.grid(False)
                if i == 0:
                    axes.set_title(label, fontsize=8)
                colour = LEAF if seen > threshold else TOMATO
                note = {"facecolor": "white", "edgecolor": "none", "pad": 1.5, "alpha": 0.85}
                axes.text(
                    0.03, 0.05, f"{seen:.2f}", transform=axes.transAxes, fontsize=7, color=colour, bbox=note
                )
        save_figure(figure, path, dpi=110)
