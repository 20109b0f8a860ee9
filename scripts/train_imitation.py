"""Imitates a teacher that knows the truth by a policy that sees what a camera sees (behaviour cloning, DAgger).

A training that was stopped goes on where it was. The policies `round-0.pt` (behaviour cloning) and `policy.pt` can be
given to `eval`, `benchmark` and, for reinforcement from there, to `train --initial-policy`.

Examples:
    python scripts/train_imitation.py --out runs/dagger --jobs 2
    python scripts/train_imitation.py --out runs/recurrent --jobs 2 --config.student recurrent
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from maniskill_tomato.learning.imitation.imitation_config import ImitationConfig
from maniskill_tomato.learning.imitation.training import train_imitation
from maniskill_tomato.learning.script import parse_env_options, run_training


@dataclass(frozen=True, kw_only=True)
class Args:
    """Options."""

    out: Path = Path("runs/imitation")
    """Folder of the training."""
    jobs: int = 1
    """Processes that run episodes."""
    env_options: dict[str, str] = field(default_factory=dict)
    """Options of the task: names and values, these as JSON or plain words."""
    config: ImitationConfig = field(default_factory=ImitationConfig)
    """How to train."""


def train(args: Args, report: Callable[[str], None]) -> Path:
    """Trains as the options say."""
    options = parse_env_options(args.env_options)
    return train_imitation(args.out, args.config, args.jobs, options, report)


def main(argv: list[str] | None = None) -> None:
    """Trains; errors made on purpose end with one line and exit status 2."""
    run_training(Args, train, argv, __doc__)


if __name__ == "__main__":
    main()
