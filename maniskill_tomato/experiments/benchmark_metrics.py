"""What the episodes of one policy amount to, and how two policies compare."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.experiments.statistics import mean_interval, paired_test, wilson_interval
from maniskill_tomato.experiments.view_episode import ViewEpisode

THRESHOLDS = tuple(round(0.5 + 0.05 * k, 2) for k in range(10))
"""V_f thresholds at which success is reported. Episodes end at the task's own, so that for higher ones the figure
is a lower bound."""

WITHIN = (1, 3, 5, 10, 20)
"""Numbers of moves within which success is reported."""


def summarise_policy(policy: str, episodes: Sequence[ViewEpisode], horizon: int) -> dict[str, Any]:
    """The figures of one policy, ready for JSON.

    A failed episode counts as `horizon` moves in `mean_moves`. `auc` is the mean over 1 ... horizon moves of the
    largest V_f seen so far. `spl` is the mean of S * L_oracle / max(L, L_oracle) in moves (Anderson et al. 2018,
    arXiv 1807.06757), `regret_moves` the mean of moves minus the oracle's, both over episodes with a known solution.

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
    paths = np.array([e.path_length for e in episodes])
    joints = np.array([e.joint_path_length for e in episodes])
    decisions = np.concatenate([e.decision_ms for e in episodes])
    contacts = np.concatenate([e.contact for e in episodes])
    refused = np.concatenate([e.refused for e in episodes])
    clearance = np.array([np.nanmin(e.clearance) for e in episodes if np.isfinite(e.clearance).any()])
    return {
        "policy": policy,
        "episodes": count,
        "success_rate": float(success.mean()),
        "success_rate_interval_95": list(wilson_interval(int(success.sum()), count)),
        "mean_moves": float(moves.mean()),
        "mean_moves_interval_95": list(mean_interval(moves)),
        "mean_moves_success": float(moves[success].mean()) if success.any() else None,
        "success_rate_within_moves": {str(k): float((success & (moves <= k)).mean()) for k in WITHIN},
        "success_rate_at_threshold": {
            f"{threshold:.2f}": float(np.mean([e.moves_to(threshold, horizon) is not None for e in episodes]))
            for threshold in THRESHOLDS
        },
        "mean_path_m": float(paths.mean()),
        "mean_path_success_m": float(paths[success].mean()) if success.any() else None,
        "mean_joint_path_rad": float(joints.mean()),
        "mean_start_visible_fraction": float(np.mean([e.visible_fraction[0] for e in episodes])),
        "mean_final_visible_fraction": float(np.mean([e.visible_fraction[-1] for e in episodes])),
        "mean_best_visible_fraction": float(np.mean([e.best_visible_fraction for e in episodes])),
        "auc": float(np.mean([e.best_so_far(horizon).mean() for e in episodes])),
        **_against_oracle(episodes, moves, success),
        "decision_ms": float(decisions.mean()) if len(decisions) else None,
        "decision_ms_p95": float(np.percentile(decisions, 95)) if len(decisions) else None,
        "contact_episode_rate": float(np.mean([bool(e.contact.any()) for e in episodes])),
        "contact_move_rate": float(contacts.mean()) if len(contacts) else 0.0,
        "contact_free_success_rate": float(np.mean([e.success and not e.contact.any() for e in episodes])),
        "mean_min_clearance_m": float(clearance.mean()) if len(clearance) else None,
        "refused_move_rate": float(refused.mean()) if len(refused) else 0.0,
    }


def compare_policies(runs: Mapping[str, Sequence[ViewEpisode]], horizon: int) -> list[dict[str, Any]]:
    """Paired tests of every two policies on the episodes that both have, ready for JSON."""
    names = list(runs)
    tests = []
    for i, a in enumerate(names):
        for b in names[i + 1 :]:
            first = {e.episode: e for e in runs[a]}
            second = {e.episode: e for e in runs[b]}
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


def counted_moves(episodes: Sequence[ViewEpisode], horizon: int) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Moves of each episode, a failed one with the whole horizon. Shape (N,)."""
    return np.array([e.moves if e.success else horizon for e in episodes], dtype=np.float64)


def _against_oracle(episodes: Sequence[ViewEpisode], moves: Any, success: Any) -> dict[str, Any]:
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
