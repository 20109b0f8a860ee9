"""What stands at the top of a page's panel, as HTML: which episode, V_f, the wrist camera's picture, the last moves."""

import base64
import html
from typing import Final

import cv2
import numpy as np

from maniskill_tomato.view.episode_recording import EpisodeRecording, UInt8

NARROW_PX: Final = 576
"""Where a page is at most so wide, viser draws its panel as a sheet at the bottom."""

LAST_MOVES: Final = 6
"""Moves that are told in words."""

STYLE: Final = f"""<style>
.tomato-head {{ padding: 0.3em 0.7em; line-height: 1.45; overflow-wrap: anywhere; }}
.tomato-picture {{ margin-top: 0.3em; }}
@media (max-width: {NARROW_PX}px) {{
  .tomato-head {{ display: flex; gap: 0.7em; align-items: flex-start; }}
  .tomato-head div {{ flex: 1; }}
  .tomato-head .tomato-picture {{ flex: 0 0 44%; margin: 0; }}
}}
</style>"""
"""On a narrow page the picture stands beside the words, so that most of the scene stays in sight."""


def head(recording: EpisodeRecording, shown: int) -> str:
    """Which episode it is, V_f, how it ended, and the picture."""
    if not recording.snapshots:
        words, picture = f"{html.escape(recording.title)}<br>There was no look yet.", ""
    else:
        words = headline(recording, shown)
        picture = picture_tag(recording.picture(shown), "What the wrist camera sees")
    return (
        f'{STYLE}<div class="tomato-head"><div>{words}</div><div class="tomato-picture">{picture}</div></div>'
    )


def headline(recording: EpisodeRecording, shown: int) -> str:
    """Which episode it is, V_f, and how it ended."""
    snapshot, move = recording.at(shown), min(shown, recording.moves)
    fraction = f"V_f <b>{snapshot.visible_fraction:.2f}</b> at move {move}"
    if snapshot.measured is not None:
        low, value, high = snapshot.measured.band
        fraction = f"V_f <b>{value:.2f}</b>, from {low:.2f} to {high:.2f}, at move {move}"
    if snapshot.true_visible_fraction is not None:
        fraction += f" (truly {snapshot.true_visible_fraction:.2f})"
    lines = [html.escape(recording.title), fraction]
    if move == recording.moves and recording.outcome:
        lines.append(f"<b>{html.escape(recording.outcome)}</b>")
    return "<br>".join(lines)


def last_moves(recording: EpisodeRecording, shown: int) -> str:
    """The last moves in words, the latest first, as a Markdown list."""
    lines = []
    last = min(shown, recording.moves)
    for k in range(last, max(last - LAST_MOVES, 0), -1):
        snapshot = recording.snapshots[k]
        event = f"**{snapshot.event}**" if snapshot.was_refused else snapshot.event
        fraction = snapshot.visible_fraction if snapshot.measured is None else snapshot.measured.value
        lines.append(f"{k}. {event}, V_f {fraction:.2f}")
    return "\n".join(f"- move {line}" for line in lines)


def picture_tag(picture: UInt8, what: str, quality: int = 85) -> str:
    """A picture as an HTML image as wide as its container.

    Args:
        picture: RGB. Shape (H, W, 3).
        what: It shows, as text.
        quality: Of JPEG, from 1 to 100.
    """
    _, packed = cv2.imencode(
        ".jpg", np.ascontiguousarray(picture[..., ::-1]), (cv2.IMWRITE_JPEG_QUALITY, quality)
    )
    data = base64.b64encode(packed.tobytes()).decode()
    return f'<img alt="{html.escape(what)}" style="width: 100%" src="data:image/jpeg;base64,{data}">'
