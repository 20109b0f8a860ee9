"""Drawing the fixed lists of episodes; who solves them is for an oracle to say."""

from collections.abc import Callable, Collection
from dataclasses import replace
from typing import Any

import gymnasium as gym
import torch

from maniskill_tomato.plants.episode_list import Episode
from maniskill_tomato.plants.row import leaf_density_of

CHUNK = 100
"""Episodes drawn before they are looked at again, so that their plants are still at hand."""

FIRST_SEED = 1_000_000
"""Of the fixed lists' first reset."""

SEEDS_A_CHUNK = 1_000
"""Each chunk of a fixed list begins this far from the one before."""


def draw_episodes(split: str, count: int, first_seed: int = 0, taken: Collection[int] = ()) -> list[Episode]:
    """Episodes of `TomatoViewpoint-v1` on different plants of a split, as their list replays them.

    Args:
        split: A name of `plants.spec.SEED_SPLITS`.
        count: How many.
        first_seed: Seed of the first reset; the next ones follow.
        taken: Seeds of plants that are not drawn.
    """
    make: dict[str, Any] = {"num_envs": 1, "obs_mode": "state", "render_backend": "none"}
    env: Any = gym.make("TomatoViewpoint-v1", plant={"seed": split, "pool": None}, **make)
    base = env.unwrapped
    episodes: list[Episode] = []
    plants = set(taken)
    seed = first_seed
    while len(episodes) < count:
        drawn: list[Episode] = []
        while len(drawn) < min(CHUNK, count - len(episodes)):
            soft = base.soft_starts
            env.reset(seed=seed)
            seed += 1
            plant_seed = int(base.planting.seeds[0])
            if plant_seed in plants or base.soft_starts > soft:
                continue
            plants.add(plant_seed)
            drawn.append(_episode(base, plant_seed))
        replayed: Any = gym.make("TomatoViewpoint-v1", episodes=drawn, **make)
        for i, episode in enumerate(drawn):
            _, info = replayed.reset(options={"episode": i})
            start = round(float(info["visible_fraction"][0]), 4)
            episodes.append(replace(episode, start_visibility=start))
        replayed.close()
    env.close()
    return episodes


def extend_episodes(
    split: str, episodes: list[Episode], count: int, on_block: Callable[[list[Episode]], object] | None = None
) -> list[Episode]:
    """A longer list, the given one first.

    Args:
        split: A name of `plant_choice.SEED_SPLITS`.
        episodes: What there is.
        count: How many there are to be.
        on_block: Called with the list after every `CHUNK` episodes.
    """
    longer = list(episodes)
    while len(longer) < count:
        chunk, begun = divmod(len(longer), CHUNK)
        wanted = min(CHUNK - begun, count - len(longer))
        # A chunk that was begun is drawn again, less the plants that it has given.
        taken = {episode.plant_seed for episode in longer}
        longer += draw_episodes(split, wanted, FIRST_SEED + SEEDS_A_CHUNK * chunk, taken)
        if on_block is not None:
            on_block(longer)
    return longer


def _episode(base: Any, plant_seed: int) -> Episode:
    pose = torch.cat([base.planting.position_w[0, :2], base.planting.yaw]).tolist()
    camera = base.belief.camera_position[0].tolist()
    density = leaf_density_of(base._choice.leaf_density, plant_seed)
    return Episode(
        plant_seed=plant_seed,
        leaf_density=1.0 if density is None else density,
        plant_pose=(round(pose[0], 5), round(pose[1], 5), round(pose[2], 5)),
        target=int(base.target_fruit[0]),
        camera_position=(round(camera[0], 5), round(camera[1], 5), round(camera[2], 5)),
        start_visibility=0.0,
    )
