"""Drawing the fixed lists of episodes; who solves them is for an oracle to say."""

from collections.abc import Callable, Collection
from dataclasses import replace
from typing import Any

from maniskill_tomato.plants.episode_list import Episode
from maniskill_tomato.plants.row import leaf_density_of
from maniskill_tomato.tasks.making import make_world
from maniskill_tomato.tasks.world import World

CHUNK = 100
"""Episodes drawn before they are looked at again, so that their plants are still at hand."""

FIRST_SEED = 1_000_000
"""Of the fixed lists' first reset."""

SEEDS_A_CHUNK = 1_000
"""Each chunk of a fixed list begins this far from the one before."""


def draw_episodes(split: str, count: int, first_seed: int = 0, taken: Collection[int] = ()) -> list[Episode]:
    """Episodes of `TomatoViewpoint-v1` on different plants of a split, as their list replays them.

    Args:
        split: A name of `SEED_SPLITS`.
        count: How many.
        first_seed: Seed of the first reset; the next ones follow.
        taken: Seeds of plants that are not drawn.
    """
    world = make_world("TomatoViewpoint-v1", plant={"seed": split, "pool": None})
    game: Any = world.game
    episodes: list[Episode] = []
    plants = set(taken)
    seed = first_seed
    while len(episodes) < count:
        drawn: list[Episode] = []
        while len(drawn) < min(CHUNK, count - len(episodes)):
            soft = game.soft_starts
            world.reset(seed)
            seed += 1
            plant_seed = int(world.state.plant_seed[0])
            if plant_seed in plants or game.soft_starts > soft:
                continue
            plants.add(plant_seed)
            drawn.append(episode_of(world))
        replayed = make_world("TomatoViewpoint-v1", episodes=drawn)
        for i, episode in enumerate(drawn):
            replayed.reset(options={"episode": i})
            start = round(float(replayed.state.visible_fraction[0]), 4)
            episodes.append(replace(episode, start_visibility=start))
    return episodes


def extend_episodes(
    split: str, episodes: list[Episode], count: int, on_block: Callable[[list[Episode]], object] | None = None
) -> list[Episode]:
    """A longer list, the given one first.

    Args:
        split: A name of `SEED_SPLITS`.
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


def episode_of(world: World) -> Episode:
    """The episode that the first environment of a world has just begun, as a list replays it.

    Its V_f of the first view is left at 0: rounded numbers begin a little elsewhere.
    """
    plant_seed = int(world.state.plant_seed[0])
    x, y, yaw = world.state.plant_pose[0].tolist()
    camera = world.belief.camera_position[0].tolist()
    density = leaf_density_of(world.plant_batch.spec.leaf_density, plant_seed)
    return Episode(
        plant_seed=plant_seed,
        leaf_density=1.0 if density is None else density,
        plant_pose=(round(x, 5), round(y, 5), round(yaw, 5)),
        target=int(world.state.target[0]),
        camera_position=(round(camera[0], 5), round(camera[1], 5), round(camera[2], 5)),
        start_visibility=0.0,
    )
