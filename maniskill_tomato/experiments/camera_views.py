"""Rendered views of listed episodes with the truth about each fruit, to measure what a camera makes of them."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import gymnasium as gym
import numpy as np
import torch

from maniskill_tomato.plants.organs import Plant
from maniskill_tomato.sensing.posed_frame import PosedFrame
from maniskill_tomato.sensing.simulated_camera import RENDERED_SIZE

STEP: Final = 0.1
"""Standard deviation of a coordinate of the steps between the views, in [m]."""


@dataclass(frozen=True, eq=False, kw_only=True)
class TrueView:
    """One view."""

    episode: int
    """Its number in the list."""
    frame: PosedFrame
    """Colours, depth, and the true masks of the fruits."""
    fractions: dict[int, float]
    """V_f of each fruit in the picture, by its index in `Plant.fruits`."""
    plant: Plant
    """All fruits."""
    positions_w: np.ndarray[Any, np.dtype[np.float64]]
    """Their centres, world frame, in [m]. Shape (F, 3)."""


def rendered_views(
    episodes: Sequence[int], views: int, size: tuple[int, int] = RENDERED_SIZE
) -> Iterator[TrueView]:
    """Views of validation episodes: the first of each, and those after random steps. It needs a renderer.

    Args:
        episodes: Their numbers in the list.
        views: Of each episode.
        size: Width and height of the pictures, in [px].
    """
    import maniskill_tomato.tasks  # noqa: F401  Registers the environments.

    # The perception of least cost that renders; what it makes of the pictures is not asked.
    env: Any = gym.make(
        "TomatoViewpoint-v1",
        perception="improved_model",
        episodes="validation",
        render_backend="auto",
        sensor_configs={"width": size[0], "height": size[1]},
    )
    world = env.unwrapped.world
    try:
        for episode in episodes:
            env.reset(seed=episode)
            rng = np.random.default_rng(episode)
            for view in range(views):
                if view:
                    env.step(rng.normal(0.0, STEP, 3).astype(np.float32))
                frame = world.game.perception.views(0)[-1].frame
                plant, batch = world.plant_batch.plants[0], world.plant_batch
                fractions = {
                    number: float(
                        world.scene.visibility(
                            world.T_w_camera, torch.tensor([number]), batch.T_world_plant, world.T_w_links
                        ).visible_fraction[0]
                    )
                    for number in frame.true_numbers
                }
                positions = batch.fruit_positions_w(0, list(range(len(plant.fruits))))
                yield TrueView(
                    episode=episode,
                    frame=frame,
                    fractions=fractions,
                    plant=plant,
                    positions_w=positions.double().cpu().numpy(),
                )
    finally:
        env.close()
