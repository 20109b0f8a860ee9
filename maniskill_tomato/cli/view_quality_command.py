"""`maniskill-tomato train-view-quality`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from maniskill_tomato.cli.arguments import Flat
from maniskill_tomato.cli.early_checks import check_count, check_file
from maniskill_tomato.cli.shared_options import parse_env_options, tell_policy
from maniskill_tomato.learning.view_quality.quality_config import QualityTrainConfig


@dataclass(frozen=True, kw_only=True)
class TrainViewQuality:
    """Learn how much of the target each candidate view would show: the policy that ships for TomatoViewpoint-v1.

    A training that was stopped goes on where it was.
    """

    out: Path = Path("runs/view-quality")
    """Folder of the training."""
    jobs: int = 1
    """Processes that run episodes."""
    start_from: Path | None = None
    """A policy to go on from instead of beginning with the planner."""
    env_options: dict[str, str] = field(default_factory=dict)
    """Options of the task: names and values, these as JSON or plain words."""
    config: Annotated[QualityTrainConfig, Flat] = field(default_factory=QualityTrainConfig)
    """How to train."""

    def run(self) -> None:
        """Trains and says where the policy is."""
        check_count("--jobs", self.jobs)
        check_file("--start-from", self.start_from)
        options = parse_env_options(self.env_options)

        from maniskill_tomato.learning.view_quality.quality_training import train_view_quality

        tell_policy(
            lambda report: train_view_quality(
                self.out, self.config, self.jobs, options, report, self.start_from
            )
        )
