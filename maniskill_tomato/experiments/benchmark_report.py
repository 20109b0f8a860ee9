"""What a benchmark found, as JSON, as a page of tables, and as plots."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import maniskill_tomato
from maniskill_tomato.experiments.benchmark_conditions import Condition
from maniskill_tomato.experiments.benchmark_metrics import compare_policies, summarise_policy
from maniskill_tomato.experiments.benchmark_plots import plot_progress, plot_sweeps, plot_thresholds
from maniskill_tomato.experiments.view_episode import ViewEpisode
from maniskill_tomato.files import write_atomically

HEAD = (
    "policy",
    "success",
    "95 % interval",
    "within 5",
    "within 10",
    "moves",
    "regret",
    "SPL",
    "path [m]",
    "joints [rad]",
    "best V_f",
    "AUC",
    "contact",
    "decision [ms]",
)

METHOD = (
    "Moves count a failed episode as the whole horizon. Regret is moves beyond the oracle's and SPL weighs success by "
    "the ratio of the two, both over the episodes that the oracle solves. AUC is the mean of the largest V_f so far "
    "over the moves 1 to the horizon. Contact is the share of episodes in which the arm touched the plant. Success "
    "intervals are Wilson's. A decision is timed by the wall, without the observation, which every policy is given. "
    "Policies marked * know the truth."
)

TESTS = (
    "Each line compares two policies on the same episodes: by the exact McNemar test on success and by a sign-flip "
    "permutation test on moves, whose mean difference has a 95 % bootstrap interval. The p-values are not corrected "
    "for their number."
)

Runs = Mapping[str, Sequence[ViewEpisode]]


@dataclass(frozen=True, kw_only=True)
class BenchmarkResult:
    """What was found."""

    rows: list[dict[str, Any]]
    """`summarise_policy` of each policy on the main condition."""
    tests: list[dict[str, Any]]
    """Paired tests there."""
    sweeps: list[dict[str, Any]]
    """The figures of each policy on each condition of the sweeps, with `axis` and `value`."""


def evaluate_runs(runs: Mapping[str, Runs], conditions: Sequence[Condition], horizon: int) -> BenchmarkResult:
    """Works out the figures.

    Args:
        runs: Episodes by condition and policy; policies without episodes are left out.
        conditions: The main one first.
        horizon: Most moves of an episode.
    """
    main = {label: episodes for label, episodes in runs[conditions[0].name].items() if episodes}
    sweeps = [
        {"axis": condition.axis, "value": condition.value, **summarise_policy(label, episodes, horizon)}
        for condition in conditions[1:]
        for label, episodes in runs[condition.name].items()
        if episodes
    ]
    return BenchmarkResult(
        rows=[summarise_policy(label, episodes, horizon) for label, episodes in main.items()],
        tests=compare_policies(main, horizon),
        sweeps=sweeps,
    )


def write_benchmark(
    result: BenchmarkResult,
    runs: Runs,
    out: Path,
    *,
    threshold: float,
    horizon: int,
    privileged: Sequence[str] = (),
    facts: Mapping[str, Any] | None = None,
    pictures: Sequence[Path] = (),
) -> Path:
    """Writes benchmark.json, benchmark_details.json, benchmark.md and the plots.

    Args:
        result: The figures.
        runs: The episodes of the main condition by policy, for the plots.
        out: Folder of the results.
        threshold: V_f above which an episode succeeds.
        horizon: Most moves of an episode.
        privileged: Policies that know the truth.
        facts: What else to say about how it was run.
        pictures: Further pictures in `out`.

    Returns:
        The path of benchmark.md.
    """
    out.mkdir(parents=True, exist_ok=True)
    _write_json(out / "benchmark.json", result.rows)
    details = {
        "package_version": maniskill_tomato.__version__,
        "success_threshold": threshold,
        "horizon": horizon,
        **(facts or {}),
        "tests": result.tests,
        "sweeps": result.sweeps,
    }
    _write_json(out / "benchmark_details.json", details)
    shown = [out / "progress.png", out / "thresholds.png"]
    plot_progress(runs, horizon, shown[0])
    plot_thresholds(result.rows, threshold, shown[1])
    if result.sweeps:
        shown.append(out / "sweeps.png")
        plot_sweeps(result.sweeps, shown[-1])
    page = out / "benchmark.md"
    text = _page(result, [*shown, *pictures], privileged, threshold, horizon, facts or {})
    write_atomically(page, text.encode())
    return page


def markdown_table(rows: Sequence[Mapping[str, Any]], privileged: Sequence[str] = ()) -> str:
    """The main table, a line for each policy."""
    lines = ["| " + " | ".join(HEAD) + " |", "|" + "---|" * len(HEAD)]
    for row in rows:
        low, high = row["success_rate_interval_95"]
        within = row["success_rate_within_moves"]
        cells = (
            row["policy"] + (" *" if row["policy"] in privileged else ""),
            _share(row["success_rate"]),
            f"{_share(low)} to {_share(high)}",
            _share(within["5"]),
            _share(within["10"]),
            f"{row['mean_moves']:.2f}",
            _number(row["regret_moves"], 2),
            _number(row["spl"], 3),
            f"{row['mean_path_m']:.2f}",
            f"{row['mean_joint_path_rad']:.1f}",
            f"{row['mean_best_visible_fraction']:.3f}",
            f"{row['auc']:.3f}",
            _share(row["contact_episode_rate"]),
            _number(row["decision_ms"], 2),
        )
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _page(
    result: BenchmarkResult,
    pictures: Sequence[Path],
    privileged: Sequence[str],
    threshold: float,
    horizon: int,
    facts: Mapping[str, Any],
) -> str:
    count = max(row["episodes"] for row in result.rows)
    parts = [
        "# Benchmark",
        f"{count} episodes, at most {horizon} moves, success at V_f > {threshold:g}; maniskill-tomato "
        f"{maniskill_tomato.__version__}"
        + "".join(f"; {name.replace('_', ' ')}: {value}" for name, value in facts.items())
        + ".",
        markdown_table(result.rows, privileged),
        METHOD,
    ]
    parts += [f"![{path.stem.replace('_', ' ')}]({path.name})" for path in pictures]
    if result.tests:
        parts += ["## Paired tests", _tests_table(result.tests), TESTS]
    for axis in dict.fromkeys(row["axis"] for row in result.sweeps):
        rows = [row for row in result.sweeps if row["axis"] == axis]
        parts += [f"## Sweep: {axis.replace('_', ' ')}", _sweep_table(rows)]
    return "\n\n".join(parts) + "\n"


def _tests_table(tests: Sequence[Mapping[str, Any]]) -> str:
    lines = [
        "| A | B | episodes | only A solves | only B solves | p | moves A - B | 95 % interval | p |",
        "|" + "---|" * 9,
    ]
    for test in tests:
        low, high = test["moves_interval_95"]
        lines.append(
            f"| {test['a']} | {test['b']} | {test['episodes']} | {test['only_a']} | {test['only_b']} | "
            f"{_p(test['success_p'])} | {test['moves_difference']:+.2f} | {low:+.2f} to {high:+.2f} | "
            f"{_p(test['moves_p'])} |"
        )
    return "\n".join(lines)


def _sweep_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Success and moves of each policy (lines) at each value (columns)."""
    values = list(dict.fromkeys(row["value"] for row in rows))
    lines = ["| policy | " + " | ".join(f"{v:g}" for v in values) + " |", "|" + "---|" * (len(values) + 1)]
    for label in dict.fromkeys(row["policy"] for row in rows):
        found = {row["value"]: row for row in rows if row["policy"] == label}
        cells = [
            f"{_share(found[v]['success_rate'])}, {found[v]['mean_moves']:.2f}" if v in found else ""
            for v in values
        ]
        lines.append(f"| {label} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _write_json(path: Path, content: Any) -> None:
    write_atomically(path, (json.dumps(content, indent=2, allow_nan=False) + "\n").encode())


def _share(value: float) -> str:
    return f"{100.0 * value:.1f} %"


def _number(value: float | None, decimals: int) -> str:
    return "" if value is None else f"{value:.{decimals}f}"


def _p(value: float) -> str:
    return "< 0.001" if value < 0.001 else f"{value:.3f}"
