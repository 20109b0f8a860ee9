"""What a policy loses when it sees through the camera instead of the simulator, on the same held-out episodes."""

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast, get_args

import numpy as np

import maniskill_tomato
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.experiments.configs import PerceptionComparisonConfig
from maniskill_tomato.experiments.episode_listing import episode_list, list_episodes
from maniskill_tomato.experiments.episode_record import EpisodeRecord
from maniskill_tomato.experiments.policy_runs import Condition, parse_policies, run_policies
from maniskill_tomato.experiments.result_store import ResultStore
from maniskill_tomato.experiments.statistics import wilson_interval
from maniskill_tomato.files import write_json
from maniskill_tomato.folder_lock import only_writer
from maniskill_tomato.report_design import figure, markdown_table, paragraph, report, section, table
from maniskill_tomato.report_plots import plot_intervals
from maniskill_tomato.run_facts import run_facts
from maniskill_tomato.sensing.perception_kinds import RENDERED, Perception
from maniskill_tomato.tasks.row.row_config import GeneralTaskConfig

PERCEPTIONS = get_args(Perception)

HEAD = (
    "policy",
    "perception",
    "episodes",
    "success",
    "believed success",
    "mean moves",
    "V_f error",
    "position error",
)


METHOD = (
    "Success: the robot believes that the target is fully visible, and it is. Believed success: it believes so. V_f "
    "error: mean absolute error of the measured V_f (0 to 1) over the views after a move. Position error: of the "
    "target's place at the end."
)


def judge_episode(record: EpisodeRecord, policy: str, perception: str, threshold: float) -> dict[str, Any]:
    """How an episode ended, as believed and in truth; what measures nothing is the truth itself.

    Returns:
        `declared`: whether the robot took the target for fully visible at the end; `true_fraction`: true V_f of the
        last view; `success`: whether that is above the threshold as well; `moves`; `fraction_error`: mean absolute
        error of V_f over the views after a move; `position_error_m`: how far the target is at the end from where it
        was believed to be, in [m].
    """
    measured = record.visible_fraction
    true = measured if record.true_visible_fraction is None else record.true_visible_fraction
    target = record.target if record.true_target is None else record.true_target
    return {
        "policy": policy,
        "perception": perception,
        "episode": record.seed,
        "declared": record.success,
        "true_fraction": float(true[-1]),
        "success": record.success and bool(true[-1] > threshold),
        "moves": record.steps,
        "fraction_error": float(np.abs(measured - true)[1:].mean()),
        "position_error_m": float(np.linalg.norm(record.target[-1] - target[-1])),
    }


@dataclass(frozen=True, kw_only=True)
class PerceptionComparison:
    """What a comparison found and wrote."""

    table: str
    """As Markdown."""
    report: Path
    """report.html, which needs no other file."""


def compare_perceptions(config: PerceptionComparisonConfig) -> PerceptionComparison:
    """Runs the episodes that are not in the folder yet; writes perception.json and report.html.

    Raises:
        InvalidInputError: An option cannot be used, or the folder holds other episodes.
        CheckpointError: Another process measures in the folder.
    """
    with only_writer(config.out, "measures"):
        return _compare(config)


def _compare(config: PerceptionComparisonConfig) -> PerceptionComparison:
    for name in config.perceptions:
        if name not in PERCEPTIONS:
            raise InvalidInputError.choice("--perceptions", name, PERCEPTIONS)
    specs = parse_policies(config.policies)
    settings = {"episode_list": config.episode_list, "package_version": maniskill_tomato.__version__}
    store = ResultStore(config.out, settings, {f"policy {spec.label}": spec.fingerprint for spec in specs})
    numbers = range(config.seed, config.seed + config.episodes)
    conditions = [_condition(name, config.episode_list) for name in config.perceptions]
    run_policies(store, [(condition, specs, numbers) for condition in conditions], config.jobs)
    threshold = GeneralTaskConfig().full_visibility
    results = [
        judge_episode(record, spec.label, condition.name, threshold)
        for condition in conditions
        for spec in specs
        for record in store.episodes(condition.name, spec.label, numbers)
    ]
    write_json(config.out / "perception.json", results)
    episodes = {
        (spec.label, condition.name): store.episodes(condition.name, spec.label, numbers)
        for condition in conditions
        for spec in specs
    }
    written = _write_report(config, results, episodes, {spec.label: spec.source for spec in specs})
    return PerceptionComparison(table=perception_table(results), report=written)


