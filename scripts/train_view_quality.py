"""Trains a view-quality policy for the general task; a training that was stopped goes on where it was.

Example:
    python scripts/train_view_quality.py --out runs/view-quality --jobs 2
"""

import logging
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

import tyro

from maniskill_tomato.errors import TomatoError
from maniskill_tomato.learning.view_quality.training import QualityTrainConfig, train_view_quality


@dataclass(frozen=True, kw_only=True)
class Args:
    """Options."""

    out: Path = Path("runs/view-quality")
    """Folder of the training."""
    jobs: int = 1
    """Processes that run episodes."""
    config: QualityTrainConfig = field(default_factory=QualityTrainConfig)
    """How to train."""


def main(argv: list[str] | None = None) -> None:
    """Trains; errors made on purpose end with one line and exit status 2."""
    logging.basicConfig(level=logging.WARNING, format="%(message)s", stream=sys.stderr)
    args = tyro.cli(Args, args=argv, description=__doc__)
    start = time.perf_counter()
    try:
        path = train_view_quality(
            args.out, args.config, args.jobs, report=lambda line: print(line, flush=True)
        )
    except TomatoError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    print(f"policy {path} after {time.perf_counter() - start:.0f} s")


if __name__ == "__main__":
    main()
