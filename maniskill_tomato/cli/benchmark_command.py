"""The command `maniskill-tomato benchmark`."""

from collections import Counter
from dataclasses import dataclass

from maniskill_tomato.cli.early_checks import check_count, check_policies
from maniskill_tomato.experiments.configs import BenchmarkConfig


@dataclass(frozen=True, kw_only=True)
class Benchmark(BenchmarkConfig):
    """Compare policies on the same held-out episodes: benchmark.json, benchmark.md and plots."""

    def run(self) -> None:
        """Runs what is missing and says where the results are."""
        check_policies("--policies", self.policies)
        check_count("--jobs", self.jobs)

        from maniskill_tomato.experiments.viewpoint_benchmark import run_benchmark

        result = run_benchmark(self)
        if result.left_out is not None:
            print(result.left_out)
        print(result.table)
        counts = Counter(row["episodes"] for row in result.figures.rows)
        print(f"episodes {', '.join(str(count) for count in counts)}")
        print(f"numbers  {self.out / 'benchmark.json'}")
        print(f"page     {result.page}")
