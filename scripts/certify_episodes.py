"""Writes the fixed lists of episodes: draws them, and asks the oracle for the fewest moves.

Every episode is a plant of the list's split, its pose, a target, and a start view in which V_f is below the task's
limit, as `TomatoViewpoint-v1` draws them from the seed of the episode's number. The oracle then says in how many moves
the target can be seen, or that it finds no way. A list that was begun is gone on with.

Usage:
    python scripts/certify_episodes.py --list held_out --count 1000 --jobs 2
    python scripts/certify_episodes.py --list validation --count 200
"""

import json
import logging
import multiprocessing
import os
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro

from maniskill_tomato.assets import ASSETS_DIR
from maniskill_tomato.errors import InvalidInputError, TomatoError
from maniskill_tomato.learning.envs import make_env
from maniskill_tomato.planners.env_truth import EnvironmentTruth
from maniskill_tomato.planners.oracle import OracleSearch
from maniskill_tomato.tasks.episode_list import EPISODE_LISTS, Episode, read_episodes, write_episodes

logger = logging.getLogger("certify_episodes")

BLOCK = 10
MOST_SKIPPED = 1000
"""Seeds in a row without a hard start before it gives up."""


@dataclass(frozen=True, kw_only=True)
class Args:
    """Options."""

    list: str
    """validation or held_out."""
    count: int
    """How many episodes."""
    out: Path | None = None
    """File to write; by default that of the package."""
    jobs: int = 1
    """Processes at a time."""
    contact_free: bool = False
    """Ask for a way that does not touch the plant."""


_kept: dict[str, Any] = {}


def draw_episode(name: str, seed: int, contact_free: bool) -> dict[str, Any] | None:
    """One certified episode as the task draws it from a seed; None if its start is not hard enough."""
    if _kept.get("name") != name:
        _kept.update(name=name, env=make_env("TomatoViewpoint-v1", plant={"seed": name, "pool": None}))
    env = _kept["env"]
    world: Any = env.unwrapped
    _, info = env.reset(seed=seed)
    situation = world.situation
    low, high = world.task.start_visibility
    seen = float(info["visible_fraction"][0])
    if not low <= seen < high:
        return None
    truth = EnvironmentTruth(env, contact_free)
    search = OracleSearch(truth, truth.threshold, world.device, accept=truth.can_follow)
    solution = search.solve(
        situation.camera_position[0], situation.target_position[0], 0, int(world.task.max_moves)
    )
    pose = torch.cat([world.planting.position_w[0, :2], world.planting.yaw[:1]]).tolist()
    plant = world.planting.plants[0]
    episode = Episode(
        plant_seed=int(world.planting.seeds[0]),
        leaf_density=round(float(getattr(plant, "leaf_density", 1.0)), 4),
        plant_pose=tuple(round(value, 5) for value in pose),
        target=int(world.target_fruit[0]),
        camera_position=tuple(round(value, 5) for value in situation.camera_position[0].tolist()),
        start_visibility=round(seen, 4),
        oracle_moves=None if solution is None else solution.moves,
        certified=True,
    )
    return asdict(episode)


def _start_process() -> None:
    os.environ["OMP_NUM_THREADS"] = "1"
    torch.set_num_threads(1)


def main(args: Args) -> None:
    """Draws, certifies and writes; every `BLOCK` episodes are on the disk at once."""
    if args.list not in EPISODE_LISTS:
        raise InvalidInputError.choice("--list", args.list, EPISODE_LISTS)
    out = args.out or ASSETS_DIR / "episodes" / f"{args.list}.json"
    journal = out.with_suffix(".journal.jsonl")
    found: dict[int, dict[str, Any] | None] = {}
    if journal.is_file():
        for line in journal.read_text(encoding="utf-8").splitlines():
            entry = json.loads(line)
            found[entry["seed"]] = entry["episode"]
        logger.info("going on with %d seeds of %s", len(found), journal)
    started = time.monotonic()
    journal.parent.mkdir(parents=True, exist_ok=True)
    with (
        journal.open("a", encoding="utf-8") as file,
        ProcessPoolExecutor(
            args.jobs, mp_context=multiprocessing.get_context("spawn"), initializer=_start_process
        ) as pool,
    ):
        seed = 0
        while sum(episode is not None for episode in found.values()) < args.count:
            seeds = [s for s in range(seed, seed + BLOCK * args.jobs) if s not in found]
            seed += BLOCK * args.jobs
            drawn = pool.map(draw_episode, [args.list] * len(seeds), seeds, [args.contact_free] * len(seeds))
            for number, episode in zip(seeds, drawn, strict=True):
                found[number] = episode
                file.write(json.dumps({"seed": number, "episode": episode}) + "\n")
                file.flush()
            good = sum(episode is not None for episode in found.values())
            if seed > MOST_SKIPPED and good == 0:
                raise InvalidInputError(f"none of {seed} seeds gives a hard start; check the task's ranges")
            if seeds:
                logger.info("%d of %d episodes, %.0f s", good, args.count, time.monotonic() - started)
    episodes = [Episode(**found[s]) for s in sorted(found) if found[s] is not None][: args.count]  # type: ignore[arg-type]
    write_episodes(out, episodes)
    journal.unlink()
    moves = [e.oracle_moves for e in read_episodes(out) if e.oracle_moves is not None]
    print(f"{out}: {len(episodes)} episodes, {len(moves)} solved by the oracle")
    if moves:
        shares = ", ".join(f"{k}: {np.mean(np.array(moves) == k):.1%}" for k in sorted(set(moves)))
        print(f"mean moves {np.mean(moves):.3f}; {shares}")


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    try:
        main(tyro.cli(Args, description=__doc__))
    except TomatoError as error:
        sys.exit(f"error: {error}")
