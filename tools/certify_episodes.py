"""Certifies the fixed lists of episodes: asks the oracle in how many moves each target can be seen.

A list that is shorter than --count is made longer first, with episodes as the task draws them from a split. Only
episodes that were not asked about are; the list is written after every block, so that a run that was stopped goes on.

Usage:
    python tools/certify_episodes.py --list held_out --count 1000 --jobs 2
    python tools/certify_episodes.py --list validation --count 200
    python tools/certify_episodes.py --list held_out --count 200 --fresh-seed 5000000 --out runs/fresh.json
"""

import functools
import logging
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from maniskill_tomato.assets import ASSETS_DIR
from maniskill_tomato.errors import InvalidInputError, TomatoError
from maniskill_tomato.learning.rl.envs import make_env
from maniskill_tomato.plants.episode_list import (
    EPISODE_LISTS,
    Episode,
    load_episodes,
    read_episodes,
    write_episodes,
)
from maniskill_tomato.policies.oracle import OracleSearch
from maniskill_tomato.tasks.row.episode_sampling import draw_episodes, extend_episodes
from maniskill_tomato.worker_pool import run_jobs

logger = logging.getLogger("certify_episodes")

BLOCK = 20
"""Episodes that one process certifies at a time."""


@dataclass(frozen=True, kw_only=True)
class Args:
    """Options."""

    list: str
    """validation or held_out."""
    count: int
    """How many episodes the list is to hold at least."""
    out: Path | None = None
    """File of the list; by default that of the package."""
    fresh_seed: int | None = None
    """Draw a new list instead, of plants of that split that no list of the package has, from this reset seed on."""
    jobs: int = 1
    """Processes at a time."""
    contact_free: bool = False
    """Ask for a way that does not touch the plant."""
    again: bool = False
    """Also ask about episodes that are certified already."""


def certify(episodes: list[Episode], contact_free: bool) -> list[Episode]:
    """The episodes with the fewest moves that the oracle finds within the task's limit."""
    env: Any = make_env("TomatoViewpoint-v1", episodes=episodes)
    world = env.unwrapped
    search = OracleSearch(world.ground_truth, world.device, contact_free=contact_free)
    certified = []
    for number, episode in enumerate(episodes):
        env.reset(options={"episode": number})
        belief = world.belief
        solution = search.solve(
            belief.camera_position[0], belief.target_position[0], 0, int(world.task.max_moves)
        )
        moves = None if solution is None else solution.moves
        certified.append(replace(episode, oracle_moves=moves, certified=True))
    env.close()
    return certified


def certify_all(episodes: list[Episode], args: Args) -> Iterator[list[Episode]]:
    """The list after each further block is certified."""
    known = list(episodes)
    open_ones = [i for i, episode in enumerate(episodes) if args.again or not episode.certified]
    blocks = [open_ones[i : i + BLOCK] for i in range(0, len(open_ones), BLOCK)]
    work = functools.partial(_certify_some, episodes, args.contact_free)
    for block, certified in run_jobs(work, blocks, args.jobs):
        for i, episode in zip(block, certified, strict=True):
            known[i] = episode
        yield known


def _certify_some(episodes: list[Episode], contact_free: bool, numbers: list[int]) -> list[Episode]:
    return certify([episodes[i] for i in numbers], contact_free)


def describe(episodes: list[Episode]) -> str:
    """How many are solved, and in how many moves."""
    moves = np.array([e.oracle_moves for e in episodes if e.oracle_moves is not None])
    text = f"{len(episodes)} episodes, {len(moves)} solved by the oracle"
    if not len(moves):
        return text
    shares = ", ".join(f"{k}: {np.mean(moves == k):.1%}" for k in sorted(set(moves.tolist())))
    return f"{text}, mean moves {moves.mean():.3f} ({shares})"


def main(args: Args) -> None:
    """Draws the list if there is none, and certifies it."""
    if args.list not in EPISODE_LISTS:
        raise InvalidInputError.choice("--list", args.list, EPISODE_LISTS)
    if args.count < 1 or args.jobs < 1:
        raise InvalidInputError(f"--count and --jobs must be 1 or more, got {args.count} and {args.jobs}")
    if args.fresh_seed is not None and args.out is None:
        raise InvalidInputError("--fresh-seed draws a new list; say with --out where it goes")
    out = args.out or ASSETS_DIR / "episodes" / f"{args.list}.json"
    episodes = list(read_episodes(out)) if out.is_file() else []

    def keep(longer: list[Episode]) -> None:
        write_episodes(out, longer)
        logger.info("%d of %d drawn", len(longer), args.count)

    if args.fresh_seed is None:
        episodes = extend_episodes(args.list, episodes, args.count, keep)
    elif len(episodes) < args.count:
        taken = {episode.plant_seed for name in EPISODE_LISTS for episode in load_episodes(name)}
        episodes = draw_episodes(args.list, args.count, args.fresh_seed, taken)
        keep(episodes)
    started = time.monotonic()
    for known in certify_all(episodes, args):
        write_episodes(out, known)
        episodes = list(known)
        done = sum(episode.certified for episode in known)
        logger.info("%d of %d certified, %.0f s", done, len(known), time.monotonic() - started)
    print(f"{out}: {describe(episodes)}")


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    try:
        main(tyro.cli(Args, description=__doc__))
    except TomatoError as error:
        sys.exit(f"error: {error}")
