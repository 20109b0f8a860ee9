"""What the episodes amount to: success, steps, visible fraction, and how sure one can be of it."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import maniskill_tomato
from maniskill_tomato.experiments.rollout import Episode
from maniskill_tomato.experiments.statistics import wilson_interval

WITHIN_STEPS = (1, 3, 5, 10)
"""Step counts at which the share of solved episodes is reported."""


def summarise(episodes: Sequence[Episode]) -> dict[str, Any]:
    """The figures of some episodes, ready for JSON.

    Steps of failed episodes count as they are: the horizon, or fewer where an episode ended outside the
    workspace.
    """
    count = len(episodes)
    solved = [e for e in episodes if e.success]
    steps = np.array([e.steps for e in episodes])
    success = np.array([e.success for e in episodes])
    touches = [e.plant_contact for e in episodes if e.plant_contact is not None]
    rows = [(*e.targets_seen, e.moves or e.steps) for e in episodes if e.targets_seen is not None]
    found, wanted, moves = (sum(values) for values in zip(*rows, strict=True)) if rows else (0, 0, 0)
    return {
        "episodes": count,
        "success_rate": len(solved) / count,
        "success_rate_interval_95": list(wilson_interval(len(solved), count)),
        "mean_steps": float(steps.mean()),
        "mean_steps_success": float(np.mean([e.steps for e in solved])) if solved else None,
        "success_rate_within_steps": {str(k): float((success & (steps <= k)).mean()) for k in WITHIN_STEPS},
        "mean_initial_visible_fraction": float(np.mean([e.visible_fraction[0] for e in episodes])),
        "mean_max_visible_fraction": float(np.mean([e.max_visible_fraction for e in episodes])),
        "mean_final_visible_fraction": float(np.mean([e.visible_fraction[-1] for e in episodes])),
        "mean_return": float(np.mean([e.rewards.sum() for e in episodes])),
        "mean_path_length_m": float(np.mean([e.path_length for e in episodes])),
        "unreachable_step_share": float(np.concatenate([e.reachability == 2 for e in episodes]).mean()),
        "forbidden_zone_step_share": float(np.concatenate([e.in_forbidden_zone for e in episodes]).mean()),
        "plant_contact_step_share": float(np.concatenate(touches).mean()) if touches else None,
        "target_seen_share": found / wanted if wanted else None,
        "moves_per_seen_target": moves / found if found else None,
        "per_episode": {
            "seed": [e.seed for e in episodes],
            "success": [e.success for e in episodes],
            "steps": [e.steps for e in episodes],
            "return": [float(e.rewards.sum()) for e in episodes],
            "initial_visible_fraction": [float(e.visible_fraction[0]) for e in episodes],
            "max_visible_fraction": [e.max_visible_fraction for e in episodes],
            "final_visible_fraction": [float(e.visible_fraction[-1]) for e in episodes],
            "path_length_m": [e.path_length for e in episodes],
        },
    }


def make_metrics(
    env_id: str,
    episodes: Sequence[Episode],
    *,
    seed: int,
    success_threshold: float,
    policy: dict[str, Any],
    wall_seconds: float,
    baseline: Sequence[Episode] | None = None,
) -> dict[str, Any]:
    """The content of `metrics.json`.

    Args:
        env_id: The task.
        episodes: What the policy did.
        seed: Seed of the first episode; the others follow.
        success_threshold: V_f above which the target counts as fully visible.
        policy: What the policy is: path, task and steps of its training.
        wall_seconds: Time that `episodes` took, in [s].
        baseline: What uniformly random actions did from the same seeds.
    """
    metrics = {
        "env_id": env_id,
        "seed": seed,
        "success_threshold": success_threshold,
        **summarise(episodes),
        "policy": policy,
        "wall_seconds": wall_seconds,
        "package_version": maniskill_tomato.__version__,
    }
    if baseline is not None:
        metrics["random_actions"] = {k: v for k, v in summarise(baseline).items() if k != "per_episode"}
    return metrics


def write_metrics(path: Path, metrics: dict[str, Any]) -> None:
    """Writes `metrics` as JSON, with numbers that any reader accepts (no NaN)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(metrics, indent=2, allow_nan=False) + "\n")
