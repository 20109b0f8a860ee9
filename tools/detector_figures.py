"""Draws the trainings of the thesis's detectors beside each other, and counts their AP (Eq. 4-3).

Each training is a folder of `maniskill-tomato train-segmenter` with the folder of `compose-dataset` that it learned
from. Written are the losses (Fig. 4-9 to 4-19), precision over recall in the test images (Fig. 4-5, 4-20, 4-24), and
detections in images of the training, validation and test sets (Fig. 4-21 to 4-23, 4-25 to 4-27).

Usage:
    python tools/detector_figures.py --trainings runs/strategy-1 runs/strategy-2 \
        --data data/strategy-1 data/strategy-2 --out docs/images
"""

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
import tyro

from maniskill_tomato.errors import InvalidInputError, TomatoError
from maniskill_tomato.segmentation.datasets.annotations import AnnotatedImage
from maniskill_tomato.segmentation.datasets.picture_files import write_picture
from maniskill_tomato.segmentation.datasets.reading import read_place
from maniskill_tomato.segmentation.drawing import contact_sheet, draw_instances
from maniskill_tomato.segmentation.metrics.detection_metrics import (
    DetectionScore,
    Overlap,
    PrecisionRecall,
    image_truth,
    without_narrow,
)
from maniskill_tomato.segmentation.metrics.detection_plots import plot_losses, plot_precision_recall
from maniskill_tomato.segmentation.segmenter import Segmenter, open_for_files

SETS = ("train", "validation", "test")
CONFIDENT = 0.5
"""The thesis's least confidence (Table 4-2)."""

LEAST_SCORE = 0.02
"""Of what counts otherwise, as in `maniskill-tomato judge segmenter`."""


@dataclass(frozen=True, kw_only=True)
class Args:
    """Which trainings, what they learned from, and where the pictures go."""

    trainings: tuple[Path, ...]
    """Folders of the trainings; a row of pictures each."""
    data: tuple[Path, ...]
    """Folder of `compose-dataset` of each."""
    out: Path = Path("docs/images")
    """Folder of `detector_losses.png`, `detector_precision.png` and `detector_pictures.jpg`."""
    pictures: int = 2
    """Images of each set that are drawn."""
    photos: bool = False
    """Whether every second one of them is a photo."""


def test_curve(
    segmenter: Segmenter, images: Sequence[AnnotatedImage], overlap: Overlap
) -> PrecisionRecall | None:
    """Precision and recall in images; None where no image tells what is compared."""
    score = DetectionScore(overlap)
    chosen = [image for image in images if overlap == "box" or has_masks(image)]
    for image in chosen:
        truth = image_truth(image)
        score.add(without_narrow(segmenter(image.load()), truth), truth)
    return score.precision_recall() if chosen else None


def confident_part(curve: PrecisionRecall) -> PrecisionRecall:
    """Precision and recall of the detections with the thesis's least confidence or more."""
    count = int((curve.scores >= CONFIDENT).sum())
    return replace(
        curve, scores=curve.scores[:count], precision=curve.precision[:count], recall=curve.recall[:count]
    )


def has_masks(image: AnnotatedImage) -> bool:
    """Whether all fruits of an image have one, and there is a fruit."""
    return bool(image.fruits) and all(fruit.visible_mask is not None for fruit in image.fruits)


def some(images: Sequence[AnnotatedImage], count: int, photos: bool) -> list[AnnotatedImage]:
    """Rendered images, or these and photos in turn, evenly from the whole set."""
    kinds = [[i for i in images if has_masks(i)], [i for i in images if photos and not has_masks(i)]]
    kinds = [kind for kind in kinds if kind]
    chosen = []
    for number in range(count):
        kind = kinds[number % len(kinds)]
        chosen.append(kind[(2 * number + 1) * len(kind) // (2 * count) % len(kind)])
    return chosen


def main(args: Args) -> None:
    """Writes the pictures and prints a row for each training."""
    if len(args.data) != len(args.trainings):
        raise InvalidInputError(
            f"--data must name a folder for each of the {len(args.trainings)} trainings, got {len(args.data)}"
        )
    torch.set_num_threads(1)
    histories = {folder.name: json.loads((folder / "history.json").read_bytes()) for folder in args.trainings}
    plot_losses(histories, args.out / "detector_losses.png")
    curves: dict[str, PrecisionRecall] = {}
    drawn = []
    head = "boxes", f"boxes, {CONFIDENT} or more", "masks", f"masks, {CONFIDENT} or more"
    print(f"| training | test images, with masks | {' | '.join(head)} |\n|{'---|' * (2 + len(head))}")
    for folder, data in zip(args.trainings, args.data, strict=True):
        segmenter = open_for_files(str(folder / "weights.pt"), LEAST_SCORE, False)
        test = read_place(f"{data}:test").images
        found = [test_curve(segmenter, test, overlap) for overlap in ("box", "mask")]
        counted = [part for curve in found for part in (curve, curve and confident_part(curve))]
        precisions = " | ".join("-" if one is None else f"{one.average_precision:.4f}" for one in counted)
        print(f"| {folder.name} | {len(test)}, {sum(map(has_masks, test))} | {precisions} |", flush=True)
        if found[0] is not None:
            curves[folder.name] = found[0]
        for name in SETS:
            for image in some(read_place(f"{data}:{name}").images, args.pictures, args.photos):
                picture = image.load()
                drawn.append(draw_instances(picture, segmenter(picture), CONFIDENT))
    plot_precision_recall(curves, args.out / "detector_precision.png")
    sheet = contact_sheet(drawn, columns=len(SETS) * args.pictures, tile=(320, 240))
    write_picture(args.out / "detector_pictures.jpg", sheet)


if __name__ == "__main__":
    try:
        main(tyro.cli(Args, description=__doc__))
    except TomatoError as error:
        sys.exit(f"error: {error}")
