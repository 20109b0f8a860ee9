"""Records a planner's successful episodes on training plants in ManiSkill's trajectory format.

Usage:
    python scripts/record_demonstrations.py --episodes 200 --out runs/demonstrations
    python scripts/record_demonstrations.py --planner nbv --first-seed 1000
"""

import logging
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from maniskill_tomato.errors import TomatoError
from maniskill_tomato.experiments.policy_runs import PolicySpec, open_for
from maniskill_tomato.learning.imitation.demonstrations import record_demonstrations
from maniskill_tomato.learning.rl.envs import make_env


@dataclass(frozen=True, kw_only=True)
class Args:
    """Options."""

    planner: str = "oracle"
    """Whose moves to record: a planner's name or a policy's file."""
    episodes: int = 100
    """How many to try; those that fail are left out."""
    first_seed: int = 0
    """Seed of the first reset."""
    out: Path = Path("runs/demonstrations")
    """Folder of trajectory.h5 and trajectory.json."""
    contact_free: bool = False
    """Let the oracle avoid the plant."""


def main(args: Args) -> None:
    """Records, and says what."""
    env: Any = make_env("TomatoViewpoint-v1")
    planner = open_for(PolicySpec.parse(args.planner), env, args.contact_free)
    seeds = range(args.first_seed, args.first_seed + args.episodes)
    result = record_demonstrations(env, planner, seeds, args.out)
    print(f"{result.path}: {result.recorded} of {result.tried} episodes, {result.moves} moves")


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    try:
        main(tyro.cli(Args, description=__doc__))
    except TomatoError as error:
        sys.exit(f"error: {error}")
