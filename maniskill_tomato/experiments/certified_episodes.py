"""Episodes on other plants: hidden starts are drawn until the lattice oracle solves as many as wanted."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import torch

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.experiments.result_store import ResultStore
from maniskill_tomato.plants.episode_list import Episode, write_episodes
from maniskill_tomato.plants.kinds import KINDS
from maniskill_tomato.plants.mesh_set import ALL, MeshSource
from maniskill_tomato.plants.seed_splits import SEED_SPLITS
from maniskill_tomato.policies.lattice_oracle import LatticeOracle
from maniskill_tomato.tasks.making import make_world
from maniskill_tomato.tasks.row.episode_sampling import episode_of
from maniskill_tomato.worker_pool import run_jobs

logger = logging.getLogger(__name__)

ENV_ID: Final = "TomatoViewpoint-v1"

GIVE_UP_AFTER: Final = 12
"""Draws in a row on one plant that are no hidden start or that the lattice oracle does not solve."""

FIRST_SEED: Final = 7_000_000
"""Of the first draw on the first plant."""

EPISODES_A_PLANT: Final = 2
"""Of a kind that our generator grows, of which there is no end of plants."""

SEEDS_A_PLANT: Final = 10_000
"""The draws on each plant begin this far from those on the plant before."""

STORED: Final = "certified"
"""Where a benchmark's folder keeps the draws."""


@dataclass(frozen=True, kw_only=True)
class PlantPlace:
    """Where plants come from: mesh files, or a kind that our generator grows."""

    text: str
    """As the user named it."""
    split: str
    """Which of them."""
    mesh: MeshSource | None = None
    kind: str | None = None
    """One of `KINDS`, where there is no mesh."""

    @property
    def plant(self) -> dict[str, Any]:
        """The option `plant` with which a list of episodes there is replayed."""
        if self.mesh is None:
            return {"preset": self.kind, "seed": self.split}
        return {"mesh": self.mesh.path, "seed": ALL}

    @property
    def mesh_seeds(self) -> list[int]:
        """Of the plants of the split; none for a kind, of which there is no end."""
        return [] if self.mesh is None else self.mesh.plants.seeds(self.split)

    @property
    def fingerprint(self) -> str:
        """Says whether stored draws are of the same plants."""
        return str(self.kind) if self.mesh is None else self.mesh.plants.fingerprint

    def name_of(self, seed: int) -> str:
        """What a plant is called."""
        return f"{self.kind} {seed}" if self.mesh is None else self.mesh.plants.files[seed].name


@dataclass(frozen=True, kw_only=True)
class PlantDraws:
    """What was drawn on one plant."""

    episodes: tuple[Episode, ...]
    """Those that the lattice oracle solves, in the order in which they were drawn."""
    unsolved: int
    """Hidden starts that it does not solve."""


@dataclass(frozen=True, kw_only=True)
class CertifiedList:
    """A list of episodes on the plants of a place."""

    path: Path
    """The list's file."""
    plant: dict[str, Any]
    """The option `plant` with which the list is replayed."""
    facts: dict[str, Any]
    """How it came about, for the reader."""


def certify(episode: Episode, plant: Mapping[str, object]) -> Episode:
    """The episode with V_f of its first view and the moves of the lattice oracle, None if it runs out of them.

    Args:
        episode: As it was drawn.
        plant: The option `plant` of the task.
    """
    world = make_world(ENV_ID, episodes=[episode], plant=plant)
    world.reset(options={"episode": 0})
    start = round(float(world.state.visible_fraction[0]), 4)
    oracle = LatticeOracle(world.ground_truth)
    oracle.begin(world.belief, torch.tensor([0], device=world.device))
    task: Any = world.task
    solved = None
    for move in range(1, int(task.max_moves) + 1):
        world.step(oracle.act(world.belief))
        if bool(world.game.info()["success"][0]):
            solved = move
            break
    return replace(episode, oracle_moves=solved, certified=True, start_visibility=start)


def draw_on_plant(plant: Mapping[str, object], count: int, seed: int) -> PlantDraws:
    """Draws hidden starts on one plant until the lattice oracle solves so many, or gives the plant up.

    More are the same ones and others after them.

    Args:
        plant: The option `plant` of the task.
        count: How many are wanted.
        seed: The plant's.
    """
    world = make_world(ENV_ID, plant={**plant, "seed": seed})
    game: Any = world.game
    episodes: list[Episode] = []
    unsolved = failed = 0
    low = next(low for low, high in SEED_SPLITS.values() if low <= seed < high)
    number = FIRST_SEED + SEEDS_A_PLANT * (seed - low)
    while len(episodes) < count and failed < GIVE_UP_AFTER:
        soft = game.soft_starts
        number += 1
        failed += 1
        try:
            world.reset(number)
        except InvalidInputError:
            continue  # The arm reaches none of its ripe fruits where the plant stands now.
        if game.soft_starts > soft:
            continue
        episode = certify(episode_of(world), plant)
        if episode.oracle_moves is None:
            unsolved += 1
            continue
        episodes.append(episode)
        failed = 0
    return PlantDraws(episodes=tuple(episodes), unsolved=unsolved)


