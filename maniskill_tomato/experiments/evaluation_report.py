"""The report of an evaluation: one page that needs no other file."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from maniskill_tomato.experiments.camera_metrics import Cause
from maniskill_tomato.experiments.episode_listing import CAUSES, ListedEpisode, episode_list
from maniskill_tomato.files import write_atomically
from maniskill_tomato.report_design import (
    figure,
    film,
    notice,
    page,
    paragraph,
    relative_path,
    section,
    side_by_side,
    table,
    tile,
    tiles,
)

FILM_MOVES = 4
"""Moves of the episodes that are filmed, if there are such: enough for a search, few enough to watch."""


@dataclass(frozen=True, kw_only=True)
class ReportPicture:
    """A picture of the report."""

    path: Path
    """A PNG or JPEG file; it is copied into the page."""
    caption: str


@dataclass(frozen=True, kw_only=True)
class ReportInput:
    """What a report is made of."""

    title: str
    metrics: Mapping[str, Any]
    """The content of `metrics.json`."""
    facts: Mapping[str, str] = field(default_factory=dict)
    """Name and value of what the reader should know about the run, in order."""
    training: Sequence[ReportPicture] = ()
    evaluation: Sequence[ReportPicture] = ()
    views: Sequence[ReportPicture] = ()
    """First and last views; two by two."""
    episodes: Sequence[ListedEpisode] = ()
    """What became of each episode."""
    repeats: bool = True
    """Whether an episode that is run alone is the same."""
    video: Path | None = None
    poster: Path | None = None
    """What the video shows before it plays."""
    filmed: int = 0
    """How many episodes it has."""
    policy: Path | None = None
    left_out: str | None = None
    """Why pictures are missing, if they are, and how to get them."""


def write_report(path: Path, content: ReportInput) -> None:
    """Writes the page to `path`; pictures and a small film are embedded, a large one and the policy are named."""
    metrics = content.metrics
    facts = dict(content.facts)
    if content.policy is not None:
        facts["policy"] = relative_path(content.policy, path.parent)
    text = page(
        content.title,
        f"{metrics['env_id']}, {metrics['episodes']} evaluation episodes from seed {metrics['seed']}",
        [
            _summary(metrics),
            notice(content.left_out),
            _views(content, path.parent),
            _episodes(content),
            _gallery("Evaluation", content.evaluation, _evaluation_text(metrics)),
            _gallery("Training", content.training, "Moving averages over the whole run."),
            section(f"Metrics, n = {metrics['episodes']} episodes", _table(metrics)),
        ],
        facts,
    )
    write_atomically(path, text.encode())


def _summary(metrics: Mapping[str, Any]) -> str:
    count = metrics["episodes"]
    seen, unit = f"V_f > {metrics['success_threshold']:g}", f"n = {count} episodes"
    camera = "true_success_rate" in metrics
    shown = [
        (
            "true_success_rate" if camera else "success_rate",
            "{:.0%}",
            f"target {'truly' if camera else 'fully'} visible ({seen})",
            unit,
        ),
        ("mean_steps", "{:.1f} moves", "an episode, mean", f"{unit}; failures count with all their moves"),
        (
            "mean_max_visible_fraction",
            "V_f {:.2f}",
            "largest visible fraction (0 to 1), mean",
            f"{unit}; {metrics['mean_initial_visible_fraction']:.2f} at the start",
        ),
        (
            "mean_path_length_m",
            "{:.2f} m",
            "way of the camera an episode, mean",
            f"{unit}; straight lines between views",
        ),
    ]
    random = metrics.get("random_actions")
    cells = []
    for key, form, label, note in shown:
        low, high = metrics.get(f"{key}_interval_95", (None, None))
        interval = "" if low is None else f"95 % interval {form.format(low)} to {form.format(high)}"
        baseline = f"random actions: {form.format(random[key])}" if random and key in random else ""
        cells.append(tile(form.format(metrics[key]), label, note, interval, baseline))
    return tiles(*cells)


def _views(content: ReportInput, folder: Path) -> str:
    if not content.views and content.video is None:
        return ""
    figures = side_by_side(*(figure(picture.path, picture.caption) for picture in content.views))
    shown = ""
    if content.video is not None:
        episodes = "One episode" if content.filmed == 1 else f"{content.filmed} episodes"
        shown = film(
            content.video,
            content.poster,
            f"{episodes}, solved ones near to {FILM_MOVES} moves if there are any: outside on the left, the wrist "
            "camera on the right, V_f (0 to 1) below.",
            folder,
        )
    return section("What the camera sees", shown, figures)


def _episodes(content: ReportInput) -> str:
    if not content.episodes:
        return ""
    causes: Mapping[Cause, int] = content.metrics.get("failures_by_cause", {})
    told = ", ".join(f"{CAUSES[cause]}: {count}" for cause, count in causes.items() if count)
    return section(
        "Episodes, failures first",
        paragraph(
            "V_f is the visible fraction of the target, from 0 to 1"
            f"{', by the truth and not as the camera measured it' if causes else ''}. "
            f"{AGAIN if content.repeats else NOT_AGAIN}"
            f"{f' Failures by cause: {told}.' if told else ''}"
        ),
        episode_list(content.episodes),
    )


AGAIN = "The command runs the episode again, with its film where this machine can render."

NOT_AGAIN = (
    "These random actions come from one stream over all episodes: the whole evaluation gives the same episodes again, "
    "one of them alone has other actions, and so has the film."
)


def _gallery(title: str, pictures: Sequence[ReportPicture], text: str) -> str:
    if not pictures:
        return ""
    return section(title, paragraph(text), *(figure(picture.path, picture.caption) for picture in pictures))


def _evaluation_text(metrics: Mapping[str, Any]) -> str:
    within = metrics["success_rate_within_steps"]
    parts = [f"{rate:.0%} after {k} move{'' if k == '1' else 's'}" for k, rate in within.items()]
    return (
        "The policy acts without exploration; every episode has its own seed. "
        f"Share of n = {metrics['episodes']} episodes solved: {', '.join(parts[:-1])} and {parts[-1]}."
    )


_ROWS = (
    ("success_rate", "Success rate", "{:.1%}"),
    ("true_success_rate", "True success rate: the target truly fully visible", "{:.1%}"),
    ("false_stop_rate", "False stops: success claimed, not true", "{:.1%}"),
    ("true_association_success_rate", "True success rate if the truth names each detection", "{:.1%}"),
    ("mean_steps", "Mean moves", "{:.2f}"),
    ("mean_steps_success", "Mean moves of successful episodes", "{:.2f}"),
    ("mean_initial_visible_fraction", "Mean V_f at the start", "{:.3f}"),
    ("mean_max_visible_fraction", "Mean largest V_f", "{:.3f}"),
    ("mean_final_visible_fraction", "Mean V_f at the end", "{:.3f}"),
    ("mean_return", "Mean return", "{:.2f}"),
    ("mean_path_length_m", "Mean way of the camera [m]", "{:.2f}"),
    ("unreachable_step_share", "Share of moves to an unreachable pose", "{:.1%}"),
    ("forbidden_zone_step_share", "Share of moves that ended in the forbidden zone", "{:.1%}"),
    ("plant_contact_step_share", "Share of moves with the arm in the plant", "{:.1%}"),
    ("target_seen_share", "Share of the rows' tomatoes that were seen", "{:.1%}"),
    ("moves_per_seen_target", "Moves for each tomato seen", "{:.2f}"),
    ("recall", "Recall of the seeable tomatoes in the list", "{:.1%}"),
    ("precision", "Precision of the list", "{:.1%}"),
)


def _table(metrics: Mapping[str, Any]) -> str:
    columns: dict[str, Mapping[str, Any]] = {"policy": metrics, **metrics.get("beside", {})}
    if (random := metrics.get("random_actions")) is not None:
        columns["random actions"] = random
    rows = []
    for key, label, form in _ROWS:
        values = [column.get(key) for column in columns.values()]
        if any(value is not None for value in values):
            rows.append((label, *("none" if value is None else form.format(value) for value in values)))
    return table(("", *columns), rows)
