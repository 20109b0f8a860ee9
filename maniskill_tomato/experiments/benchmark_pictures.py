"""A grid of pictures: what the wrist camera saw first, and what each policy saw last."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from maniskill_tomato.experiments.benchmark_conditions import Condition
from maniskill_tomato.experiments.plots import LEAF, STYLE, TOMATO
from maniskill_tomato.experiments.video import make_film_options
from maniskill_tomato.experiments.view_episode import ViewEpisode
from maniskill_tomato.learning.rl.envs import make_env
from maniskill_tomato.rendering import vulkan_probe

Image = NDArray[np.uint8]

LEFT_OUT = "Left out because this machine cannot render: the grid of views. {hint}."

EPISODES = 5
SHRINK = 2
"""Every second pixel of 640x480 is shown."""


def draw_view_grid(
    runs: Mapping[str, Sequence[ViewEpisode]],
    condition: Condition,
    path: Path,
    env_id: str = "TomatoViewpoint-v1",
    episodes: int = EPISODES,
) -> Path | str:
    """Draws the first episodes, a row each: the start view, then the last view of every policy.

    Args:
        runs: Episodes by policy.
        condition: Under which they were run.
        path: The picture to write.
        env_id: The task.
        episodes: How many rows.

    Returns:
        The path, or a message if this machine cannot render.
    """
    if not vulkan_probe.rendering_available():
        return LEFT_OUT.format(hint=vulkan_probe.NO_RENDERING_HINT.capitalize())
    by_number = {label: {e.episode: e for e in found} for label, found in runs.items() if found}
    common = sorted(set.intersection(*(set(found) for found in by_number.values())))[:episodes]
    options = {
        "render_backend": vulkan_probe.render_backend(),
        **make_film_options(),
        **condition.env_options,
    }
    env = make_env(env_id, **options)
    rows: list[list[tuple[str, float, Image]]] = []
    try:
        for number in common:
            env.reset(seed=number)
            some = next(iter(by_number.values()))[number]
            row = [("start", float(some.visible_fraction[0]), _picture(env, some.qpos[0]))]
            for label, found in by_number.items():
                episode = found[number]
                row.append((label, float(episode.visible_fraction[-1]), _picture(env, episode.qpos[-1])))
            rows.append(row)
    finally:
        env.close()
    _draw(rows, path)
    return path


def _picture(env: Any, qpos: NDArray[np.float64]) -> Image:
    """What the wrist camera sees at some joint angles."""
    import torch

    world = env.unwrapped
    world.agent.robot.set_qpos(torch.as_tensor(qpos, dtype=torch.float32, device=world.device)[None])
    (sensor,) = world.get_sensor_images().values()
    picture: Image = sensor["rgb"][0].cpu().numpy()[::SHRINK, ::SHRINK]
    return picture


def _draw(rows: Sequence[Sequence[tuple[str, float, Image]]], path: Path) -> None:
    columns = len(rows[0])
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(1.65 * columns, 1.35 * len(rows) + 0.3))
        panels = figure.subplots(len(rows), columns, squeeze=False)
        for i, row in enumerate(rows):
            for axes, (label, seen, picture) in zip(panels[i], row, strict=True):
                axes.imshow(picture)
                axes.set(xticks=[], yticks=[])
                axes.grid(False)
                if i == 0:
                    axes.set_title(label, fontsize=8)
                colour = LEAF if seen > 0.8 else TOMATO
                note = {"facecolor": "white", "edgecolor": "none", "pad": 1.5, "alpha": 0.85}
                axes.text(
                    0.03, 0.05, f"{seen:.2f}", transform=axes.transAxes, fontsize=7, color=colour, bbox=note
                )
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=110)
