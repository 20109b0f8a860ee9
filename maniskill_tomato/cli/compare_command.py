"""`maniskill-tomato compare`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from maniskill_tomato.cli.early_checks import check_folder
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.experiments.configs import RunComparisonConfig


@dataclass(frozen=True, kw_only=True)
class Compare(RunComparisonConfig):
    """Compare training runs: a report with a table over seeds and training curves over steps and time.

    Runs of the same task and options are one configuration; their seeds give the interquartile mean and its 95 %
    interval.
    """

    runs: Annotated[
        tuple[Path, ...],
        tyro.conf.Positional,
        tyro.conf.arg(metavar="RUN [RUN ...]", help_behavior_hint="(required)"),
    ]
    """Run folders, or folders that hold some."""

    def run(self) -> None:
        """Compares and says where the report is."""
        if not self.runs:
            raise InvalidInputError("give one run folder or more, or folders that hold some")
        for path in self.runs:
            check_folder("RUN", path)

        from maniskill_tomato.experiments.run_comparison import compare_runs

        result = compare_runs(self)
        print(result.table)
        print(f"report  {result.report}")
