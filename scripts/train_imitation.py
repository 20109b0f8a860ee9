"""Imitates a teacher that knows the truth by a policy that sees what a camera sees (behaviour cloning, DAgger).

A training that was stopped goes on where it was. The policies `round-0.pt` (behaviour cloning) and `policy.pt` can be
given to `eval`, `benchmark` and, for reinforcement from there, to `train --initial-policy`.

Examples:
    python scripts/train_imitation.py --out runs/dagger --jobs 2
    python scripts/train_imitation.py --out runs/recurrent --jobs 2 --config.student recurrent
"""

import logging
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

import tyro

from maniskill_tomato.errors import TomatoError
from maniskill_tomato.learning.imitation.training import ImitationConfig, train_imitation


@dataclass(frozen=True, kw_only=True)
class Args:
    """Options."""

    out: Path = Path("runs/imitation")
    """Folder of the training."""
    jobs: int = 1
    """Processes that run episodes."""
    config: ImitationConfig = field(default_factory=ImitationConfig)
    """How to train."""


def main(argv: list[str] | None = None) -> None:
    """Trains; errors made on purpose end with one line and exit status 2."""
    logging.basicConfig(level=logging.WARNING, format="%(message)s", stream=sys.stderr)
    args = tyro.cli(Args, args=argv, description=__doc__)
    start = time.perf_counter()
    try:
        path = train_imitation(args.out, args.config, args.jobs, report=lambda line: print(line, flush=True))
    except TomatoError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    print(f"policy {path} after {time.perf_counter() - start:.0f} s")


if __name__ == "__main__":
    main()
