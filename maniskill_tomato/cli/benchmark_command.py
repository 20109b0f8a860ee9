"""`maniskill-tomato benchmark` and `benchmark-rows`."""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from maniskill_tomato.cli.early_checks import check_choice, check_policies
from maniskill_tomato.experiments.configs import BenchmarkConfig, RowBenchmarkConfig
from maniskill_tomato.plants.episode_list import EPISODE_LISTS
from maniskill_tomato.plants.spec import SEED_SPLITS


@dataclass(frozen=True, kw_only=True)
class Benchmark(BenchmarkConfig):
    """Compare policies on the same held-out episodes: benchmark.json, benchmark.md and plots."""

    def run(self) -> None:
        """Runs what is missing and says where the results are."""
        check_policies("--policies", self.policies)
        if not Path(self.episode_list).is_file():
            check_choice("--episode-list", self.episode_list, (*EPISODE_LISTS, "FILE.json"))

        from maniskill_tomato.experiments.viewpoint_benchmark import run_benchmark

        result = run_benchmark(self)
        if result.left_out is not None:
            print(result.left_out)
        print(result.table)
        counts = Counter(row["episodes"] for row in result.figures.rows)
        print(f"episodes {', '.join(str(count) for count in counts)}")
        print(f"numbers  {self.out / 'benchmark.json'}")
        print(f"page     {result.page}")


@dataclass(frozen=True, kw_only=True)
class BenchmarkRows(RowBenchmarkConfig):
    """Judge policies on rows: how many of the tomatoes that can be seen they see, and what it costs.

    Which tomatoes can be seen is asked of the truth, once for every row. A benchmark that was stopped goes on.
    """

    def run(self) -> None:
        """Runs what is missing and prints the table."""
        check_policies("--policies", self.policies)
        check_choice("--split", self.split, tuple(SEED_SPLITS))

        from maniskill_tomato.experiments.row_benchmark import run_row_benchmark

        print(run_row_benchmark(self))
