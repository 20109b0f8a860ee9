"""What episodes amount to, ready for JSON: of an evaluation, and of a policy in a benchmark."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

import maniskill_tomato
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.experiments.camera_metrics import summarise_camera, summarise_inspections
from maniskill_tomato.experiments.episode_record import EpisodeRecord, Float64
from maniskill_tomato.experiments.statistics import mean_interval, paired_test, wilson_interval

WITHIN_STEPS = (1, 3, 5, 10)
"""Step counts at which an evaluation reports the share of solved episodes."""

WITHIN_MOVES = (1, 3, 5, 10, 20)
"""The same of a benchmark."""

THRESHOLDS = tuple(round(0.5 + 0.05 * k, 2) for k in range(10))
"""V_f thresholds at which a benchmark reports success. Episodes end at the task's own, so that for higher ones the
figure is a lower bound."""


def summarise(episodes: Sequence[EpisodeRecord]) -> dict[str, Any]:
    """The figures of an evaluation.

    Steps of failed episodes count as they are: the horizon, or fewer where an episode ended outside the
    workspace.
    """
    count = len(episodes)
    steps = np.array([e.steps for e in episodes])
    success = np.array([e.success for e in episodes])
    returns = [float(e.rewards.sum()) for e in episodes]
    first, last = ([float(e.visible_fraction[i]) for e in episodes] for i in (0, -1))
    largest = [e.max_visible_fraction for e in episodes]
    paths = [e.path_length for e in episodes]
    touches = [e.contact for e in episodes if e.contact is not None]
    zone = np.concatenate([_flags(e.in_forbidden_zone, e.steps) for e in episodes])
    rows = [e.row for e in episodes if e.row is not None]
    found, wanted = sum(len(row.seen) for row in rows), sum(len(row.targets) for row in rows)
    return {
        "episodes": count,
        "success_rate": float(success.mean()),
        "success_rate_interval_95": list(wilson_interval(int(success.sum()), count)),
        "mean_steps": float(steps.mean()),
        "mean_steps_success": float(steps[success].mean()) if success.any() else None,
        "success_rate_within_steps": {str(k): float((success & (steps <= k)).mean()) for k in WITHIN_STEPS},
        "mean_initial_visible_fraction": float(np.mean(first)),
        "mean_max_visible_fraction": float(np.mean(largest)),
        "mean_final_visible_fraction": float(np.mean(last)),
        "mean_return": float(np.mean(returns)),
        "mean_path_length_m": float(np.mean(paths)),
        "unreachable_step_share": float(np.concatenate([e.refused for e in episodes]).mean()),
        "forbidden_zone_step_share": float(zone.mean()),
        "plant_contact_step_share": float(np.concatenate(touches).mean()) if touches else None,
        "target_seen_share": found / wanted if wanted else None,
        "moves_per_seen_target": sum(row.moves for row in rows) / found if found else None,
        "per_episode": {
            "seed": [e.seed for e in episodes],
            "success": [e.success for e in episodes],
            "steps": [e.steps for e in episodes],
            "return": returns,
            "initial_visible_fraction": first,
            "max_visible_fraction": largest,
            "final_visible_fraction": last,
            "path_length_m": paths,
        },
    }


def totals(metrics: Mapping[str, Any]) -> dict[str, Any]:
    """Figures without those of every single episode."""
    return {name: value for name, value in metrics.items() if name != "per_episode"}


def make_metrics(
    env_id: str,
    episodes: Sequence[EpisodeRecord],
    *,
    seed: int,
    success_threshold: float,
    policy: dict[str, Any],
    wall_seconds: float,
    baseline: Sequence[EpisodeRecord] | None = None,
    beside: Mapping[str, Sequence[EpisodeRecord]] | None = None,
    true_association: Sequence[EpisodeRecord] | None = None,
    seeable: Mapping[int, set[int]] | None = None,
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
        beside: What other policies did from them, by their names.
        true_association: What the policy did from the same seeds when the truth told it which fruit each detection is.
        seeable: The fruits of each row that can be seen fully, by its seed, where a camera inspected rows.
    """
    metrics = {
        "env_id": env_id,
        "seed": seed,
        "success_threshold": success_threshold,
        **summarise(episodes),
        **summarise_camera(episodes, success_threshold),
        "policy": policy,
        "wall_seconds": wall_seconds,
        "package_version": maniskill_tomato.__version__,
    }
    if baseline is not None:
        metrics["random_actions"] = totals(summarise(baseline))
    if beside:
        metrics["beside"] = {name: totals(summarise(found)) for name, found in beside.items()}
    if seeable is not None:
        metrics |= summarise_inspections(episodes, seeable, success_threshold)
    if true_association is not None:
        with_truth = summarise_camera(true_association, success_threshold)
        metrics["true_association_success_rate"] = with_truth["true_success_rate"]
    return metrics


