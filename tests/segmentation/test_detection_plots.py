"""The curves of a training, looked at as pictures."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.segmentation.metrics.detection_plots import COLOURS, plot_losses, plot_overlaps

HISTORY = [
    {
        "step": 10.0 * i,
        "loss": 3.0 / i,
        "centre": 1.0 / i,
        "fruit": 2.0 / i,
        "val_loss": 2.0 / i,
        "val_centre": 2.0 / i,
        "val_fruit": 0.0,
    }
    for i in range(1, 9)
]


def panels(path: Path, rows: int, columns: int) -> list[list[NDArray[np.uint8]]]:
    """The cells of the picture's grid, red, green, blue."""
    picture = np.asarray(cv2.imread(str(path)), np.uint8)[:, :, ::-1]
    return [np.array_split(row, columns, axis=1) for row in np.array_split(picture, rows, axis=0)]


def coloured(cell: NDArray[np.uint8], colour: str) -> int:
    """Pixels near a colour."""
    wanted = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)])
    return int((np.abs(cell.astype(int) - wanted).max(axis=2) < 12).sum())


def test_every_term_has_a_panel_unless_it_is_zero_throughout(tmp_path: Path) -> None:
    plot_losses({"run": HISTORY}, tmp_path / "losses.png")
    (loss, centre, fruit), (val_loss, val_centre, val_fruit) = panels(tmp_path / "losses.png", 2, 3)
    for cell in (loss, centre, fruit, val_loss, val_centre):
        assert coloured(cell, COLOURS[0]) > 50
    assert (val_fruit[10:, 10:] > 250).all(), "photos have no masks: nothing to show"


def test_a_training_without_validation_has_one_row_and_runs_have_their_colours(tmp_path: Path) -> None:
    history = [{k: v for k, v in line.items() if not k.startswith("val_")} for line in HISTORY]
    plot_losses({"a": history, "b": [{**line, "loss": 5.0} for line in history]}, tmp_path / "losses.png")
    ((loss, centre, _),) = panels(tmp_path / "losses.png", 1, 3)
    assert coloured(loss, COLOURS[0]) > 50
    assert coloured(loss, COLOURS[1]) > 50
    # Equal curves: the second run's lies on the first's.
    assert coloured(centre, COLOURS[1]) > 50


def test_boxes_and_masks_have_a_panel_each_with_a_curve_for_every_size(tmp_path: Path) -> None:
    falling = np.linspace(0.9, 0.1, 10)
    boxes = {"all": falling, "small": falling / 2}
    plot_overlaps({"box": boxes, "mask": {"all": falling}}, tmp_path / "overlaps.png")
    (box,), (mask,) = panels(tmp_path / "overlaps.png", 2, 1)
    assert coloured(box, COLOURS[0]) > 50 and coloured(box, COLOURS[1]) > 50
    assert coloured(mask, COLOURS[0]) > 50 and coloured(mask, COLOURS[1]) == 0


@pytest.mark.parametrize("histories", [{}, {"run": []}])
def test_nothing_to_plot_is_refused(histories: dict[str, list[dict[str, float]]], tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="at least one line"):
        plot_losses(histories, tmp_path / "losses.png")
    assert not list(tmp_path.iterdir())
