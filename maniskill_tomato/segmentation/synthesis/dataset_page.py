"""A page about a data set: how many fruits, how hidden, how large, and sample images."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import cv2
import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from maniskill_tomato.report_design import (
    LEAF,
    figure,
    many_small,
    paragraph,
    percent,
    pixels,
    report,
    section,
    side_by_side,
    table,
    tile,
    tiles,
)
from maniskill_tomato.report_plots import PANEL, PLOT_STYLE, save_figure
from maniskill_tomato.run_facts import run_facts
from maniskill_tomato.segmentation.datasets.annotations import AnnotatedImage, AnnotatedImages, Instance
from maniskill_tomato.segmentation.datasets.picture_files import write_picture
from maniskill_tomato.segmentation.drawing import contact_sheet

COLOURS: Final[dict[str, tuple[int, int, int]]] = {
    "tomato_ripe": (255, 70, 60),
    "tomato_turning": (255, 190, 40),
    "tomato_unripe": (190, 255, 80),
    "robot": (80, 160, 255),
}
"""Outlines by category, RGB; other fruits are red."""


SAMPLES, SAMPLE_WIDTH = 15, 320
"""Images on the page, and the width of each in [px]."""

SHEET_IMAGES, SHEET_COLUMNS, SHEET_TILE = 24, 6, 320
"""Images on the contact sheet, images in a row, and width of each in [px]."""


def write_statistics(images: AnnotatedImages, folder: Path) -> Path:
    """Writes `report.html`, its plots and `contact_sheet.jpg` into a data set's folder.

    Returns:
        The page.
    """
    shown = [outlined(image) for image in _spread(images.images, SHEET_IMAGES)]
    # As high as the images need, up to a little more than a square.
    height = round(SHEET_TILE * min(max(i.shape[0] / i.shape[1] for i in shown), 1.25))
    sheet = contact_sheet(shown, SHEET_COLUMNS, (SHEET_TILE, height))
    write_picture(folder / "contact_sheet.jpg", sheet, 88)
    fruits = [i for image in images.images for i in image.instances if i.fruit]
    seen = [i for i in fruits if i.box_xywh[2] > 0]
    counts = Counter(i.category for image in images.images for i in image.instances if i.box_xywh[2] > 0)
    return report(
        folder,
        "Data set",
        f"{len(images.images)} images, {len(seen)} visible fruits",
        [
            _tiles(images, fruits, seen),
            section(
                "Sample pictures",
                many_small(*(_sample(image) for image in _spread(images.images, SAMPLES))),
                paragraph(
                    f"The visible part of each fruit has a thick outline (red: ripe, yellow: turning, green: unripe), "
                    "the whole fruit, hidden parts included, a thin white one; "
                    f"{min(SAMPLES, len(images.images))} of n = {len(images.images)} images. contact_sheet.jpg "
                    f"beside this page has {len(shown)}.",
                    "caption",
                ),
            ),
            section("Composition", side_by_side(*_plots(images, fruits, seen, folder))),
            section(
                f"Categories, n = {sum(counts.values())} visible instances",
                table(
                    ("category", "visible instances", "share"),
                    [(name, str(c), percent(c / sum(counts.values()))) for name, c in sorted(counts.items())],
                ),
            ),
            _bands(fruits),
            paragraph(f"Left out of the photos: {images.skipped_text()}.") if images.skipped else "",
        ],
        run_facts(),
    )


def _tiles(images: AnnotatedImages, fruits: Sequence[Instance], seen: Sequence[Instance]) -> str:
    count = len(images.images)
    low, middle, high = np.percentile([_side(i.box_xywh) for i in seen] or [0.0], [10, 50, 90])
    return tiles(
        tile(str(count), "images"),
        tile(f"{len(seen) / max(count, 1):.1f} fruits", "visible in an image, mean", f"n = {count} images"),
        tile(
            f"{middle:.0f} px",
            "size of a visible fruit's box, median",
            f"n = {len(seen)} fruits; root of the box's area",
            f"10th and 90th percentile {low:.0f} and {high:.0f} px",
        ),
        tile(
            f"{len(fruits) - len(seen)} fruits",
            "of the front row wholly hidden",
            f"n = {len(fruits)} fruits; annotated in annotations_amodal.json only",
        ),
    )


def _sample(image: AnnotatedImage) -> str:
    """An image with its outlines as a small figure."""
    return pixels(outlined(image), f"{len(image.fruits)} visible fruits", SAMPLE_WIDTH)


def _plots(
    images: AnnotatedImages, fruits: Sequence[Instance], seen: Sequence[Instance], folder: Path
) -> list[str]:
    """Histograms, each a figure of the page."""
    fractions = [i.visible_fraction for i in fruits if i.visible_fraction is not None]
    sides = [_side(i.box_xywh) for i in seen]
    per_image = [len(image.fruits) for image in images.images]
    counts = np.arange(max(per_image, default=1) + 2) - 0.5
    wanted: list[tuple[str, list[Any], Any, str, str, str]] = [
        (
            "visible_fraction",
            fractions,
            np.linspace(0, 1, 21),
            "visible fraction V_f (0 to 1)",
            "fruits",
            "Share of a fruit that the camera sees, from 0 (wholly hidden) to 1",
        ),
        (
            "size",
            sides,
            np.geomspace(4, 400, 24),
            "size of visible boxes [px]",
            "fruits",
            "Size of the box round what is visible of a fruit, the root of its area, in px",
        ),
        ("per_image", per_image, counts, "visible fruits", "images", "Fruits that are visible in an image"),
    ]
    shown = []
    for name, values, bins, label, unit, caption in wanted:
        if not values:
            continue
        path = folder / f"histogram_{name}.png"
        with mpl.rc_context(PLOT_STYLE):
            canvas = Figure(figsize=PANEL)
            axes = canvas.subplots()
            axes.hist(values, bins=bins, color=LEAF)
            axes.set(xlabel=label, ylabel=unit, title=label[0].upper() + label[1:])
            axes.yaxis.set_major_locator(MaxNLocator(integer=True))
            if name == "size":
                axes.set_xscale("log")
            save_figure(canvas, path)
        shown.append(figure(path, f"{caption}; n = {len(values)} {unit}."))
    return shown


def _bands(fruits: Sequence[Instance]) -> str:
    known = np.array([i.visible_fraction for i in fruits if i.visible_fraction is not None])
    if not len(known):
        return ""
    bands = [(0.0, 0.01), (0.01, 0.3), (0.3, 0.7), (0.7, 0.95), (0.95, 1.001)]
    rows = [
        (f"{a:g} to {min(b, 1):g}", percent(float(np.mean((known >= a) & (known < b))))) for a, b in bands
    ]
    return section(f"How hidden, n = {len(known)} fruits", table(("V_f", "share of fruits"), rows))


def outlined(image: AnnotatedImage) -> NDArray[np.uint8]:
    """An image with the outlines of its visible fruits and, thin and white, of the whole ones. Shape (H, W, 3)."""
    picture = image.load().copy()
    for instance in image.instances:
        if not instance.fruit and instance.category != "robot":
            continue
        colour = COLOURS.get(instance.category, COLOURS["tomato_ripe"])
        if instance.amodal_mask is not None:
            _outline(picture, instance.amodal_mask.decode(), (255, 255, 255), 1)
        if instance.visible_mask is not None:
            _outline(picture, instance.visible_mask.decode(), colour, 2)
        elif instance.box_xywh[2] > 0:
            x, y, w, h = (round(v) for v in instance.box_xywh)
            cv2.rectangle(picture, (x, y), (x + w, y + h), colour, 2)
    return picture


def _outline(
    picture: NDArray[np.uint8], mask: NDArray[np.bool_], colour: tuple[int, int, int], width: int
) -> None:
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    cv2.drawContours(picture, contours, -1, colour, width)


def _spread(images: tuple[AnnotatedImage, ...], count: int) -> list[AnnotatedImage]:
    return [images[k] for k in np.unique(np.linspace(0, len(images) - 1, count).astype(int))]


def _side(box: tuple[float, float, float, float]) -> float:
    return float(np.sqrt(box[2] * box[3]))