def summarise_policy(policy: str, episodes: Sequence[EpisodeRecord], horizon: int) -> dict[str, Any]:
    """The figures of one policy in a benchmark.

    A failed episode counts as `horizon` moves in `mean_moves`. `auc` is the mean over 1 ... horizon moves of the
    largest V_f seen so far. `spl` is the mean of S * L_oracle / max(L, L_oracle) in moves (Anderson et al. 2018,
    arXiv 1807.06757), `regret_moves` the mean of moves minus the oracle's, both over episodes with a known solution.
    Contact is None for tasks that do not tell of it.

    Args:
        policy: Its name.
        episodes: What it did.
        horizon: Most moves of an episode.

    Raises:
        InvalidInputError: There is no episode.
    """
    if not episodes:
        raise InvalidInputError(f"no episode of {policy} to summarise")
    count = len(episodes)
    success = np.array([e.success for e in episodes])
    moves = counted_moves(episodes, horizon)
    paths = np.array([e.camera_path_length for e in episodes])
    decisions = np.concatenate([e.decision_ms for e in episodes])
    judged = any(e.contact is not None for e in episodes)
    contacts = [_flags(e.contact, e.steps) for e in episodes]
    touched = np.array([bool(c.any()) for c in contacts])
    nearest = [
        np.nanmin(e.clearance) for e in episodes if e.clearance is not None and np.isfinite(e.clearance).any()
    ]
    return {
        "policy": policy,
        "episodes": count,
        "success_rate": float(success.mean()),
        "success_rate_interval_95": list(wilson_interval(int(success.sum()), count)),
        "mean_moves": float(moves.mean()),
        "mean_moves_interval_95": list(mean_interval(moves)),
        "mean_moves_success": float(moves[success].mean()) if success.any() else None,
        "success_rate_within_moves": {str(k): float((success & (moves <= k)).mean()) for k in WITHIN_MOVES},
        "success_rate_at_threshold": {
            f"{threshold:.2f}": float(np.mean([e.moves_to(threshold, horizon) is not None for e in episodes]))
            for threshold in THRESHOLDS
        },
        "mean_path_m": float(paths.mean()),
        "mean_path_success_m": float(paths[success].mean()) if success.any() else None,
        "mean_joint_path_rad": float(np.mean([e.joint_path_length for e in episodes])),
        "mean_start_visible_fraction": float(np.mean([e.visible_fraction[0] for e in episodes])),
        "mean_final_visible_fraction": float(np.mean([e.visible_fraction[-1] for e in episodes])),
        "mean_best_visible_fraction": float(np.mean([e.best_visible_fraction for e in episodes])),
        "auc": float(np.mean([e.best_so_far(horizon).mean() for e in episodes])),
        **_against_oracle(episodes, moves, success),
        "decision_ms": float(decisions.mean()) if len(decisions) else None,
        "decision_ms_p95": float(np.percentile(decisions, 95)) if len(decisions) else None,
        "contact_episode_rate": float(touched.mean()) if judged else None,
        "contact_move_rate": _mean(np.concatenate(contacts)) if judged else None,
        "contact_free_success_rate": float((success & ~touched).mean()) if judged else None,
        "mean_min_clearance_m": float(np.mean(nearest)) if nearest else None,
        "refused_move_rate": _mean(np.concatenate([e.refused for e in episodes])),
    }


def compare_policies(runs: Mapping[str, Sequence[EpisodeRecord]], horizon: int) -> list[dict[str, Any]]:
    """Paired tests of every two policies on the episodes that both have."""
    names = list(runs)
    tests = []
    for i, a in enumerate(names):
        for b in names[i + 1 :]:
            first, second = ({e.seed: e for e in runs[name]} for name in (a, b))
            common = sorted(first.keys() & second.keys())
            if not common:
                continue
            of_a, of_b = [first[k] for k in common], [second[k] for k in common]
            test = paired_test(
                [e.success for e in of_a],
                counted_moves(of_a, horizon),
                [e.success for e in of_b],
                counted_moves(of_b, horizon),
            )
            tests.append({"a": a, "b": b, **asdict(test)})
    return tests


def counted_moves(episodes: Sequence[EpisodeRecord], horizon: int) -> Float64:
    """Moves of each episode, a failed one with the whole horizon. Shape (N,)."""
    return np.array([e.steps if e.success else horizon for e in episodes], dtype=np.float64)


def _against_oracle(episodes: Sequence[EpisodeRecord], moves: Any, success: Any) -> dict[str, Any]:
    known = np.array([e.oracle_moves is not None for e in episodes])
    figures: dict[str, Any] = {"oracle_episodes": int(known.sum())}
    names = ("regret_moves", "spl", "success_rate_of_solvable", "moves_over_oracle", "oracle_mean_moves")
    if not known.any():
        return {**figures, **dict.fromkeys(names)}
    best = np.array([e.oracle_moves for e in episodes if e.oracle_moves is not None], dtype=np.float64)
    took, solved = moves[known], success[known]
    figures["regret_moves"] = float((took - best).mean())
    figures["spl"] = float((solved * best / np.maximum(np.maximum(took, best), 1.0)).mean())
    figures["success_rate_of_solvable"] = float(solved.mean())
    figures["moves_over_oracle"] = float(took.mean() / best.mean()) if best.mean() > 0 else None
    figures["oracle_mean_moves"] = float(best.mean())
    return figures


def _flags(values: NDArray[np.bool_] | None, steps: int) -> NDArray[np.bool_]:
    """Flags of the steps, none of them set where the task does not tell."""
    return np.zeros(steps, dtype=np.bool_) if values is None else values


def _mean(values: NDArray[Any]) -> float:
    return float(values.mean()) if len(values) else 0.0
