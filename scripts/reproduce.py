"""Runs the thesis's experiments over several seeds and draws the counterparts of its figures.

Usage:
    python scripts/reproduce.py guided
    python scripts/reproduce.py sparse --seeds 0 1 2 3 4 --out runs/thesis
    python scripts/reproduce.py guided --variant small-actions
    python scripts/reproduce.py guided --ablate
    python scripts/reproduce.py guided --ablate --variant exact tau-0.01 tau-0.01+gamma-0.9 td3-without-gamma-0.9
"""

import json
import logging
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro

from maniskill_tomato.errors import InvalidInputError, TomatoError
from maniskill_tomato.experiments import thesis_figures, thesis_views
from maniskill_tomato.experiments.reproduction import (
    TABLE_HEADER,
    Reproduction,
    RunStoppedError,
    table_row,
    untrained_first_steps,
)
from maniskill_tomato.experiments.thesis_experiments import (
    EXPERIMENTS,
    Experiment,
    ExperimentName,
    Variant,
    find_variant,
    variants_of,
)

logger = logging.getLogger("maniskill_tomato.reproduce")


@dataclass(frozen=True, kw_only=True)
class Args:
    """Reproduce an experiment of the thesis; what is already there is kept, so that it can be stopped and
    started again."""

    experiment: Annotated[ExperimentName, tyro.conf.Positional]
    """guided: section 5-1; sparse: section 5-2."""
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    """Training seeds."""
    out: Path = Path("runs/thesis")
    """Folder of the results; each experiment and variant gets one in it."""
    variant: tuple[str, ...] = ()
    """Names of variants; by default the exact settings alone, or all of them with --ablate. A+B makes two changes, and
    td3-without-A+B puts two parts of the preset td3 back to the exact settings."""
    ablate: bool = False
    """Judge each variant at the training pose only, draw nothing, and write the table ablation.md."""
    episodes: int = 100
    """Evaluation episodes; the first six are the thesis's."""
    untrained: int = 200
    """Freshly initialised actors whose first step is examined."""
    views: bool = True
    """Take the first and last view of the target where this machine can render."""
    training_episodes: int | None = None
    """Another length of the training, for trials."""


def main(argv: list[str] | None = None) -> None:
    """Runs what the arguments ask for; errors made on purpose end with one line and exit status 2."""
    logging.basicConfig(level=logging.WARNING, format="%(message)s", stream=sys.stderr)
    logging.getLogger("maniskill_tomato").setLevel(logging.INFO)
    args = tyro.cli(Args, args=argv, description=__doc__)
    torch.set_num_threads(1)
    try:
        run(args)
    except RunStoppedError:
        print("stopped; the same command goes on from here", file=sys.stderr)
        raise SystemExit(130) from None
    except TomatoError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None


def run(args: Args) -> None:
    """Trains, judges, draws, and says where the results are."""
    if len(set(args.seeds)) != len(args.seeds) or not args.seeds:
        raise InvalidInputError(f"seeds must be one or more different numbers, got {args.seeds}")
    experiment = EXPERIMENTS[args.experiment]
    names = args.variant or (tuple(variants_of(experiment)) if args.ablate else ("exact",))
    chosen = [find_variant(experiment, name) for name in names]
    rows = [TABLE_HEADER]
    for number, variant in enumerate(chosen, start=1):
        logger.info("%s, variant %d of %d: %s", experiment.name, number, len(chosen), variant.title)
        reproduction = make_reproduction(args, experiment, variant)
        evaluations = experiment.evaluations[:1] if args.ablate else experiment.evaluations
        summaries = [reproduction.run_seed(seed, evaluations) for seed in args.seeds]
        untrained = untrained_first_steps(experiment.env_id, reproduction.config, args.untrained)
        (reproduction.folder / "untrained.json").write_text(json.dumps(untrained, indent=2) + "\n")
        rows.append(table_row(variant.title, summaries, untrained))
        print(rows[-1], flush=True)
        if not args.ablate:
            report(args, reproduction, summaries)
    if args.ablate:
        path = args.out / experiment.name / "ablation.md"
        path.write_text("\n".join(rows) + "\n")
        print(f"table   {path}")


def make_reproduction(args: Args, experiment: Experiment, variant: Variant) -> Reproduction:
    """The reproduction of one variant in its folder."""
    return Reproduction(
        experiment=experiment,
        variant=variant,
        folder=args.out / experiment.name / variant.name,
        evaluation_episodes=args.episodes,
        training_episodes=args.training_episodes,
    )


def report(args: Args, reproduction: Reproduction, summaries: list[dict[str, Any]]) -> None:
    """Draws the figures and writes the summary of all seeds."""
    folder = reproduction.folder
    (folder / "summary.json").write_text(json.dumps(summaries, indent=2) + "\n")
    thesis_figures.draw_all(reproduction, args.seeds, folder / "figures")
    if args.views:
        left_out = thesis_views.take_all(reproduction, args.seeds[0], folder / "figures")
        if left_out is not None:
            print(left_out)
    print(f"summary {folder / 'summary.json'}")
    print(f"figures {folder / 'figures'}")


if __name__ == "__main__":
    main()
