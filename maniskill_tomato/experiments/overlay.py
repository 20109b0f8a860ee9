"""Captions and the visible-fraction gauge on the frames of a film."""

import functools

import numpy as np
from matplotlib import font_manager
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from maniskill_tomato import report_design as design
from maniskill_tomato.report_design import rgb

BAND = 64
"""Height of the caption under the pictures, in [px]."""

PAPER, INK, MUTED, TRACK, TOMATO, LEAF = (
    rgb(colour)
    for colour in (design.PAPER, design.INK, design.MUTED, design.GRID, design.TOMATO, design.LEAF)
)


def annotate(
    outside: NDArray[np.uint8],
    wrist: NDArray[np.uint8],
    *,
    title: str,
    step: int,
    visible_fraction: float,
    threshold: float,
    moving: bool,
    success: bool,
) -> NDArray[np.uint8]:
    """Both pictures side by side with a caption below.

    Args:
        outside: The scene. Shape (H, W, 3).
        wrist: The wrist camera's view. Shape (H, W, 3).
        title: What the film shows.
        step: Steps taken so far.
        visible_fraction: V_f at this moment.
        threshold: V_f above which the target counts as fully visible.
        moving: Whether the arm is between two viewpoints.
        success: Whether the target became fully visible.

    Returns:
        Shape (H + BAND, 2 W, 3).
    """
    height, width = outside.shape[:2]
    canvas = Image.new("RGB", (2 * width, height + BAND), PAPER)
    canvas.paste(Image.fromarray(outside), (0, 0))
    canvas.paste(Image.fromarray(wrist), (width, 0))
    draw = ImageDraw.Draw(canvas)
    draw.line((width, 0, width, height), fill=PAPER, width=4)
    top = height + 11
    draw.text((20, top), title, font=_font(19, bold=True), fill=INK)
    state = "target fully visible" if success else ("moving" if moving else "looking")
    draw.text((20, top + 24), f"step {step}, {state}", font=_font(15), fill=LEAF if success else MUTED)
    _draw_gauge(draw, width + 20, top, width - 40, visible_fraction, threshold)
    return np.asarray(canvas)


def _draw_gauge(
    draw: ImageDraw.ImageDraw, left: int, top: int, width: int, visible_fraction: float, threshold: float
) -> None:
    """A bar from 0 to 1 with a mark at the threshold."""
    draw.text((left, top), "visible fraction of the target", font=_font(15), fill=MUTED)
    value = f"{visible_fraction:.2f}"
    draw.text((left + width, top - 3), value, font=_font(19, bold=True), fill=INK, anchor="ra")
    y0, y1 = top + 26, top + 40
    draw.rounded_rectangle((left, y0, left + width, y1), radius=7, fill=TRACK)
    end = left + max(14, int(width * visible_fraction))
    draw.rounded_rectangle(
        (left, y0, end, y1), radius=7, fill=LEAF if visible_fraction > threshold else TOMATO
    )
    mark = left + int(width * threshold)
    draw.line((mark, y0 - 4, mark, y1 + 4), fill=INK, width=2)


@functools.cache
def _font(size: int, bold: bool = False) -> ImageFont.FreeTypeFont:
    """DejaVu Sans, which comes with matplotlib."""
    properties = font_manager.FontProperties(family="DejaVu Sans", weight="bold" if bold else "normal")
    return ImageFont.truetype(font_manager.findfont(properties), size)
