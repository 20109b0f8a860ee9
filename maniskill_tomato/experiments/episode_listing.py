"""Every episode of a report: failures first, each with its reason and the command that runs it again."""

import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

from maniskill_tomato.experiments.camera_metrics import Cause, failure_cause
from maniskill_tomato.experiments.episode_record import EpisodeRecord
from maniskill_tomato.report_design import RowNotes, folded, paragraph, table
from maniskill_tomato.tasks import GENERAL_IDS

LISTED: Final = 200
"""Episodes of a list; failures come first, and what is left out is counted."""

HEAD: Final = ("episode", "outcome", "moves", "V_f at the start", "best V_f")

CAUSES: Final[dict[Cause, str]] = {
    "never_detected": "the camera never detected the target",
    "wrong_fruit": "it looked at another fruit",
    "overestimated": "it stopped at the target, of which it saw less than it measured",
    "underestimated": "a view showed the target fully, and it did not stop",
    "place": "it believed the target in another place",
    "moves_ran_out": "moves ran out",
}


@dataclass(frozen=True, kw_only=True)
class ListedEpisode:
    """One line of the list."""

    seed: int
    """Seed of the episode, or its number in a fixed list."""
    success: bool
    reason: str
    """Why it failed; empty if nothing is to be said."""
    moves: int
    start: float | None
    """V_f of the first view."""
    best: float | None
    """Largest V_f of any view."""
    command: str
    """Runs it again; empty if no command does."""


def list_episode(
    record: EpisodeRecord, threshold: float, horizon: int | None, command: str | None
) -> ListedEpisode:
    """An episode as a line; where a camera measures V_f, success and V_f are the true ones.

    Args:
        record: The episode.
        threshold: V_f above which the target is fully visible.
        horizon: Most moves of an episode; None if it is not known.
        command: Runs it again; None if no command does.
    """
    shown = record.visible_fraction if record.true_visible_fraction is None else record.true_visible_fraction
    cause = _cause(record, threshold)
    if record.row is not None:
        # A robot that inspects a row ends when it believes that it has seen all.
        success = record.success and set(record.row.targets) <= set(record.row.seen)
    else:
        success = record.success if cause is None and not _has_camera(record) else cause is None
    return ListedEpisode(
        seed=record.seed,
        success=success,
        reason=reason(record, threshold, horizon) if not success else "",
        moves=record.steps if record.row is None else record.row.moves,
        start=float(shown[0]),
        best=float(shown.max()),
        command=command or "",
    )


def reason(record: EpisodeRecord, threshold: float, horizon: int | None) -> str:
    """Why an episode failed, in words: the camera's part in it, else how it ended and what hindered the arm."""
    refused = int(record.refused.sum())
    touched = 0 if record.contact is None else int(record.contact.sum())
    zone = 0 if record.in_forbidden_zone is None else int(record.in_forbidden_zone.sum())
    if (cause := _cause(record, threshold)) is not None:
        words = [CAUSES[cause]]
    elif record.row is not None:
        ended = "the robot ended its search" if record.success else "moves ran out"
        seen = len(set(record.row.seen) & set(record.row.targets))
        words = [f"{seen} of {len(record.row.targets)} tomatoes seen when {ended}"]
    elif horizon is not None and record.steps < horizon and record.steps and bool(record.refused[-1]):
        words = ["the camera was sent out of the arm's workspace, which ends the episode"]
        refused -= 1
    else:
        words = ["moves ran out"]
    words += [
        f"{count} move{'' if count == 1 else 's'} {what}"
        for count, what in (
            (refused, "out of reach"),
            (touched, "with the arm in the plant"),
            (zone, "into the forbidden zone"),
        )
        if count
    ]
    return ", ".join(words)


def failures_first(episodes: Iterable[ListedEpisode]) -> list[ListedEpisode]:
    """Failures, the one that came nearest to success last, then successes, the longest first."""
    return sorted(
        episodes,
        key=lambda e: (e.success, (e.best or 0.0) if not e.success else -float(e.moves), e.seed),
    )


