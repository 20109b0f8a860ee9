"""The command `maniskill-tomato benchmark`."""

import dataclasses
import os
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from maniskill_tomato.cli.early_checks import check_count, check_policies
from maniskill_tomato.errors import InvalidInputError

# PyTorch and ManiSkill take seconds to import; the command imports what it needs when it runs.

DEFAULT_POLICIES = (
    "random_viewpoint,fixed_sweep,3dmts,gradient_nbv,nbv_direction,nbv,view_quality,greedy_truth,oracle"
)


@dataclass(frozen=True, kw_only=True)
class Benchmark:
    """Compare policies on the same held-out episodes: benchmark.json, benchmark.md and plots."""

    policies: str = DEFAULT_POLICIES
    """Names of planners, files of trained policies, or LABEL=FILE, with commas between them."""
    episodes: int = 500
    """How many episodes of the list."""
    episode_list: str = "held_out"
    """Which fixed list: held_out to report, validation to choose, or a file of `tools/certify_episodes.py`."""
    seed: int = 0
    """The first of them."""
    out: Path = Path("runs/benchmark")
    """Folder of the results. A benchmark that was stopped goes on there, and one with more policies or episodes keeps
    what is done."""
    jobs: int | None = None
    """Processes at a time; by default one per processor core."""
    sweeps: str = ""
    """Also sweep over these, with commas: leaf_density, start_visibility, segmentation, depth, pose; or `all`."""
    sweep_episodes: int = 100
    """Episodes for each value of a sweep."""
    sweep_policies: str = ""
    """Which of the policies to sweep; all by default."""
    contact_free_oracle: bool = False
    """Let the oracle avoid the plant."""
    pictures: bool = True
    """Draw a grid of last views where this machine can render."""

    def run(self) -> None:
        """Runs what is missing and says where the results are."""
        check_policies("--policies", self.policies)
        check_count("--jobs", self.jobs)

        from maniskill_tomato.experiments.benchmark import BenchmarkConfig, run_benchmark
        from maniskill_tomato.experiments.benchmark_conditions import SWEEPS, main_condition, sweep_conditions
        from maniskill_tomato.experiments.benchmark_pictures import draw_view_grid
        from maniskill_tomato.experiments.benchmark_policies import parse_policies
        from maniskill_tomato.experiments.benchmark_report import (
            evaluate_runs,
            markdown_table,
            write_benchmark,
        )
        from maniskill_tomato.experiments.benchmark_store import EpisodeStore
        from maniskill_tomato.plants.episode_list import EPISODE_LISTS, load_episodes
        from maniskill_tomato.policies.registry import PRIVILEGED
        from maniskill_tomato.tasks.row.config import GeneralTaskConfig

        specs = parse_policies(self.policies)
        main = main_condition(self.episode_list)
        listed = len(load_episodes(self.episode_list))
        axes = (
            list(SWEEPS) if self.sweeps == "all" else [a.strip() for a in self.sweeps.split(",") if a.strip()]
        )
        if axes and self.episode_list not in EPISODE_LISTS:
            raise InvalidInputError(
                f"--sweeps grows plants of a split and needs --episode-list {' or '.join(EPISODE_LISTS)}"
            )
        swept = [condition for axis in axes for condition in sweep_conditions(axis, main.name)]
        wanted_counts = {"--episodes": self.episodes} | (
            {"--sweep-episodes": self.sweep_episodes} if swept else {}
        )
        for name, count in wanted_counts.items():
            if count < 1 or self.seed + count > listed:
                raise InvalidInputError(
                    f"{name} must be 1 or more, and --seed plus {name} at most {listed}, the number of episodes in "
                    f"the list {main.name}; got {self.seed} and {count}"
                )
        chosen = [label.strip() for label in self.sweep_policies.split(",") if label.strip()]
        labels = [spec.label for spec in specs]
        for label in chosen:
            if label not in labels:
                raise InvalidInputError.choice("--sweep-policies", label, labels)
        config = BenchmarkConfig(
            policies=tuple(specs),
            conditions=(main,),
            episodes={main.name: self.episodes} | {c.name: self.sweep_episodes for c in swept},
            seed=self.seed,
            jobs=self.jobs or len(os.sched_getaffinity(0)),
            contact_free_oracle=self.contact_free_oracle,
        )
        store = EpisodeStore(self.out, config.settings(), {spec.label: spec.fingerprint() for spec in specs})
        run_benchmark(config, store)
        sweep_specs = [spec for spec in specs if not chosen or spec.label in chosen]
        if swept:
            run_benchmark(
                dataclasses.replace(config, policies=tuple(sweep_specs), conditions=tuple(swept)), store
            )
        runs: dict[str, Any] = {}
        for condition in (main, *swept):
            wanted = set(config.numbers(condition))
            runs[condition.name] = {
                spec.label: [e for e in store.read(condition.name, spec.label) if e.episode in wanted]
                for spec in (specs if condition is main else sweep_specs)
            }
        task = GeneralTaskConfig()
        result = evaluate_runs(runs, (main, *swept), task.max_moves)
        privileged = [spec.label for spec in specs if spec.planner in PRIVILEGED]
        facts = {"first episode": self.seed, "processes": config.jobs}
        pictures = []
        if self.pictures:
            drawn = draw_view_grid(runs[main.name], main, self.out / "views.jpg")
            if isinstance(drawn, str):
                print(drawn)
            else:
                pictures.append(drawn)
        page = write_benchmark(
            result,
            runs[main.name],
            self.out,
            threshold=task.full_visibility,
            horizon=task.max_moves,
            privileged=privileged,
            facts=facts,
            pictures=pictures,
        )
        print(markdown_table(result.rows, privileged))
        counts = Counter(row["episodes"] for row in result.rows)
        print(f"episodes {', '.join(str(count) for count in counts)}")
        print(f"numbers  {self.out / 'benchmark.json'}")
        print(f"page     {page}")
