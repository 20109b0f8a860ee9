"""Settings of the next-best-view planners compared on validation plants.

Usage:
    python tools/tune_next_best_view.py --episodes 120 --first-seed 50000
"""

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from maniskill_tomato.errors import TomatoError
from maniskill_tomato.experiments.episode_record import EpisodeRecord
from maniskill_tomato.experiments.metrics import summarise_policy
from maniskill_tomato.experiments.rollout import run_episode
from maniskill_tomato.learning.rl.envs import make_env
from maniskill_tomato.policies.next_best_view import NextBestDirection, NextBestView


@dataclass(frozen=True, kw_only=True)
class Args:
    """Options."""

    episodes: int = 120
    """Episodes on validation plants, the same for all."""
    first_seed: int = 50000
    """Seed of the first of them."""
    planner: str = "nbv"
    """nbv or nbv_direction."""
    move_cost: tuple[float, ...] = (0.02, 0.05, 0.1, 0.15, 0.2)
    """Costs of a move that are tried, in expected V_f."""
    out: Path | None = None
    """JSON file of the figures."""


def main(args: Args) -> None:
    """Runs all settings on each plant in turn, so that it grows once, and prints a line for each."""
    kind = NextBestDirection if args.planner == NextBestDirection.name else NextBestView
    env: Any = make_env("TomatoViewpoint-v1", plant={"seed": "validation", "pool": None})
    planners = [kind(cost) for cost in args.move_cost]
    found: list[list[EpisodeRecord]] = [[] for _ in planners]
    for seed in range(args.first_seed, args.first_seed + args.episodes):
        for planner, episodes in zip(planners, found, strict=True):
            episodes.append(run_episode(env, planner, seed))
    rows = []
    for planner, episodes in zip(planners, found, strict=True):
        figures = summarise_policy(kind.name, episodes, int(env.unwrapped.task.max_moves))
        rows.append({"move_cost": planner.move_cost, **figures})
        print(
            f"move_cost {planner.move_cost:g}  success {figures['success_rate']:.3f}  "
            f"within 5 {figures['success_rate_within_moves']['5']:.3f}  moves {figures['mean_moves']:.2f}  "
            f"path {figures['mean_path_m']:.2f} m  contact {figures['contact_episode_rate']:.2f}"
        )
    if args.out is not None:
        args.out.parent.mkdir(parents=True, exist_ok=True)
        args.out.write_text(json.dumps(rows, indent=2, allow_nan=False) + "\n", encoding="utf-8")


if __name__ == "__main__":
    try:
        main(tyro.cli(Args, description=__doc__))
    except TomatoError as error:
        sys.exit(f"error: {error}")
