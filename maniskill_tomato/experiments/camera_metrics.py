"""What episodes through a camera amount to: which fruit the robot stopped at, whether it was truly full, why not."""

from collections.abc import Mapping, Sequence
from typing import Any, Final, Literal, get_args

import numpy as np

from maniskill_tomato.experiments.episode_record import EpisodeRecord
from maniskill_tomato.experiments.statistics import wilson_interval
from maniskill_tomato.sensing.inspection_judge import JudgedFruit, ListScore, score_lists

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
        `recall` of the seeable fruits, `precision`, `full_precision` and the medians of the errors as `ListScore` has
        them; moves, the camera's way in [m], and the share of the rows that were finished.
    """
    rows = [e.row for e in episodes if e.row is not None and e.row.listed is not None]
    if not rows or len(rows) < len(episodes):
        return {}
    score = score_lists(
        [
            # What was seen can be seen, even where the samples missed the view.
            ([JudgedFruit(**entry) for entry in row.listed or ()], set(seeable[episode.seed]) | set(row.seen))
            for episode, row in zip(episodes, rows, strict=True)
        ],
        threshold,
    )
    return {
        **list_figures(score),
        "mean_moves": sum(row.moves for row in rows) / len(rows),
        "mean_camera_path_m": sum(row.path_m for row in rows) / len(rows),
        "finished_share": sum(e.success for e in episodes) / len(episodes),
    }


def list_figures(score: ListScore) -> dict[str, float | None]:
    """Recall, precisions and the medians of the errors, by their names in `ListScore`."""
    return {
        "recall": score.recall,
        "precision": score.precision,
        "full_precision": score.full_precision,
        "position_error_median_m": score.position_error_median_m,
        "radius_error_median_m": score.radius_error_median_m,
    }


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