def _write_report(
    config: PerceptionComparisonConfig,
    results: Sequence[Mapping[str, Any]],
    episodes: Mapping[tuple[str, str], Sequence[EpisodeRecord]],
    sources: Mapping[str, str],
) -> Path:
    """Writes report.html with a plot of the success."""
    task = GeneralTaskConfig()
    shares: dict[str, tuple[float, float, float] | float] = {}
    for policy, perception in episodes:
        won = [bool(r["success"]) for r in results if (r["policy"], r["perception"]) == (policy, perception)]
        shares[f"{policy}, {perception}"] = (sum(won) / len(won), *wilson_interval(sum(won), len(won)))
    plot = config.out / "success.png"
    plot_intervals(shares, "Success", "share of episodes", plot, (0.0, 1.0))
    count = f"n = {config.episodes} episodes"

    def listed(policy: str, perception: str) -> str:
        def replay(seed: int) -> str:
            words = ["--policies", sources[policy], "--perceptions", perception, "--episodes", "1"]
            words += [
                "--seed",
                str(seed),
                "--episode-list",
                config.episode_list,
                "--out",
                f"runs/again-{seed}",
            ]
            return shlex.join(["maniskill-tomato", "judge", "perception", *words])

        lines = list_episodes(episodes[policy, perception], task.full_visibility, task.max_moves, replay)
        return episode_list(lines, f"{policy}, {perception}")

    return report(
        config.out,
        "What perception costs",
        f"{config.episodes} episodes of {config.episode_list} from {config.seed}, success at V_f > "
        f"{task.full_visibility:g}",
        [
            paragraph(
                "The same policy runs the same episodes once with the simulator's truth (ground_truth) and once with "
                "what it measures in camera images. The difference of the success rates is what perception costs."
            ),
            section(
                f"Policies and perceptions, {count} each",
                table(HEAD, _cells(results)),
                paragraph(METHOD, "caption"),
                figure(
                    plot,
                    f"Share of episodes (0 to 1) that end with the target truly fully visible, with 95 % intervals "
                    f"(Wilson); {count} a line.",
                ),
            ),
            section(
                "Episodes, failures first",
                paragraph(
                    "V_f is the true visible fraction of the target, from 0 to 1. The command runs the episode again."
                ),
                *(listed(*key) for key in episodes),
            ),
        ],
        run_facts(),
    )


def perception_table(results: Sequence[Mapping[str, Any]]) -> str:
    """The results as Markdown."""
    return markdown_table(HEAD, _cells(results)) + "\n"


def _cells(results: Sequence[Mapping[str, Any]]) -> list[tuple[str, ...]]:
    lines: list[tuple[str, ...]] = []
    for policy, perception in dict.fromkeys((r["policy"], r["perception"]) for r in results):
        rows = [r for r in results if (r["policy"], r["perception"]) == (policy, perception)]

        def mean(name: str, rows: Sequence[Mapping[str, Any]] = rows) -> float:
            return float(np.mean([r[name] for r in rows]))

        lines.append(
            (
                policy,
                perception,
                str(len(rows)),
                f"{100 * mean('success'):.0f} %",
                f"{100 * mean('declared'):.0f} %",
                f"{mean('moves'):.1f}",
                f"{mean('fraction_error'):.3f}",
                f"{1000 * mean('position_error_m'):.0f} mm",
            )
        )
    return lines


def _condition(perception: str, episode_list: str) -> Condition:
    options: dict[str, Any] = {
        "episodes": episode_list,
        "render_backend": "auto" if cast(Perception, perception) in RENDERED else "none",
        "perception": perception,
    }
    return Condition(name=perception, env_options=options)
