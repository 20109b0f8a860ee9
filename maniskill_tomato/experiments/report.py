"""The report of an evaluation: one page that needs no other file."""

import base64
import html
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from maniskill_tomato.experiments.report_style import PAGE, STYLE


@dataclass(frozen=True, kw_only=True)
class Picture:
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
    training: Sequence[Picture] = ()
    evaluation: Sequence[Picture] = ()
    views: Sequence[Picture] = ()
    """First and last views; two by two."""
    video: Path | None = None
    policy: Path | None = None
    left_out: str | None = None
    """Why pictures are missing, if they are, and how to get them."""


def write_report(path: Path, content: ReportInput) -> None:
    """Writes the page to `path`; pictures are embedded, the video and the policy are linked."""
    path.parent.mkdir(parents=True, exist_ok=True)
    metrics = content.metrics
    sections = [
        _summary(metrics),
        _notice(content.left_out),
        _views(content, path.parent),
        _gallery("Evaluation", content.evaluation, _evaluation_text(metrics)),
        _gallery("Training", content.training, "Moving averages over the whole run."),
        _table(metrics),
        _facts(content, path.parent),
    ]
    subtitle = f"{metrics['env_id']}, {metrics['episodes']} evaluation episodes from seed {metrics['seed']}"
    page = PAGE.format(
        style=STYLE,
        title=html.escape(content.title),
        subtitle=html.escape(subtitle),
        body="\n".join(section for section in sections if section),
        version=html.escape(str(metrics["package_version"])),
    )
    path.write_text(page, encoding="utf-8")


def _summary(metrics: Mapping[str, Any]) -> str:
    low, high = metrics["success_rate_interval_95"]
    random = metrics.get("random_actions")
    tiles = [
        (
            f"{metrics['success_rate']:.0%}",
            f"target fully visible (V_f &gt; {metrics['success_threshold']:g})",
            f"95 % interval {low:.0%} to {high:.0%}",
            random and f"{random['success_rate']:.0%}",
        ),
        (
            f"{metrics['mean_steps']:.1f}",
            "steps per episode",
            "failures count with all their steps",
            random and f"{random['mean_steps']:.1f}",
        ),
        (
            f"{metrics['mean_max_visible_fraction']:.2f}",
            "largest visible fraction, mean",
            f"from {metrics['mean_initial_visible_fraction']:.2f} at the start",
            random and f"{random['mean_max_visible_fraction']:.2f}",
        ),
        (
            f"{metrics['mean_path_length_m']:.2f} m",
            "way of the camera, mean",
            "straight lines between views",
            random and f"{random['mean_path_length_m']:.2f} m",
        ),
    ]
    cells = "\n".join(
        f'<div class="tile"><b>{value}</b><span>{label}</span><small>{note}</small>'
        + (f"<small>random actions: {compared}</small>" if compared else "")
        + "</div>"
        for value, label, note, compared in tiles
    )
    return f'<section class="tiles">{cells}</section>'


def _notice(left_out: str | None) -> str:
    return f'<section class="notice">{html.escape(left_out)}</section>' if left_out else ""


def _views(content: ReportInput, folder: Path) -> str:
    if not content.views and content.video is None:
        return ""
    figures = "\n".join(_figure(picture) for picture in content.views)
    film = ""
    if content.video is not None:
        link = html.escape(_relative(content.video, folder))
        film = (
            f'<video controls preload="metadata" src="{link}"></video>'
            f'<p class="caption">The first episodes: outside on the left, the wrist camera on the right, V_f below. '
            f'<a href="{link}">{link}</a></p>'
        )
    grid = f'<div class="pairs">{figures}</div>' if figures else ""
    return f"<section><h2>What the camera sees</h2>{grid}{film}</section>"


def _gallery(title: str, pictures: Sequence[Picture], text: str) -> str:
    if not pictures:
        return ""
    figures = "\n".join(_figure(picture) for picture in pictures)
    return f"<section><h2>{title}</h2><p>{text}</p>{figures}</section>"


def _evaluation_text(metrics: Mapping[str, Any]) -> str:
    within = metrics["success_rate_within_steps"]
    parts = [f"{rate:.0%} after {k} step{'' if k == '1' else 's'}" for k, rate in within.items()]
    return (
        "The policy acts without exploration; every episode has its own seed. "
        f"Share of episodes solved: {', '.join(parts[:-1])} and {parts[-1]}."
    )


def _figure(picture: Picture) -> str:
    kind = "jpeg" if picture.path.suffix.lower() in (".jpg", ".jpeg") else "png"
    data = base64.b64encode(picture.path.read_bytes()).decode()
    caption = html.escape(picture.caption)
    image = f'<img alt="{caption}" src="data:image/{kind};base64,{data}">'
    return f"<figure>{image}<figcaption>{caption}</figcaption></figure>"


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
    random = metrics.get("random_actions")
    head = "<th>policy</th>" + ("<th>random actions</th>" if random else "")
    rows = []
    for key, label, form in _ROWS:
        values = [metrics[key]] + ([random[key]] if random else [])
        cells = "".join(f"<td>{'none' if v is None else form.format(v)}</td>" for v in values)
        rows.append(f"<tr><th scope='row'>{label}</th>{cells}</tr>")
    return (
        f"<section><h2>Metrics</h2><div class='scroll'><table><thead><tr><th></th>{head}</tr></thead>"
        f"<tbody>{''.join(rows)}</tbody></table></div></section>"
    )


def _facts(content: ReportInput, folder: Path) -> str:
    rows = [f"<dt>{html.escape(k)}</dt><dd>{html.escape(v)}</dd>" for k, v in content.facts.items()]
    if content.policy is not None:
        link = html.escape(_relative(content.policy, folder))
        rows.append(f'<dt>policy</dt><dd><a href="{link}">{link}</a></dd>')
    return f"<section><h2>About this run</h2><dl>{''.join(rows)}</dl></section>"


def _relative(path: Path, folder: Path) -> str:
    return Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix()
