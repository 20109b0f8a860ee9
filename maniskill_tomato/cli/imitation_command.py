"""`maniskill-tomato train-imitation`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from maniskill_tomato.cli.arguments import Flat
from maniskill_tomato.cli.early_checks import check_count
from maniskill_tomato.cli.shared_options import parse_env_options, tell_policy
from maniskill_tomato.learning.imitation.imitation_config import ImitationConfig


@dataclass(frozen=True, kw_only=True)
class TrainImitation:
    """Imitate a teacher that knows the truth by a policy that sees what a camera sees.

    The first round is behaviour cloning, the later ones are DAgger. A training that was stopped goes on where it was.
    `eval` and `benchmark` take its policies round-0.pt (behaviour cloning) and policy.pt, and `train --initial-policy`
    goes on from one by reinforcement.
    """

    out: Path = Path("runs/imitation")
    """Folder of the training."""
    jobs: int = 1
    """Processes that run episodes."""
    env_options: dict[str, str] = field(default_factory=dict)
    """Options of the task: names and values, these as JSON or plain words."""
    config: Annotated[ImitationConfig, Flat] = field(default_factory=ImitationConfig)
    """How to train."""

    def run(self) -> None:
        """Trains and says where the policy is."""
        check_count("--jobs", self.jobs)
        options = parse_env_options(self.env_options)

        from maniskill_tomato.learning.imitation.imitation_training import train_imitation

        tell_policy(lambda report: train_imitation(self.out, self.config, self.jobs, options, report))
