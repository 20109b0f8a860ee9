"""What a policy loses when it sees through the camera instead of the simulator, on the same held-out episodes."""

from collections.abc import Mapping, Sequence
from typing import Any, cast, get_args

import numpy as np

import maniskill_tomato
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.experiments.configs import PerceptionComparisonConfig
from maniskill_tomato.experiments.episode_record import EpisodeRecord
from maniskill_tomato.experiments.policy_runs import Condition, parse_policies, run_policies
from maniskill_tomato.experiments.result_store import ResultStore
from maniskill_tomato.files import write_atomically, write_json
from maniskill_tomato.folder_lock import only_writer
from maniskill_tomato.report_design import markdown_table
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


def compare_perceptions(config: PerceptionComparisonConfig) -> str:
    """Runs the episodes that are not in the folder yet; writes perception.json and perception.md.

    Returns:
        The table, as Markdown.

    Raises:
        InvalidInputError: An option cannot be used, or the folder holds other episodes.
        CheckpointError: Another process measures in the folder.
    """
    with only_writer(config.out, "measures"):
        return _compare(config)


def _compare(config: PerceptionComparisonConfig) -> str:
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
    table = perception_table(results)
    write_atomically(config.out / "perception.md", table.encode())
    return table


def perception_table(results: Sequence[Mapping[str, Any]]) -> str:
    """The results as Markdown."""
    lines = []
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
    return markdown_table(HEAD, lines) + "\n"


def _condition(perception: str, episode_list: str) -> Condition:
    options: dict[str, Any] = {
        "episodes": episode_list,
        "render_backend": "auto" if cast(Perception, perception) in RENDERED else "none",
        "perception": perception,
    }
    return Condition(name=perception, env_options=options)
