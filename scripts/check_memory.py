"""Shows that an environment with a new plant at every reset does not grow: memory over many steps and resets, as JSON.

Usage:
    TOMATO_PLANT_STORE_MB=200 python scripts/check_memory.py --out memory.json

The memory rises until the store of plants is full. After that its line must be flat: the mean of the last quarter may
lie `--most-mib` above that of the second quarter.
"""

import os
import statistics
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import tyro

import maniskill_tomato  # noqa: F401
from maniskill_tomato.files import write_json
from maniskill_tomato.plants.plant_store import PLANT_STORE, store_limit

MIB = 2**20


@dataclass(frozen=True, kw_only=True)
class Args:
    """What to run and where to write it."""

    out: Path = Path("memory.json")
    """The JSON file."""
    env_id: str = "TomatoViewpoint-v1"
    """The task."""
    resets: int = 1000
    """Each brings a new plant."""
    steps: int = 20_000
    """Spread evenly over the resets."""
    readings: int = 40
    """How often the memory is read."""
    most_mib: float = 30.0
    """What the last quarter may lie above the second, in [MiB]."""


def resident_mib() -> float:
    """Memory of this process that is in RAM, in [MiB]."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / MIB


def main() -> None:
    args = tyro.cli(Args, description=__doc__)
    env: Any = gym.make(
        args.env_id, obs_mode="state", render_backend="none", plant={"seed": "train"}, num_envs=1
    )
    rng = np.random.default_rng(0)
    line = []
    for reset in range(args.resets):
        env.reset(seed=reset)
        for _ in range(args.steps // args.resets):
            env.step(rng.uniform(-0.05, 0.05, env.action_space.shape).astype(np.float32))
        if (reset + 1) % max(args.resets // args.readings, 1) == 0:
            store = PLANT_STORE.size / MIB
            line.append(
                {"resets": reset + 1, "resident_mib": round(resident_mib(), 1), "store_mib": round(store, 1)}
            )
            print(line[-1], flush=True)
    env.close()
    memory = [point["resident_mib"] for point in line]
    quarter = len(memory) // 4
    growth = statistics.mean(memory[-quarter:]) - statistics.mean(memory[quarter : 2 * quarter])
    content = {
        "env_id": args.env_id,
        "resets": args.resets,
        "steps": args.resets * (args.steps // args.resets),
        "store_limit_mib": round(store_limit() / MIB, 1),
        "growth_mib": round(growth, 1),
        "line": line,
    }
    write_json(args.out, content)
    if growth > args.most_mib:
        raise SystemExit(f"it grew by {growth:.1f} MiB")


if __name__ == "__main__":
    main()
