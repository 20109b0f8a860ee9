"""What episodes through a camera amount to: which fruit the robot stopped at, whether it was truly full, why not."""

from collections.abc import Mapping, Sequence
from typing import Any, Final, Literal, get_args

import numpy as np

from maniskill_tomato.experiments.episode_record import EpisodeRecord
from maniskill_tomato.experiments.statistics import wilson_interval

Cause = Literal["never_detected", "wrong_fruit", "overestimated", "underestimated", "place", "moves_ran_out"]
"""Why an episode through a camera failed.

- `never_detected`: the robot had no track of the target.
- `wrong_fruit`: it stopped at another fruit, or looked at another one at the end.
- `overestimated`: it stopped at the target, of which it saw less than it measured.
- `underestimated`: a view showed the target fully, and it did not stop.
- `place`: it believed the target farther from where it is than `FARTHEST_PLACE`.
- `moves_ran_out`: none of these.
"""

FARTHEST_PLACE: Final = 0.03
"""About a fruit's radius, in [m]."""


def summarise_camera(episodes: Sequence[EpisodeRecord], threshold: float) -> dict[str, Any]:
    """The figures of episodes with one target that a camera decided; empty for those that the truth did, and for rows.

    All rates are shares of all episodes. A false stop is one that claims success while the target is not fully visible.

    Args:
        episodes: One or more.
        threshold: V_f above which a fruit is fully visible.
    """
    if any(e.chosen_visible_fraction is None or e.row is not None for e in episodes):
        return {}
    right = np.array([_truly_full(e, threshold) for e in episodes])
    claimed = np.array([e.success for e in episodes])
    chosen = np.array([e.success and bool(_last(e.chosen_visible_fraction) > threshold) for e in episodes])
    causes = [failure_cause(e, threshold) for e in episodes]
    return {
        "true_success_rate": float(right.mean()),
        "true_success_rate_interval_95": list(wilson_interval(int(right.sum()), len(right))),
        "chosen_success_rate": float(chosen.mean()),
        "believed_success_rate": float(claimed.mean()),
        "false_stop_rate": float((claimed & ~right).mean()),
        "failures_by_cause": {cause: causes.count(cause) for cause in get_args(Cause)},
    }


def summarise_inspections(
    episodes: Sequence[EpisodeRecord], seeable: Mapping[int, set[int]], threshold: float
) -> dict[str, Any]:
    """The figures of rows that a camera inspected; empty for those that the truth led.

    Args:
        episodes: One or more.
        seeable: The ripe fruits of each row that can be seen fully, by its seed, as indices in `Plant.fruits`.
        threshold: V_f above which a fruit is fully visible.

    Returns:
        `recall`: the share of the seeable fruits that are listed as fully seen and truly were. `precision`: the share
        of the fruits listed as ripe that are ripe and listed once. `full_precision`: the share of the fruits listed as
        ripe and fully seen that are ripe and were fully seen. Errors of place and radius are medians over the
        fruits that are right, in [m].
    """
    rows = [e.row for e in episodes if e.row is not None and e.row.listed is not None]
    if not rows or len(rows) < len(episodes):
        return {}
    wanted = found = claimed = full = 0
    right: list[dict[str, Any]] = []
    for episode, row in zip(episodes, rows, strict=True):
        assert row.listed is not None
        possible = set(seeable[episode.seed]) | set(row.seen)
        wanted, found = wanted + len(possible), found + len(row.seen)
        ripe = [entry for entry in row.listed if entry["is_ripe"]]
        claimed += sum(entry["is_fully_seen"] for entry in ripe)
        full += sum(
            entry["is_fully_seen"] and entry["is_truly_ripe"] and entry["true_fraction"] > threshold
            for entry in ripe
        )
        numbers = [entry["fruit"] for entry in ripe]
        right += [
            entry
            for k, entry in enumerate(ripe)
            if entry["is_truly_ripe"] and entry["fruit"] not in numbers[:k]
        ]
    listed = sum(sum(entry["is_ripe"] for entry in row.listed or ()) for row in rows)
    return {
        "recall": found / wanted if wanted else None,
        "precision": len(right) / listed if listed else None,
        "full_precision": full / claimed if claimed else None,
        "position_error_median_m": _median([entry["position_error_m"] for entry in right]),
        "radius_error_median_m": _median([abs(entry["radius_error_m"]) for entry in right]),
        "mean_moves": sum(row.moves for row in rows) / len(rows),
        "mean_camera_path_m": sum(row.path_m for row in rows) / len(rows),
        "finished_share": sum(e.success for e in episodes) / len(episodes),
    }


def _median(values: Sequence[float]) -> float | None:
    return float(np.median(values)) if values else None


def failure_cause(episode: EpisodeRecord, threshold: float) -> Cause | None:
    """Why an episode failed; None if it did not."""
    if _truly_full(episode, threshold):
        return None
    assert episode.target_named is not None and episode.true_visible_fraction is not None
    assert episode.chosen_fruit is not None and episode.target_fruit is not None
    assert episode.true_target is not None
    if not episode.target_named.any():
        return "never_detected"
    looked_at = episode.chosen_fruit[-1]
    if looked_at not in (-1, episode.target_fruit[-1]):
        return "wrong_fruit"
    if episode.success:
        return "overestimated"
    if bool((episode.true_visible_fraction[episode.target_named] > threshold).any()):
        return "underestimated"
    if float(np.linalg.norm(episode.target[-1] - episode.true_target[-1])) > FARTHEST_PLACE:
        return "place"
    return "moves_ran_out"


def _truly_full(episode: EpisodeRecord, threshold: float) -> bool:
    return episode.success and bool(_last(episode.true_visible_fraction) > threshold)


def _last(values: Any) -> float:
    assert values is not None
    return float(values[-1])
