"""A page about a data set: how many fruits, how hidden, how large, and sample images."""

from collections import Counter
from pathlib import Path
from typing import Any, Final

import cv2
import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.files import write_atomically
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


SHEET_IMAGES, SHEET_COLUMNS, SHEET_TILE = 24, 6, 320
"""Images on the contact sheet, images in a row, and width of each in [px]."""


def write_statistics(images: AnnotatedImages, folder: Path) -> Path:
    """Writes `statistics.md`, `statistics.png` and `contact_sheet.jpg` into a data set's folder.

    Returns:
        The page.
    """
    _write_plot(images, folder / "statistics.png")
    shown = [outlined(image) for image in _spread(images.images, SHEET_IMAGES)]
    # As high as the images need, up to a little more than a square.
    height = round(SHEET_TILE * min(max(i.shape[0] / i.shape[1] for i in shown), 1.25))
    sheet = contact_sheet(shown, SHEET_COLUMNS, (SHEET_TILE, height))
    write_picture(folder / "contact_sheet.jpg", sheet, 88)
    page = folder / "statistics.md"
    write_atomically(page, _page(images).encode())
    return page


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


def _fruits(images: AnnotatedImages) -> list[Instance]:
    return [i for image in images.images for i in image.instances if i.fruit]


def _side(box: tuple[float, float, float, float]) -> float:
    return float(np.sqrt(box[2] * box[3]))


def _write_plot(images: AnnotatedImages, path: Path) -> None:
    fruits = _fruits(images)
    fractions = [i.visible_fraction for i in fruits if i.visible_fraction is not None]
    sides = [_side(i.box_xywh) for i in fruits if i.box_xywh[2] > 0]
    per_image = [len(image.fruits) for image in images.images]
    figure, axes = plt.subplots(1, 4, figsize=(16, 3.4), constrained_layout=True)
    plots: list[tuple[list[Any], Any, str]] = [
        (fractions, np.linspace(0, 1, 21), "visible fraction $V_f$ of fruits"),
        (sides, np.geomspace(4, 400, 24), "size of visible boxes [px]"),
        (per_image, np.arange(0, max(per_image, default=1) + 2) - 0.5, "visible fruits in an image"),
    ]
    for axis, (values, bins, label) in zip(axes, plots, strict=False):
        axis.hist(values, bins=bins, color="#3a7d44")
        axis.set_xlabel(label)
    axes[1].set_xscale("log")
    counts = Counter(i.category for image in images.images for i in image.instances if i.box_xywh[2] > 0)
    axes[3].barh(list(counts), list(counts.values()), color="#3a7d44")
    axes[3].set_xlabel("visible instances")
    from io import BytesIO

    buffer = BytesIO()
    figure.savefig(buffer, dpi=90)
    plt.close(figure)
    write_atomically(path, buffer.getvalue())


def _page(images: AnnotatedImages) -> str:
    fruits = _fruits(images)
    seen = [i for i in fruits if i.box_xywh[2] > 0]
    known = np.array([i.visible_fraction for i in fruits if i.visible_fraction is not None])
    sides = np.array([_side(i.box_xywh) for i in seen]) if seen else np.zeros(1)
    counts = Counter(i.category for image in images.images for i in image.instances if i.box_xywh[2] > 0)
    lines = ["# Data set", "", f"{len(images.images)} images, {len(seen)} visible fruits."]
    if len(fruits) > len(seen):
        lines[-1] += (
            f" {len(fruits) - len(seen)} more fruits of the front row are wholly hidden (amodal file only)."
        )
    lines += ["", "![Images with the outlines of visible and, thin, whole fruits](contact_sheet.jpg)", ""]
    lines += ["![Histograms](statistics.png)", "", "| category | visible instances |", "|---|---|"]
    lines += [f"| {name} | {count} |" for name, count in sorted(counts.items())]
    low, middle, high = np.percentile(sides, [10, 50, 90])
    lines += ["", f"Size of a visible fruit's box (root of its area): median {middle:.0f} px, "]
    lines[-1] += f"10th and 90th percentile {low:.0f} and {high:.0f} px."
    if len(known):
        bands = [(0.0, 0.01), (0.01, 0.3), (0.3, 0.7), (0.7, 0.95), (0.95, 1.001)]
        lines += ["", "| V_f | share of fruits |", "|---|---|"]
        lines += [
            f"| {a:g} to {min(b, 1):g} | {100 * np.mean((known >= a) & (known < b)):.1f} % |"
            for a, b in bands
        ]
    if images.skipped:
        lines += ["", f"Left out of the photos: {images.skipped_text()}."]
    return "\n".join(lines) + "\n"
