"""Judges policies on rows: how many of the tomatoes that can be seen they see, and what it costs.

Which tomatoes can be seen is asked of the truth, once for every row. A benchmark that was stopped goes on where it was.

Usage:
    python scripts/benchmark_rows.py --policies view_quality,nbv,random_viewpoint --rows 30 --out runs/rows
"""

import json
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from tqdm import tqdm

from maniskill_tomato.errors import InvalidInputError, TomatoError
from maniskill_tomato.experiments.benchmark_policies import parse_policies
from maniskill_tomato.experiments.row_benchmark import (
    RowResult,
    SeeableTomatoes,
    compare_rows,
    rows_table,
    search_row,
)
from maniskill_tomato.files import write_atomically
from maniskill_tomato.learning.rl.envs import make_env

ENV_ID = "TomatoViewpointRow-v1"


@dataclass(frozen=True, kw_only=True)
class Args:
    """Options."""

    policies: str = "view_quality,nbv,random_viewpoint"
    """Names of planners, files of trained policies, or LABEL=FILE, with commas between them."""
    rows: int = 30
    """How many rows."""
    seed: int = 1000
    """Seed of the first; the others follow."""
    split: str = "held_out"
    """Split of the plants: held_out to report, validation to choose."""
    transits: str = "both"
    """When the arm goes by its ready posture: none, target, refused or both."""
    out: Path = Path("runs/rows")
    """Folder of the results."""


def main(args: Args) -> None:
    """Runs what is not yet in the results and writes them after every row."""
    if args.rows < 1:
        raise InvalidInputError(f"--rows must be 1 or more, got {args.rows}")
    specs = parse_policies(args.policies)
    path = args.out / f"rows-{args.split}-{args.transits}.json"
    stored: dict[str, Any] = json.loads(path.read_text()) if path.is_file() else {"seeable": {}, "rows": {}}
    seeds = range(args.seed, args.seed + args.rows)
    env = make_env(ENV_ID, plant={"seed": args.split, "pool": None}, transits=args.transits)
    world: Any = env.unwrapped
    truth = SeeableTomatoes(env)
    makers = [(spec.label, spec.make(env)) for spec in specs]
    for seed in tqdm(seeds, desc="rows", disable=None):
        if str(seed) not in stored["seeable"]:
            env.reset(seed=seed)
            stored["seeable"][str(seed)] = truth.among(world.open_targets(0))
        for label, policy in makers:
            rows = stored["rows"].setdefault(label, {})
            if str(seed) not in rows:
                rows[str(seed)] = asdict(search_row(env, policy, seed))
        write_atomically(path, json.dumps(stored).encode())
    env.close()
    results = {
        spec.label: [RowResult.from_json(stored["rows"][spec.label][str(seed)]) for seed in seeds]
        for spec in specs
    }
    # What was seen can be seen, even where the samples missed the view.
    seeable = {
        seed: set(stored["seeable"][str(seed)]).union(*(rows[i].seen for rows in results.values()))
        for i, seed in enumerate(seeds)
    }
    text = rows_table(results, seeable) + "\n" + "\n".join(compare_rows(results, seeable)) + "\n"
    write_atomically(path.with_suffix(".md"), text.encode())
    print(text)


if __name__ == "__main__":
    torch.set_num_threads(1)
    try:
        main(tyro.cli(Args, description=__doc__))
    except TomatoError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
