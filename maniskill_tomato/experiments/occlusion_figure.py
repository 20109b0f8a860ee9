"""A picture of every step of the thesis's occlusion model, as its Fig. 4-28."""

from io import BytesIO
from pathlib import Path

import cv2
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from maniskill_tomato.files import write_atomically
from maniskill_tomato.sensing.visible_fraction.estimate import Estimate, SegmentedImage, UInt8
from maniskill_tomato.sensing.visible_fraction.thesis import ThesisSteps


def draw_steps(
    view: SegmentedImage, result: ThesisSteps, path: Path, extra: dict[str, list[Estimate]]
) -> None:
    """Draws (a) to (h) and, below, what other models make of the same image.

    Args:
        view: The image.
        result: The thesis's steps of it.
        path: PNG to write.
        extra: Estimates of other models by name, one for each mask.

    Raises:
        CheckpointError: The file cannot be written.
    """
    ellipses = view.rgb.copy()
    for ellipse in result.ellipses:
        cv2.ellipse(ellipses, ellipse, (40, 90, 255), 2)
    panels: list[tuple[str, UInt8]] = [
        ("(a) image", view.rgb),
        ("(b) tomato masks", result.tomatoes),
        ("(c) leaves: green minus red", result.leaves),
        ("(d) inpainted", result.inpainted),
        ("(e) red over green, cleaned, depth", result.binary),
        ("(f) contours", _outlined(view.rgb, list(result.contours))),
        ("(g) ellipses", ellipses),
        ("(h) without background, V_f", view.rgb),
    ]
    for name in extra:
        panels.append((f"{name}, V_f", view.rgb))
    columns = 4
    rows = -(-len(panels) // columns)
    figure, axes = plt.subplots(rows, columns, figsize=(4 * columns, 3.2 * rows), constrained_layout=True)
    for axis in axes.ravel():
        axis.axis("off")
    for axis, (title, image) in zip(axes.ravel(), panels, strict=False):
        axis.imshow(image, cmap="gray", vmin=0, vmax=255)
        axis.set_title(title, fontsize=10)
    _label(axes.ravel()[7], [w > 0 for w in result.whole], list(result.fractions))
    for axis, estimates in zip(axes.ravel()[8:], extra.values(), strict=False):
        known = [e for e in estimates if e.whole is not None]
        _label(axis, [e.whole for e in known], [e.visible_fraction for e in known])
    buffer = BytesIO()
    figure.savefig(buffer, dpi=80)
    plt.close(figure)
    write_atomically(path, buffer.getvalue())


def _outlined(rgb: UInt8, contours: list[np.ndarray[tuple[int, ...], np.dtype[np.int32]]]) -> UInt8:
    picture = rgb.copy()
    cv2.drawContours(picture, contours, -1, (40, 90, 255), 2)
    return picture


def _label(
    axis: Axes, masks: list[np.ndarray[tuple[int, ...], np.dtype[np.bool_]] | None], values: list[float]
) -> None:
    """Outlines of whole tomatoes with their V_f."""
    for mask, value in zip(masks, values, strict=True):
        if mask is None or not mask.any():
            continue
        axis.contour(mask.astype(float), levels=[0.5], colors=["#3060ff"], linewidths=1.2)
        y, x = (float(np.mean(i)) for i in np.nonzero(mask))
        axis.text(x, y, f"{value:.2f}", color="white", fontsize=8, ha="center", va="center", weight="bold")
