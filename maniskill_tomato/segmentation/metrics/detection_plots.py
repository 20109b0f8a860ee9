"""Curves of a segmenter's training and evaluation, as the thesis draws them."""

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.files import write_atomically
from maniskill_tomato.report_design import SERIES
from maniskill_tomato.report_plots import PANEL, PLOT_STYLE, line_style, save_figure
from maniskill_tomato.segmentation.metrics.detection_metrics import COCO_OVERLAPS, PrecisionRecall

COLOURS = SERIES[:4]
"""Of the runs in a figure."""


def plot_precision_recall(curves: Mapping[str, PrecisionRecall], path: Path) -> None:
    """Precision over recall, with its interpolation and AP (Fig. 4-5, 4-20, 4-24).

    Raises:
        CheckpointError: The file cannot be written.
    """
    with mpl.rc_context(PLOT_STYLE):
        figure = Figure(figsize=PANEL)
        axes = figure.add_subplot()
        for index, (name, curve) in enumerate(curves.items()):
            recall = np.concatenate([[0.0], curve.recall])
            precision = np.concatenate([curve.precision[:1], curve.precision])
            envelope = np.maximum.accumulate(precision[::-1])[::-1]
            style = line_style(index, max(len(recall), 9))
            axes.plot(recall, precision, color=style["color"], alpha=0.35, linewidth=1)
            axes.plot(recall, envelope, **style, label=f"{name}, AP50 {curve.average_precision:.4f}")
        axes.set(
            title="Precision and recall", xlabel="recall", ylabel="precision", xlim=(0, 1), ylim=(0, 1.02)
        )
        axes.legend(loc="lower left")
        save_figure(figure, path)


def plot_overlaps(precision: Mapping[str, Mapping[str, NDArray[np.float64]]], path: Path) -> None:
    """AP over the overlap that is asked for, a panel for boxes and one below for masks, with a curve for each size.

    Args:
        precision: Of boxes or masks, what `DetectionScore.precision_by_overlap` gives.
        path: The picture.

    Raises:
        CheckpointError: The file cannot be written.
    """
    with mpl.rc_context(PLOT_STYLE):
        figure = Figure(figsize=(PANEL[0], PANEL[1] * len(precision)))
        panels = figure.subplots(len(precision), 1, squeeze=False)[:, 0]
        for axes, (overlap, sizes) in zip(panels, precision.items(), strict=True):
            for index, (size, values) in enumerate(sizes.items()):
                label = f"{size}, AP50-95 {values.mean():.3f}"
                axes.plot(COCO_OVERLAPS, values, **line_style(index), label=label)
            axes.set(
                title=f"AP of {overlap}es".replace("maskes", "masks"),
                xlabel=f"least overlap of the {overlap}",
                ylabel="AP",
                ylim=(0, 1.02),
            )
            axes.legend(loc="lower left")
        save_figure(figure, path)


def plot_losses(
    histories: Mapping[str, Sequence[Mapping[str, float]]], path: Path, smoothing: int = 5
) -> None:
    """One panel for each loss term, training above and validation below (Fig. 4-9 to 4-19).

    Thick lines are moving means, thin ones the values. Terms that the images do not annotate, which are 0 throughout,
    have no panel.

    Args:
        histories: Lines of `history.json` of each run, by its name.
        path: The picture.
        smoothing: Lines that a moving mean spans.

    Raises:
        InvalidInputError: A history is empty.
        CheckpointError: The file cannot be written.
    """
    if not histories or any(not lines for lines in histories.values()):
        raise InvalidInputError("there must be histories with at least one line to plot")
    found = {key for lines in histories.values() for line in lines for key in line}
    terms = sorted({k.removeprefix("val_") for k in found} - {"step"}, key=lambda k: (k != "loss", k))
    rows = 2 if any(k.startswith("val_") for k in found) else 1
    figure = Figure(figsize=(2.7 * len(terms), 2.4 * rows), layout="constrained")
    for row, prefix in enumerate(("", "val_")[:rows]):
        for column, term in enumerate(terms):
            if not any(line.get(prefix + term) for lines in histories.values() for line in lines):
                continue
            axes = figure.add_subplot(rows, len(terms), row * len(terms) + column + 1)
            for (name, lines), colour in zip(histories.items(), COLOURS, strict=False):
                _plot_term(axes, lines, prefix + term, name, colour, smoothing)
            axes.set_title(f"{'validation' if prefix else 'training'}: {term}", fontsize=9)
            axes.tick_params(labelsize=7)
            axes.grid(alpha=0.3)
            if row == 0 and column == 0:
                axes.legend(fontsize=7)
    _write(figure, path)


def _plot_term(
    axes: Any, lines: Sequence[Mapping[str, float]], key: str, name: str, colour: str, smoothing: int
) -> None:
    chosen = [(line["step"], line[key]) for line in lines if key in line]
    if not chosen:
        return
    steps, values = np.array(chosen).T
    window = min(smoothing, len(values))
    # A mean over the lines so far, at the start over fewer.
    sums = np.cumsum(np.concatenate([[0.0], values]))
    first = np.maximum(np.arange(1, len(values) + 1) - window, 0)
    smooth = (sums[1:] - sums[first]) / (np.arange(1, len(values) + 1) - first)
    axes.plot(steps, values, color=colour, alpha=0.3, linewidth=0.8)
    axes.plot(steps, smooth, color=colour, label=name)


def _write(figure: Figure, path: Path) -> None:
    buffer = io.BytesIO()
    FigureCanvasAgg(figure)
    figure.savefig(buffer, format="png", dpi=110)
    write_atomically(path, buffer.getvalue())
