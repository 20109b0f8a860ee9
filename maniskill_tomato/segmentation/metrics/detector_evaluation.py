"""Evaluation of a segmenter on annotated images: metrics, curves, pictures."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.segmentation.datasets.annotations import (
    BEHIND,
    PLANT_CATEGORIES,
    SMALLEST_SHARE,
    AnnotatedImage,
    is_fruit,
)
from maniskill_tomato.segmentation.datasets.picture_files import write_picture
from maniskill_tomato.segmentation.drawing import contact_sheet, draw_instances, mark_boxes
from maniskill_tomato.segmentation.instances import Image, Instances
from maniskill_tomato.segmentation.metrics.detection_metrics import (
    COCO_SIZES,
    DetectionScore,
    ImageTruth,
    Overlap,
    PrecisionRecall,
    image_truth,
    without_narrow,
)
from maniskill_tomato.segmentation.metrics.detection_plots import plot_overlaps, plot_precision_recall
from maniskill_tomato.segmentation.segmenter import Segmenter, ThingSegmenter

PICTURES = 16
"""Images on the sheet of results."""

WORKING_SCORE = 0.3
"""Score above which precision and recall are also given."""

SAME_FRUIT = 0.5
"""Intersection over union of two boxes from which on a detection is that fruit."""

WORST = 6
"""Pictures with the most errors that are kept."""


@dataclass(frozen=True, kw_only=True, eq=False)
class JudgedPicture:
    """What went wrong in an image above `WORKING_SCORE`, by boxes."""

    file_name: str
    fruits: int
    """That were to be found."""
    missed: int
    false: int
    """Detections that are no fruit, or one that another detection has found."""
    picture: Image
    """With what was found, and a frame round what was missed."""


@dataclass(frozen=True, kw_only=True)
class SegmenterEvaluation:
    """What `evaluate_segmenter` found."""

    metrics: dict[str, float]
    worst: tuple[JudgedPicture, ...]
    """Images with the most errors first; at most `WORST`."""


def evaluate_segmenter(
    segmenter: Segmenter,
    images: Sequence[AnnotatedImage],
    out: Path,
    smallest_share: float = SMALLEST_SHARE,
    on_image: Callable[[int], object] | None = None,
) -> SegmenterEvaluation:
    """Runs a segmenter over images and compares with their annotation; all fruits count, ripe or not.

    Writes `precision_recall.png` (Fig. 4-20, 4-24), `overlaps.png` (AP over the overlap, by size) and `pictures.jpg`
    (Fig. 4-21 to 4-27). Masks are compared if every image has them. Of a `ThingSegmenter` the other classes that are
    annotated are judged too; leaves and stems only in images that name some.

    Args:
        segmenter: What to judge.
        images: Annotated images.
        out: Folder of the figures.
        smallest_share: Rendered fruits narrower than this share of the image's longer side are set aside, and
            narrower detections where there is no other fruit.
        on_image: Called with 1 after every image.

    Returns:
        The worst images, and as metrics `box_AP50` and `mask_AP50` (Eq. 4-3 at an overlap of 0.5), precision and recall
        at `WORKING_SCORE`, COCO's metrics as `coco_box_...` and `coco_mask_...` (`COCO_NAMES`), counts, seconds an
        image; in rendered images with rows behind also `front_box_AP50`, `coco_front_box_...` and so on, of the fruits
        of the row in front alone; `leaf_things`, `leaf_box_AP50`, `coco_leaf_box_...` and so on of the other classes.

    Raises:
        InvalidInputError: There is no image, or one cannot be read.
        MissingPackageError: pycocotools is not installed.
    """
    if not images:
        raise InvalidInputError("there must be annotated images to evaluate on")
    sheet = set(np.linspace(0, len(images) - 1, min(PICTURES, len(images))).astype(int).tolist())
    drawn: list[Image] = []
    worst: list[JudgedPicture] = []
    with_masks = all(f.visible_mask is not None for image in images for f in image.fruits)
    overlaps: tuple[Overlap, ...] = ("box", "mask") if with_masks else ("box",)
    scores: dict[Overlap, DetectionScore] = {overlap: DetectionScore(overlap) for overlap in overlaps}
    with_rows = any((f.name or "").startswith(BEHIND) for image in images for f in image.fruits)
    front = {overlap: DetectionScore(overlap) for overlap in overlaps} if with_rows else {}
    others = {
        name: {o: DetectionScore(o) for o in kinds} for name, kinds in _other_classes(segmenter, images)
    }
    seconds = []
    for number, image in enumerate(images):
        picture = image.load()
        depth = image.load_depth()
        start = time.perf_counter()
        given = None if depth is None else depth.astype(np.float32)
        if isinstance(segmenter, ThingSegmenter):
            things = segmenter.things(picture, given)
            found = things.fruits()
        else:
            things = found = segmenter(picture, given)
        seconds.append(time.perf_counter() - start)
        for name, by_overlap in others.items():
            if name not in PLANT_CATEGORIES or image.named(*PLANT_CATEGORIES):
                own = things.chosen(np.array([category == name for category in things.categories], bool))
                for score in by_overlap.values():
                    score.add(own, image_truth(image, smallest_share, category=name))
        truth = image_truth(image, smallest_share)
        counted = without_narrow(found, truth)
        for score in scores.values():
            score.add(counted, truth)
        nearby = image_truth(image, smallest_share, rows_behind=False)
        for score in front.values():
            score.add(without_narrow(found, nearby), nearby)
        shown = draw_instances(picture, found, WORKING_SCORE)
        if number in sheet:
            drawn.append(shown)
        worst.append(_judged(image.file_name, shown, counted, truth))
        worst = sorted(worst, key=lambda judged: -(judged.missed + judged.false))[:WORST]
        if on_image is not None:
            on_image(1)
    metrics: dict[str, float] = {"images": len(images), "fruits": scores["box"].fruits}
    curves: dict[str, PrecisionRecall] = {}
    for overlap, score in scores.items():
        curve = score.precision_recall()
        precision, recall = curve.at_score(WORKING_SCORE)
        curves[overlap] = curve
        metrics |= {
            f"{overlap}_AP50": curve.average_precision,
            f"{overlap}_precision": precision,
            f"{overlap}_recall": recall,
        }
        metrics |= {f"coco_{overlap}_{k}": v for k, v in score.coco_metrics().items()}
    for overlap, score in front.items():
        metrics |= {
            "front_fruits": score.fruits,
            f"front_{overlap}_AP50": score.precision_recall().average_precision,
        }
        metrics |= {f"coco_front_{overlap}_{k}": v for k, v in score.coco_metrics().items()}
    for name, by_overlap in others.items():
        metrics[f"{name}_things"] = by_overlap["box"].fruits
        for overlap, score in by_overlap.items():
            metrics[f"{name}_{overlap}_AP50"] = score.precision_recall().average_precision
            metrics |= {f"coco_{name}_{overlap}_{k}": v for k, v in score.coco_metrics().items()}
    metrics["median_seconds"] = float(np.median(seconds))
    plot_precision_recall(curves, out / "precision_recall.png")
    plot_overlaps({k: score.precision_by_overlap() for k, score in scores.items()}, out / "overlaps.png")
    write_picture(out / "pictures.jpg", contact_sheet(drawn))
    return SegmenterEvaluation(metrics=metrics, worst=tuple(worst))


def _other_classes(
    segmenter: Segmenter, images: Sequence[AnnotatedImage]
) -> list[tuple[str, tuple[Overlap, ...]]]:
    """What a segmenter tells besides fruits and somebody annotated, and by what it can be compared."""
    told = segmenter.categories if isinstance(segmenter, ThingSegmenter) else ()
    found: list[tuple[str, tuple[Overlap, ...]]] = []
    for name in told:
        things = [] if is_fruit(name) else [thing for image in images for thing in image.named(name)]
        if things:
            masks = all(thing.visible_mask is not None for thing in things)
            found.append((name, ("box", "mask") if masks else ("box",)))
    return found


def chosen_images(images: Sequence[AnnotatedImage], limit: int | None) -> Sequence[AnnotatedImage]:
    """At most `limit` of the images, spread evenly."""
    if limit is None:
        return images
    return [images[i] for i in np.linspace(0, len(images) - 1, min(limit, len(images))).astype(int)]


def match_boxes(
    found: NDArray[np.floating[Any]], fruits: NDArray[np.floating[Any]]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which detections are a fruit each, and which fruits were found; each detection takes the one it overlaps most.

    Args:
        found: Boxes of detections, the surest first, as left, top, right, bottom in [px]. Shape (D, 4).
        fruits: Boxes of fruits. Shape (N, 4).

    Returns:
        Shapes (D,) and (N,).
    """
    from torchvision.ops import box_iou

    overlaps = box_iou(torch.as_tensor(found).double(), torch.as_tensor(fruits).double()).numpy()
    true, seen = np.zeros(len(found), bool), np.zeros(len(fruits), bool)
    for row, each in enumerate(overlaps):
        free = np.where(seen, 0.0, each)
        if len(free) and free.max() >= SAME_FRUIT:
            true[row] = seen[free.argmax()] = True
    return true, seen


