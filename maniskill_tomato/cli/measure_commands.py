"""Commands that compare: `benchmark`, `benchmark-rows`, `compare`, `reproduce` and `ablate`."""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, get_args

import tyro

from maniskill_tomato.cli.early_checks import (
    check_choice,
    check_env_id,
    check_folder,
    check_place,
    check_policies,
)
from maniskill_tomato.cli.shared_options import say
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.experiments.configs import (
    AblationConfig,
    BenchmarkConfig,
    ExperimentName,
    ReproductionConfig,
    RowBenchmarkConfig,
    RunComparisonConfig,
)
from maniskill_tomato.experiments.variants import choose_variants, experiments, find_variant
from maniskill_tomato.learning.rl.presets import PRESETS
from maniskill_tomato.plants.episode_list import EPISODE_LISTS
from maniskill_tomato.plants.seed_splits import SEED_SPLITS
from maniskill_tomato.ray_jobs import jobs_on_ray
from maniskill_tomato.sensing.perception_kinds import Perception
from maniskill_tomato.tasks import TASK_IDS


@dataclass(frozen=True, kw_only=True)
class Benchmark(BenchmarkConfig):
    """Compare policies on the same held-out episodes: benchmark.json, plots and report.html."""

    ray: bool = False
    """Do the work on a Ray cluster (extra `ray`): the one at RAY_ADDRESS, else one of this machine's cores."""

    def run(self) -> None:
        """Runs what is missing and says where the results are."""
        check_policies("--policies", self.policies)
        check_env_id(self.env_id)
        if self.plants is not None:
            check_place("--plants", self.plants)
        elif not Path(self.episode_list).is_file():
            check_choice("--episode-list", self.episode_list, (*EPISODE_LISTS, "FILE.json"))

        from maniskill_tomato.experiments.viewpoint_benchmark import run_benchmark

        with jobs_on_ray(self.ray):
            result = run_benchmark(self)
        if result.left_out is not None:
            print(result.left_out)
        print(result.table)
        counts = Counter(row["episodes"] for row in result.figures.rows)
        print(f"episodes {', '.join(str(count) for count in counts)}")
        print(f"numbers  {self.out / 'benchmark.json'}")
        print(f"report   {result.page}")


@dataclass(frozen=True, kw_only=True)
class BenchmarkRows(RowBenchmarkConfig):
    """Judge policies on rows: how many of the tomatoes that can be seen they see, and what it costs.

    Which tomatoes can be seen is asked of the truth, once for every row. A benchmark that was stopped goes on.
    """

    def run(self) -> None:
        """Runs what is missing and prints the table."""
        check_policies("--policies", self.policies)
        check_choice("--split", self.split, tuple(SEED_SPLITS))
        check_choice("--perception", self.perception, get_args(Perception))

        from maniskill_tomato.experiments.row_benchmark import run_row_benchmark

        done = run_row_benchmark(self)
        print(done.text)
        print(f"report  {done.report}")


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


@dataclass(frozen=True, kw_only=True)
class Reproduce(ReproductionConfig):
    """Reproduce an experiment of the thesis over several seeds and draw the counterparts of its figures.

    What is already there is kept, so that it can be stopped and started again.
    """

    experiment: Annotated[ExperimentName, tyro.conf.Positional]
    """guided: section 5-1; sparse: section 5-2."""
    ray: bool = False
    """Do the work on a Ray cluster (extra `ray`): the one at RAY_ADDRESS, else one of this machine's cores."""

    def run(self) -> None:
        """Trains and judges what is missing, and says where the results are."""
        for name in self.variant:
            find_variant(experiments()[self.experiment], name)

        from maniskill_tomato.experiments.reproduction import run_reproduction

        with jobs_on_ray(self.ray):
            run_reproduction(self, say)


@dataclass(frozen=True, kw_only=True)
class Ablate(AblationConfig):
    """Compare a preset with variants of it that change one option each, over seeds and tasks.

    What is already there is kept, so that it can be stopped and started again; the table is written after every run.
    """

    def run(self) -> None:
        """Trains and judges what is missing, and prints the table."""
        check_choice("--preset", self.preset, tuple(PRESETS))
        choose_variants(self.variants)
        for env_id in self.env_ids:
            check_choice("--env-ids", env_id, TASK_IDS)

        from maniskill_tomato.experiments.ablation import run_ablation

        say(run_ablation(self, say))
