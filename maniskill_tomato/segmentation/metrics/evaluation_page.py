"""The page of a segmenter's evaluation."""

from collections.abc import Mapping
from pathlib import Path
from typing import Final

from maniskill_tomato.report_design import (
    figure,
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
from maniskill_tomato.run_facts import run_facts
from maniskill_tomato.segmentation.metrics.detector_evaluation import (
    WORKING_SCORE,
    JudgedPicture,
    SegmenterEvaluation,
    coco_cells,
)

PICTURE_WIDTH: Final = 640
"""Of a picture on the page, in [px]."""

WORDS: Final = (
    "A fruit counts as found if a detection overlaps it enough. The overlap is the shared area as a share of the area "
    "that either covers, from 0 to 1, of boxes or of masks. Precision is the share of detections that are fruits; "
    "recall is the share of fruits that were found. Both depend on the score from which on a detection counts. AP "
    "(average precision) is the area under the curve of precision over recall, so that it needs no such score."
)

COCO_WORDS: Final = (
    "From 0 to 1, more is better; - where there is no fruit of a size. AP50 and AP75 ask for an overlap of 0.5 and "
    "0.75; AP50-95 is the mean over 0.5, 0.55, ... 0.95. AR is the mean recall over the same overlaps. Small fruits "
    "have an area below 32 x 32 px, large ones above 96 x 96 px."
)

FRONT_WORDS: Final = " Lines that begin with front count only the fruits of the row in front of the camera."

OTHER_WORDS: Final = " Lines and columns of a leaf, a stem or a robot count these instead of fruits."

NAMES: Final = {
    "AP50": "AP at an overlap of 0.5 (0 to 1)",
    "precision": f"precision above a score of {WORKING_SCORE:g} (0 to 1)",
    "recall": f"recall above a score of {WORKING_SCORE:g} (0 to 1)",
}


def write_evaluation_page(judged: SegmenterEvaluation, out: Path, described: Mapping[str, str]) -> Path:
    """Writes report.html beside the pictures of `evaluate_segmenter`.

    Args:
        judged: What that gives.
        out: Its folder.
        described: What was evaluated, and on what: `segmenter`, `data`.

    Returns:
        The page.
    """
    metrics = judged.metrics
    images, fruits = int(metrics["images"]), int(metrics["fruits"])
    of = f"n = {fruits} fruits in {images} images"
    best = "mask" if "mask_AP50" in metrics else "box"
    head, rows = coco_cells(metrics)
    return report(
        out,
        f"Segmenter {described['segmenter']}",
        f"{described['data']}: {images} images, {fruits} fruits",
        [
            tiles(
                tile(f"{metrics[f'{best}_AP50']:.3f}", f"AP of {_plural(best)}, overlap 0.5 (0 to 1)", of),
                tile(
                    percent(metrics[f"{best}_precision"]),
                    "precision",
                    f"above a score of {WORKING_SCORE:g}, by {_plural(best)}",
                    of,
                ),
                tile(
                    percent(metrics[f"{best}_recall"]),
                    "recall",
                    f"above a score of {WORKING_SCORE:g}, by {_plural(best)}",
                    of,
                ),
                tile(
                    f"{1e3 * metrics['median_seconds']:.0f} ms",
                    "an image, median wall time",
                    f"n = {images} images",
                ),
            ),
            section("What the figures mean", paragraph(WORDS)),
            section(
                f"Pictures with the most errors, {len(judged.worst)} of n = {images} images",
                paragraph(
                    f"Each detection above a score of {WORKING_SCORE:g} has its mask or box, and its score. A white "
                    "frame with the word missed is a fruit that no detection shares half of its box with. False "
                    "detections are no fruit, or one that was found already. Fruits that are too small to count are "
                    "neither. pictures.jpg beside this page shows images from the whole list."
                ),
                side_by_side(*map(_picture, judged.worst)),
            ),
            section(
                "Curves",
                side_by_side(
                    figure(out / "precision_recall.png", f"Precision over recall (0 to 1 each); {of}."),
                    figure(
                        out / "overlaps.png",
                        f"AP (0 to 1) over the overlap from which on a fruit counts as found, by size; {of}.",
                    ),
                ),
            ),
            section(
                f"AP and recall by size, as COCO defines them, {of}",
                table(head, rows),
                paragraph(
                    COCO_WORDS
                    + (FRONT_WORDS if "front_fruits" in metrics else "")
                    + (OTHER_WORDS if _other_classes(metrics) else ""),
                    "caption",
                ),
            ),
            section(f"At an overlap of 0.5, {of}", table(*_plain(metrics))),
        ],
        {**described, **run_facts()},
    )


def _plain(metrics: Mapping[str, float]) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Head and lines of a table of the thesis's figures, a column for boxes and one for masks."""
    kinds = [
        kind
        for of in ("", "front_", *(f"{name}_" for name in _other_classes(metrics)))
        for kind in (f"{of}box", f"{of}mask")
        if f"{kind}_AP50" in metrics
    ]
    head = ("figure", *(_plural(kind).replace("_", " ") for kind in kinds))
    rows = [
        (text, *("" if (v := metrics.get(f"{kind}_{name}")) is None else f"{v:.4f}" for kind in kinds))
        for name, text in NAMES.items()
    ]
    counted = {"front": "front_fruits", **{name: f"{name}_things" for name in _other_classes(metrics)}}
    if any(key in metrics for key in counted.values()):
        of = [counted.get(kind.split("_")[0], "fruits") for kind in kinds]
        rows.append(("how many", *(str(int(metrics[key])) for key in of)))
    return head, rows


def _other_classes(metrics: Mapping[str, float]) -> list[str]:
    """Classes besides fruits that were judged."""
    return [key.removesuffix("_things") for key in metrics if key.endswith("_things")]


def _picture(judged: JudgedPicture) -> str:
    return pixels(
        judged.picture,
        f"{judged.file_name}: {judged.missed} of {judged.fruits} fruits missed, {judged.false} false",
        PICTURE_WIDTH,
    )


def _plural(overlap: str) -> str:
    return f"{overlap}es" if overlap.endswith("x") else f"{overlap}s"
