"""What a benchmark found, as JSON and as a page."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import maniskill_tomato
from maniskill_tomato.experiments.benchmark_plots import (
    AXIS_LABELS,
    Runs,
    best_rows,
    plot_best_view,
    plot_progress,
    plot_sweep,
    plot_thresholds,
)
from maniskill_tomato.experiments.episode_listing import episode_list, list_episodes
from maniskill_tomato.experiments.episode_record import EpisodeRecord
from maniskill_tomato.experiments.metrics import compare_policies, summarise_policy
from maniskill_tomato.experiments.policy_runs import Condition
from maniskill_tomato.files import write_atomically, write_json
from maniskill_tomato.report_design import (
    figure,
    markdown_table,
    notice,
    number,
    page,
    paragraph,
    percent,
    section,
    side_by_side,
    table,
    tile,
    tiles,
)
from maniskill_tomato.run_facts import run_facts

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


@dataclass(frozen=True, kw_only=True)
class BenchmarkFigures:
    """What was found."""

    rows: list[dict[str, Any]]
    """`summarise_policy` of each policy on the main condition."""
    tests: list[dict[str, Any]]
    """Paired tests there."""
    sweeps: list[dict[str, Any]]
    """The figures of each policy on each condition of the sweeps, with `axis` and `value`."""


def summarise_runs(
    runs: Mapping[str, Runs], conditions: Sequence[Condition], horizon: int
) -> BenchmarkFigures:
    """Works out the figures.

    Args:
        runs: Episodes by condition and policy; policies without episodes are left out.
        conditions: The main one first.
        horizon: Most moves of an episode.
    """
    main = {label: episodes for label, episodes in runs[conditions[0].name].items() if episodes}
    return BenchmarkFigures(
        rows=[summarise_policy(label, episodes, horizon) for label, episodes in main.items()],
        tests=compare_policies(main, horizon),
        sweeps=[
            {"axis": condition.axis, "value": condition.value, **summarise_policy(label, episodes, horizon)}
            for condition in conditions[1:]
            for label, episodes in runs[condition.name].items()
            if episodes
        ],
    )


@dataclass(frozen=True, kw_only=True)
class BenchmarkInput:
    """What the page of a benchmark is made of, beside the figures."""

    runs: Runs
    """The episodes of the main condition by policy."""
    threshold: float
    """V_f above which an episode succeeds."""
    horizon: int
    """Most moves of an episode."""
    privileged: Sequence[str] = ()
    """Policies that know the truth."""
    facts: Mapping[str, Any] = field(default_factory=dict)
    """What else to say about how it was run."""
    pictures: Sequence[Path] = ()
    """Further pictures in the folder."""
    left_out: str | None = None
    """Which pictures are missing, and how to get them."""
    replay: Callable[[str, int], str | None] = lambda policy, seed: None
    """The command that runs an episode of a policy again, by its label."""


def write_benchmark(figures: BenchmarkFigures, content: BenchmarkInput, out: Path) -> tuple[str, Path]:
    """Writes benchmark.json, benchmark_details.json, the plots and report.html.

    Args:
        figures: What was found.
        content: What else the page tells.
        out: Folder of the results.

    Returns:
        The main table as Markdown, and the path of report.html.
    """
    write_json(out / "benchmark.json", figures.rows)
    details = {
        "package_version": maniskill_tomato.__version__,
        "success_threshold": content.threshold,
        "horizon": content.horizon,
        **content.facts,
        "tests": figures.tests,
        "sweeps": figures.sweeps,
    }
    write_json(out / "benchmark_details.json", details)
    drawn = best_rows(figures.rows)
    names = [row["policy"] for row in drawn]
    plots = [out / name for name in ("progress.png", "best_view.png", "thresholds.png")]
    shown = {name: content.runs[name] for name in names}
    plot_progress(shown, content.horizon, plots[0])
    plot_best_view(shown, content.horizon, plots[1])
    plot_thresholds(drawn, content.threshold, plots[2])
    sweeps = {}
    for axis in dict.fromkeys(row["axis"] for row in figures.sweeps):
        sweeps[axis] = out / f"sweep_{axis}.png"
        plot_sweep([row for row in figures.sweeps if row["axis"] == axis], sweeps[axis])
    cells = [_cells(row, row["policy"] in content.privileged) for row in figures.rows]
    path = out / "report.html"
    write_atomically(path, _page(figures, content, cells, plots, sweeps).encode())
    return markdown_table(HEAD, cells), path


def _page(
    figures: BenchmarkFigures,
    content: BenchmarkInput,
    cells: Sequence[Sequence[str]],
    plots: Sequence[Path],
    sweeps: Mapping[str, Path],
) -> str:
    rows = figures.rows
    counts = sorted({row["episodes"] for row in rows})
    episodes = " or ".join(str(count) for count in counts)
    drawn = len(best_rows(rows))
    lines = "" if drawn == len(rows) else f" The {drawn} best of {len(rows)} policies; the table names all."
    of = f"n = {episodes} episodes a policy.{lines}"
    captions = (
        f"Share of episodes solved (0 to 1) within so many moves; {of}",
        f"Largest V_f so far (0 to 1), mean over the episodes; {of}",
        f"Share of episodes (0 to 1) that reach a V_f within {content.horizon} moves; {of}",
    )
    facts = {
        **{name.replace("_", " "): str(value) for name, value in content.facts.items()},
        **run_facts(),
    }
    tests = (
        section("Paired tests", _tests_table(figures.tests), paragraph(TESTS, "caption"))
        if figures.tests
        else ""
    )
    listed = [_listed(label, found, content) for label, found in content.runs.items() if found]
    return page(
        "Benchmark of policies",
        f"{len(rows)} policies on the same {episodes} episodes, at most {content.horizon} moves, success at "
        f"V_f > {content.threshold:g}",
        [
            _tiles(rows, content.privileged),
            notice(content.left_out),
            section(
                f"Policies, n = {episodes} episodes each",
                table(HEAD, cells, tall=len(cells) > 20),
                paragraph(METHOD, "caption"),
            ),
            section(
                "Over the moves",
                side_by_side(*(figure(path, text) for path, text in zip(plots, captions, strict=True))),
                *(
                    figure(
                        path,
                        "Start view, and the last view of every policy, with V_f (0 to 1); the first of "
                        f"n = {episodes} episodes.",
                    )
                    for path in content.pictures
                ),
            ),
            *(_sweep_section(axis, figures.sweeps, path) for axis, path in sweeps.items()),
            tests,
            section(
                "Episodes, failures first",
                paragraph(
                    "V_f is the visible fraction of the target, from 0 to 1. The command runs the episode again, with "
                    "its film where this machine can render."
                ),
                *listed,
            ),
        ],
        facts,
    )


def _listed(label: str, episodes: Sequence[EpisodeRecord], content: BenchmarkInput) -> str:
    def command(seed: int) -> str | None:
        return content.replay(label, seed)

    return episode_list(list_episodes(episodes, content.threshold, content.horizon, command), label)


def _tiles(rows: Sequence[Mapping[str, Any]], privileged: Sequence[str]) -> str:
    """The best policy that does not know the truth; of those that do, if there is no other."""
    fair = [row for row in rows if row["policy"] not in privileged] or list(rows)
    best = min(fair, key=lambda row: (-row["success_rate"], row["mean_moves"]))
    low, high = best["success_rate_interval_95"]
    moves_low, moves_high = best["mean_moves_interval_95"]
    count = f"n = {best['episodes']} episodes"
    kind = "knows the truth" if best["policy"] in privileged else "does not know the truth"
    decision = best["decision_ms"]
    return tiles(
        tile(
            percent(best["success_rate"]),
            f"solved by {best['policy']}, the best that {kind}",
            count,
            f"95 % interval {percent(low)} to {percent(high)}",
        ),
        tile(
            f"{best['mean_moves']:.2f} moves",
            "an episode, mean",
            f"{count}; a failed one counts as the whole horizon",
            f"95 % interval {moves_low:.2f} to {moves_high:.2f}",
        ),
        tile(f"{best['mean_path_m']:.2f} m", "way of the camera an episode, mean", count),
        tile("none" if decision is None else f"{decision:.1f} ms", "for a decision, mean wall time", count),
    )


def _sweep_section(axis: str, every: Sequence[Mapping[str, Any]], path: Path) -> str:
    rows = [row for row in every if row["axis"] == axis]
    counts = " or ".join(str(count) for count in sorted({row["episodes"] for row in rows}))
    return section(
        f"Sweep: {axis.replace('_', ' ')}",
        figure(
            path,
            f"Share of episodes solved (0 to 1) over {AXIS_LABELS.get(axis, axis)}, with 95 % intervals (Wilson); "
            f"n = {counts} episodes a point.",
        ),
        _sweep_table(rows),
        paragraph(
            f"Success and mean moves of each policy at each value; n = {counts} episodes a cell.", "caption"
        ),
    )


def _cells(row: Mapping[str, Any], privileged: bool) -> tuple[str, ...]:
    low, high = row["success_rate_interval_95"]
    within = row["success_rate_within_moves"]
    return (
        row["policy"] + (" *" if privileged else ""),
        percent(row["success_rate"]),
        f"{percent(low)} to {percent(high)}",
        percent(within["5"]),
        percent(within["10"]),
        number(row["mean_moves"], 2),
        number(row["regret_moves"], 2),
        number(row["spl"], 3),
        number(row["mean_path_m"], 2),
        number(row["mean_joint_path_rad"], 1),
        number(row["mean_best_visible_fraction"], 3),
        number(row["auc"], 3),
        "" if row["contact_episode_rate"] is None else percent(row["contact_episode_rate"]),
        number(row["decision_ms"], 2),
    )


def _tests_table(tests: Sequence[Mapping[str, Any]]) -> str:
    head = ("A", "B", "episodes", "only A solves", "only B solves", "p", "moves A - B", "95 % interval", "p")
    rows = []
    for test in tests:
        low, high = test["moves_interval_95"]
        rows.append(
            (
                test["a"],
                test["b"],
                str(test["episodes"]),
                str(test["only_a"]),
                str(test["only_b"]),
                _p(test["success_p"]),
                f"{test['moves_difference']:+.2f}",
                f"{low:+.2f} to {high:+.2f}",
                _p(test["moves_p"]),
            )
        )
    return table(head, rows, words=(1,), tall=len(rows) > 14)


def _sweep_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Success and moves of each policy (lines) at each value (columns)."""
    values = list(dict.fromkeys(row["value"] for row in rows))
    lines = []
    for label in dict.fromkeys(row["policy"] for row in rows):
        found = {row["value"]: row for row in rows if row["policy"] == label}
        cells = [
            f"{percent(found[v]['success_rate'])}, {found[v]['mean_moves']:.2f}" if v in found else ""
            for v in values
        ]
        lines.append((label, *cells))
    return table(("policy", *(f"{v:g}" for v in values)), lines)


def _p(value: float) -> str:
    return "< 0.001" if value < 0.001 else f"{value:.3f}"
