"""Trains a view-quality policy for the general task; a training that was stopped goes on where it was.

Examples:
    python scripts/train_view_quality.py --out runs/view-quality --jobs 2
    python scripts/train_view_quality.py --out runs/tuned --start-from runs/view-quality/policy.pt \
        --env-options perception occlusion_model --config.rounds 800 --config.fit.steps 1500
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from maniskill_tomato.learning.script import parse_env_options, run_training
from maniskill_tomato.learning.view_quality.quality_config import QualityTrainConfig
from maniskill_tomato.learning.view_quality.training import train_view_quality


@dataclass(frozen=True, kw_only=True)
class Args:
    """Options."""

    out: Path = Path("runs/view-quality")
    """Folder of the training."""
    jobs: int = 1
    """Processes that run episodes."""
    start_from: Path | None = None
    """A policy to go on from instead of beginning with the planner."""
    env_options: dict[str, str] = field(default_factory=dict)
    """Options of the task: names and values, these as JSON or plain words."""
    config: QualityTrainConfig = field(default_factory=QualityTrainConfig)
    """How to train."""


def train(args: Args, report: Callable[[str], None]) -> Path:
    """Trains as the options say."""
    options = parse_env_options(args.env_options)
    return train_view_quality(args.out, args.config, args.jobs, options, report, args.start_from)


def main(argv: list[str] | None = None) -> None:
    """Trains; errors made on purpose end with one line and exit status 2."""
    run_training(Args, train, argv, __doc__)


if __name__ == "__main__":
    main()