def coco_cells(metrics: Mapping[str, float]) -> tuple[list[str], list[list[str]]]:
    """COCO's metrics of `evaluate_segmenter` as head and lines of a table: boxes, masks, front row, other classes."""
    columns = {"AP50": "AP50", "AP50-95": "AP", "AP75": "AP75", "AR": "AR100"}
    columns |= {f"{kind} {size}": f"{kind}_{size}" for size in COCO_SIZES for kind in ("AP", "AR")}
    rows = []
    for overlap in (key[5:-5] for key in metrics if key.startswith("coco_") and key.endswith("_AP50")):
        values = [metrics.get(f"coco_{overlap}_{key}") for key in columns.values()]
        if None not in values:
            # COCO gives -1 where there is no fruit of a size.
            shown = ["-" if value is None or value < 0 else f"{value:.3f}" for value in values]
            rows.append([overlap.replace("_", " "), *shown])
    return ["COCO", *columns], rows


def coco_table(metrics: Mapping[str, float]) -> str:
    """The table of `coco_cells` for the terminal."""
    head, rows = coco_cells(metrics)
    return "\n".join(
        f"{first:10}" + "".join(f"{text:>11}" for text in rest) for first, *rest in (head, *rows)
    )


def _judged(file_name: str, drawn: Image, found: Instances, truth: ImageTruth) -> JudgedPicture:
    """The errors of an image; what lies on a fruit that is set aside is none."""
    sure = found.scores >= WORKING_SCORE
    order = np.flatnonzero(sure)[np.argsort(-found.scores[sure], kind="stable")]
    boxes, fruits = found.boxes[order], truth.boxes[~truth.ignored]
    true, seen = match_boxes(boxes, fruits)
    aside, _ = match_boxes(boxes[~true], truth.boxes[truth.ignored])
    return JudgedPicture(
        file_name=file_name,
        fruits=len(fruits),
        missed=int((~seen).sum()),
        false=int((~aside).sum()),
        picture=mark_boxes(drawn, fruits[~seen], "missed"),
    )
