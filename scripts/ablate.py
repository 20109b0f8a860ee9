"""Compares a preset with variants of it that change one option each, over seeds and tasks.

What is already there is kept, so that it can be stopped and started again; the table is written after every run.

Example:
    python scripts/ablate.py --seeds 0 1 2 3 4 --jobs 2 --out runs/ablation
    python scripts/ablate.py --variants base hindsight-targets --env-ids TomatoViewpointSparse-v1
"""

import logging
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from maniskill_tomato.errors import TomatoError
from maniskill_tomato.experiments.ablation import choose_variants, execute_all, plan
from maniskill_tomato.experiments.ablation_report import write_ablation
from maniskill_tomato.learning.rl.presets import PresetName
from maniskill_tomato.tasks import THESIS_IDS


@dataclass(frozen=True, kw_only=True)
class Args:
    """Compares a preset with variants that change one option each."""

    preset: PresetName = "td3"
    """The configuration that is varied."""
    variants: tuple[str, ...] = ()
    """Names of variants; by default all."""
    env_ids: tuple[str, ...] = THESIS_IDS
    """Tasks."""
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    """Training seeds."""
    episodes: int = 100
    """Evaluation episodes of each run."""
    total_timesteps: int | None = None
    """Another length of the training than the preset's, for trials."""
    jobs: int = 1
    """Runs at a time."""
    out: Path = Path("runs/ablation")
    """Folder of the runs and of ablation.json and ablation.md."""


def main(argv: list[str] | None = None) -> None:
    """Runs what the arguments ask for; errors made on purpose end with one line and exit status 2."""
    logging.basicConfig(level=logging.WARNING, format="%(message)s", stream=sys.stderr)
    args = tyro.cli(Args, args=argv, description=__doc__)
    try:
        variants = choose_variants(args.variants)
        runs = plan(
            args.preset, variants, args.env_ids, args.seeds, args.out, args.episodes, args.total_timesteps
        )
        results: list[dict[str, Any]] = []
        for number, (run, result) in enumerate(execute_all(runs, args.jobs), start=1):
            results.append(result)
            write_ablation(args.preset, variants, results, args.out)
            print(
                f"{number} of {len(runs)}: {run.env_id} {run.variant.name}, seed {run.seed}: "
                f"success {result['success_rate']:.0%}, {result['training_cpu_seconds']:.0f} s of CPU",
                flush=True,
            )
        print((args.out / "ablation.md").read_text())
    except TomatoError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    except KeyboardInterrupt:
        print("stopped; the same command goes on from here", file=sys.stderr)
        raise SystemExit(130) from None


if __name__ == "__main__":
    main()
