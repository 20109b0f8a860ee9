"""The report of an evaluation: one page that needs no other file."""

import html
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from maniskill_tomato.files import write_atomically
from maniskill_tomato.report_design import figure, notice, page, paragraph, section, table, tile


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
    video: Path | None = None
    policy: Path | None = None
    left_out: str | None = None
    """Why pictures are missing, if they are, and how to get them."""


def write_report(path: Path, content: ReportInput) -> None:
    """Writes the page to `path`; pictures are embedded, the video and the policy are linked."""
    metrics = content.metrics
    text = page(
        content.title,
        f"{metrics['env_id']}, {metrics['episodes']} evaluation episodes from seed {metrics['seed']}",
        [
            _summary(metrics),
            notice(content.left_out),
            _views(content, path.parent),
            _gallery("Evaluation", content.evaluation, _evaluation_text(metrics)),
            _gallery("Training", content.training, "Moving averages over the whole run."),
            section("Metrics", _table(metrics)),
            _facts(content, path.parent),
        ],
    )
    write_atomically(path, text.encode())


def _summary(metrics: Mapping[str, Any]) -> str:
    low, high = metrics["success_rate_interval_95"]
    tiles = (
        (
            "success_rate",
            "{:.0%}",
            f"target fully visible (V_f > {metrics['success_threshold']:g})",
            f"95 % interval {low:.0%} to {high:.0%}",
        ),
        ("mean_steps", "{:.1f}", "steps per episode", "failures count with all their steps"),
        (
            "mean_max_visible_fraction",
            "{:.2f}",
            "largest visible fraction, mean",
            f"from {metrics['mean_initial_visible_fraction']:.2f} at the start",
        ),
        ("mean_path_length_m", "{:.2f} m", "way of the camera, mean", "straight lines between views"),
    )
    random = metrics.get("random_actions")
    cells = [
        tile(
            form.format(metrics[key]),
            label,
            note,
            *([f"random actions: {form.format(random[key])}"] if random else []),
        )
        for key, form, label, note in tiles
    ]
    return f'<section class="tiles">{"".join(cells)}</section>'


def _views(content: ReportInput, folder: Path) -> str:
    if not content.views and content.video is None:
        return ""
    figures = "".join(figure(picture.path, picture.caption) for picture in content.views)
    film = ""
    if content.video is not None:
        link = html.escape(_relative(content.video, folder))
        film = (
            f'<video controls preload="metadata" src="{link}"></video>'
            f'<p class="caption">The first episodes: outside on the left, the wrist camera on the right, V_f below. '
            f'<a href="{link}">{link}</a></p>'
        )
    return section("What the camera sees", f'<div class="pairs">{figures}</div>' if figures else "", film)


def _gallery(title: str, pictures: Sequence[ReportPicture], text: str) -> str:
    if not pictures:
        return ""
    return section(title, paragraph(text), *(figure(picture.path, picture.caption) for picture in pictures))


def _evaluation_text(metrics: Mapping[str, Any]) -> str:
    within = metrics["success_rate_within_steps"]
    parts = [f"{rate:.0%} after {k} step{'' if k == '1' else 's'}" for k, rate in within.items()]
    return (
        "The policy acts without exploration; every episode has its own seed. "
        f"Share of episodes solved: {', '.join(parts[:-1])} and {parts[-1]}."
    )


_ROWS = (
    ("success_rate", "Success rate", "{:.1%}"),
    ("mean_steps", "Mean steps", "{:.2f}"),
    ("mean_steps_success", "Mean steps of successful episodes", "{:.2f}"),
    ("mean_initial_visible_fraction", "Mean V_f at the start", "{:.3f}"),
    ("mean_max_visible_fraction", "Mean largest V_f", "{:.3f}"),
    ("mean_final_visible_fraction", "Mean V_f at the end", "{:.3f}"),
    ("mean_return", "Mean return (Eq. 4-5)", "{:.2f}"),
    ("mean_path_length_m", "Mean way of the camera [m]", "{:.2f}"),
    ("unreachable_step_share", "Steps that asked for an unreachable pose", "{:.1%}"),
    ("forbidden_zone_step_share", "Steps that ended in the forbidden zone", "{:.1%}"),
)


def _table(metrics: Mapping[str, Any]) -> str:
    columns = {"policy": metrics}
    if (random := metrics.get("random_actions")) is not None:
        columns["random actions"] = random
    rows = [
        (label, *("none" if c[key] is None else form.format(c[key]) for c in columns.values()))
        for key, label, form in _ROWS
    ]
    return table(("", *columns), rows)


def _facts(content: ReportInput, folder: Path) -> str:
    rows = [f"<dt>{html.escape(k)}</dt><dd>{html.escape(v)}</dd>" for k, v in content.facts.items()]
    if content.policy is not None:
        link = html.escape(_relative(content.policy, folder))
        rows.append(f'<dt>policy</dt><dd><a href="{link}">{link}</a></dd>')
    return section("About this run", f"<dl>{''.join(rows)}</dl>")


def _relative(path: Path, folder: Path) -> str:
    return Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix()
