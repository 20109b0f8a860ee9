"""The page of a segmenter's evaluation."""

from collections.abc import Mapping
from pathlib import Path

from maniskill_tomato.report_design import (
    figure,
    paragraph,
    percent,
    report,
    section,
    side_by_side,
    table,
    tile,
    tiles,
)
from maniskill_tomato.run_facts import run_facts
from maniskill_tomato.segmentation.metrics.detector_evaluation import PICTURES, WORKING_SCORE, coco_cells


def write_evaluation_page(metrics: Mapping[str, float], out: Path, described: Mapping[str, str]) -> Path:
    """Writes report.html beside the pictures of `evaluate_segmenter`.

    Args:
        metrics: What that gives.
        out: Its folder.
        described: What was evaluated, and on what: `segmenter`, `data`.

    Returns:
        The page.
    """
    images, fruits = int(metrics["images"]), int(metrics["fruits"])
    of = f"n = {fruits} fruits in {images} images"
    best = "mask" if "mask_AP50" in metrics else "box"
    head, rows = coco_cells(metrics)
    plain = [
        (name.replace("_", " "), f"{value:.4g}")
        for name, value in metrics.items()
        if not name.startswith("coco_") and name not in ("images", "fruits")
    ]
    return report(
        out,
        f"Segmenter {described['segmenter']}",
        f"{described['data']}: {images} images, {fruits} fruits",
        [
            tiles(
                tile(
                    f"{metrics[f'{best}_AP50']:.3f}",
                    f"AP of {best}es at an overlap of 0.5 (0 to 1)".replace("maskes", "masks"),
                    of,
                ),
                tile(
                    percent(metrics[f"{best}_precision"]), f"precision above a score of {WORKING_SCORE:g}", of
                ),
                tile(percent(metrics[f"{best}_recall"]), f"recall above a score of {WORKING_SCORE:g}", of),
                tile(
                    f"{1e3 * metrics['median_seconds']:.0f} ms",
                    "an image, median wall time",
                    f"n = {images} images",
                ),
            ),
            section(
                "Curves",
                side_by_side(
                    figure(out / "precision_recall.png", f"Precision over recall (0 to 1 each); {of}."),
                    figure(
                        out / "overlaps.png",
                        f"AP (0 to 1) over the overlap that is asked for, by size; {of}.",
                    ),
                ),
            ),
            section(
                "Pictures",
                figure(
                    out / "pictures.jpg",
                    f"What was found above a score of {WORKING_SCORE:g}; {min(PICTURES, images)} of n = {images} "
                    "images.",
                ),
            ),
            section(
                f"COCO's metrics, {of}",
                table(head, rows),
                paragraph("From 0 to 1; - where there is no fruit of a size.", "caption"),
            ),
            section(f"Figures, {of}", table(("figure", "value"), plain)),
        ],
        {**described, **run_facts()},
    )