def certified_list(
    place: PlantPlace, count: int, store: ResultStore, folder: Path, processes: int
) -> CertifiedList:
    """Episodes on plants of a place that the lattice oracle solves.

    Those on a folder's plants are spread evenly over them, in turn of the plants. Of a kind of ours grow as many plants
    as it takes, with up to `EPISODES_A_PLANT` episodes on each, one plant after the other.

    Args:
        place: Where the plants come from.
        count: How many episodes.
        store: Keeps the draws, so that what was stopped goes on.
        folder: Where the list's file goes.
        processes: How many at a time.

    Raises:
        InvalidInputError: There are no plants, or the oracle solves fewer episodes on them.
    """
    kind = place.kind is not None
    seeds = list(range(*SEED_SPLITS[place.split])[:count]) if kind else place.mesh_seeds
    wanted = EPISODES_A_PLANT if kind else -(-count // len(seeds))
    stored = {seed: _read(result, wanted) for seed, result in store.read(STORED, "plants").items()}
    found = {seed: draws for seed, draws in stored.items() if draws is not None}
    work = partial(draw_on_plant, place.plant, wanted)

    def draw(some: Sequence[int]) -> int:
        for seed, draws in run_jobs(work, [seed for seed in some if seed not in found], processes):
            found[seed] = draws
            result = {
                "wanted": wanted,
                "unsolved": draws.unsolved,
                "episodes": [asdict(e) for e in draws.episodes],
            }
            store.add(STORED, "plants", {seed: result})
            logger.info("%s: %d of %d episodes", place.name_of(seed), len(draws.episodes), wanted)
        return sum(len(found[seed].episodes) for seed in some)

    used = [] if kind else seeds
    total = draw(used)
    while total < count and len(used) < len(seeds):
        used = seeds[: len(used) + -(-(count - total) // wanted)]
        total = draw(used)
    drawn = [found[seed] for seed in used]
    in_turn = [d.episodes[k] for k in range(wanted) for d in drawn if k < len(d.episodes)]
    turns = ([e for d in drawn for e in d.episodes] if kind else in_turn)[:count]
    barren = sum(not draws.episodes for draws in drawn)
    if len(turns) < count:
        raise InvalidInputError(
            f"the lattice oracle solves only {len(turns)} episodes on the {len(used)} plants of {place.text}, "
            f"--episodes asks for {count}; on {barren} plants it solves none of {GIVE_UP_AFTER} draws: are their ripe "
            "fruits in the arm's reach, and hidden from somewhere?"
        )
    path = folder / f"episodes_{count}.json"
    write_episodes(path, turns, place.plant)
    facts = {
        "plants": f"{len(used) - barren} of {len(used)} ({place.split})",
        "oracle": LatticeOracle.name,
        "hidden starts that it does not solve": sum(d.unsolved for d in drawn),
    }
    return CertifiedList(path=path, plant=place.plant, facts=facts)


def parse_place(text: str) -> PlantPlace:
    """Reads FOLDER, KIND, or either with a split as FOLDER:SPLIT; the split is `held_out` unless it is said.

    Raises:
        InvalidInputError: There is no such folder, kind or split, or the folder has no plants of that split.
    """
    first, colon, split = text.rpartition(":")
    if not colon or Path(text).exists():
        first, split = text, "held_out"
    splits = SEED_SPLITS if first in KINDS else (*SEED_SPLITS, ALL)
    if split not in splits:
        raise InvalidInputError.choice("the split of --plants FOLDER:SPLIT", split, splits)
    if first in KINDS:
        return PlantPlace(text=text, split=split, kind=first)
    if not Path(first).exists():
        raise InvalidInputError(
            f"there is no mesh file and no folder {first}; --plants takes one of them, or a kind of ours: "
            f"{', '.join(KINDS)}"
        )
    mesh = MeshSource.parse(str(Path(first).resolve()))
    mesh.plants.seeds(split)
    return PlantPlace(text=text, split=split, mesh=mesh)


def _read(result: Mapping[str, Any], wanted: int) -> PlantDraws | None:
    """Draws as they were stored; None if more are wanted now."""
    episodes = tuple(Episode(**row) for row in result["episodes"])
    if result["wanted"] < wanted and len(episodes) == result["wanted"]:
        return None
    return PlantDraws(episodes=episodes[:wanted], unsolved=result["unsolved"])