def episode_list(
    episodes: Sequence[ListedEpisode], title: str | None = None, noun: Literal["episode", "row"] = "episode"
) -> str:
    """The list as HTML.

    Args:
        episodes: In any order.
        title: Folds the list under it; None shows it at once.
        noun: What an episode is called.
    """
    ordered = failures_first(episodes)
    shown = ordered[:LISTED]
    failed = sum(not e.success for e in episodes)
    counted = f"{failed} of {len(episodes)} {noun}{'' if len(episodes) == 1 else 's'} failed."
    if len(ordered) > len(shown):
        counted += f" The first {len(shown)} lines are shown."
    rows = [
        (
            str(e.seed),
            "solved" if e.success else "failed",
            str(e.moves),
            "" if e.start is None else f"{e.start:.2f}",
            "" if e.best is None else f"{e.best:.2f}",
        )
        for e in shown
    ]
    below = [RowNotes(text=e.reason, command=e.command) for e in shown]
    parts = (
        paragraph(counted, "caption"),
        table((noun, *HEAD[1:]), rows, below=below, tall=True),
    )
    return "".join(parts) if title is None else folded(f"{title}: {counted}", parts[1])


def replay_with_eval(
    env_id: str,
    policy: str,
    seed: int,
    env_options: Mapping[str, Any] | None = None,
    *,
    out: str = "runs/again",
    allow_other_task: bool = False,
) -> str | None:
    """The `eval` that runs one episode again, with its film; None where an option of the task has no flag there.

    Args:
        env_id: The task.
        policy: Name or file.
        seed: Of the episode.
        env_options: Of the task.
        out: Folder of its report.
        allow_other_task: Whether the policy may be of another task.
    """
    options = dict(env_options or {})
    flags: list[str] = []
    plant = options.pop("plant", {})
    plant = {"preset": plant} if isinstance(plant, str) else dict(plant)
    for name, flag in (
        ("preset", "--plant"),
        ("generator", "--plant"),
        ("mesh", "--mesh"),
        ("seed", "--plant-seed"),
        ("pool", "--plant-pool"),
    ):
        if plant.get(name) is not None:
            flags += [flag, str(plant[name])]
        plant.pop(name, None)
    for name in ("plant_pose", "plant_pose_noise"):
        if (values := options.pop(name, None)) is not None:
            flags += [f"--{name.replace('_', '-')}", *(f"{value:g}" for value in values)]
    listed = options.pop("episodes", None)
    if listed is not None:
        flags += ["--episode-list", str(listed)]
    elif env_id == GENERAL_IDS[0] and not flags:
        return None  # `eval` takes the held-out list there.
    if options.pop("render_backend", "none") not in ("none", "auto"):
        return None
    if (perception := options.pop("perception", None)) not in (None, "ground_truth"):
        flags += ["--perception", str(perception)]
        for name in ("target", "map_noise"):
            if (value := options.pop(name, None)) is not None:
                flags += [f"--{name.replace('_', '-')}", str(value)]
    if plant or options:
        return None
    if allow_other_task:
        flags.append("--allow-other-task")
    fixed = [
        "--policy",
        policy,
        "--seed",
        str(seed),
        "--episodes",
        "1",
        "--no-baseline",
        "--out",
        f"{out}-{seed}",
    ]
    return shlex.join(["maniskill-tomato", "eval", env_id, *fixed, *flags])


def list_episodes(
    records: Sequence[EpisodeRecord],
    threshold: float,
    horizon: int | None,
    command: Callable[[int], str | None],
) -> list[ListedEpisode]:
    """Episodes as lines; `command` gives that of a seed."""
    return [list_episode(record, threshold, horizon, command(record.seed)) for record in records]


def _has_camera(record: EpisodeRecord) -> bool:
    return record.row is None and record.target_named is not None and record.true_visible_fraction is not None


def _cause(record: EpisodeRecord, threshold: float) -> Cause | None:
    return failure_cause(record, threshold) if _has_camera(record) else None
