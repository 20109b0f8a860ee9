"""Measures what tells touching tomatoes apart best in the occlusion models, on a rendered data set.

Each line is a model with one way to divide what holds several tomatoes: a watershed, a linear or a polynomial
classifier. Fruits whose visible pixels come within a few pixels of another's are counted by themselves too.

Example:
    python tools/measure_touching.py --data runs/validation --limit 48
"""

import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import tyro
from numpy.typing import NDArray

from maniskill_tomato.experiments.occlusion_scores import Judged, annotated_fruits, make_view, score
from maniskill_tomato.report_design import markdown_table
from maniskill_tomato.segmentation.datasets.reading import read_annotated
from maniskill_tomato.segmentation.masks import BinaryMask
from maniskill_tomato.segmentation.metrics.detector_evaluation import chosen_images
from maniskill_tomato.sensing.visible_fraction.estimate import OcclusionModel
from maniskill_tomato.sensing.visible_fraction.improved import ImprovedConfig, ImprovedModel
from maniskill_tomato.sensing.visible_fraction.separation import Separation
from maniskill_tomato.sensing.visible_fraction.thesis import ThesisConfig, ThesisModel

WAYS: tuple[Separation, ...] = ("watershed", "linear", "polynomial")

LEAF_THRESHOLD = 10
"""As in the other measurements of the thesis's model on rendered images, whose background is not grey."""

NEAR_PX = 3
"""Masks that are not farther apart touch, in [px]."""

LEAST_PIXELS = 100
LEAST_WHOLE_PIXELS = 400


@dataclass(frozen=True, kw_only=True)
class Args:
    """What to measure on."""

    data: Path
    """A folder of `maniskill-tomato dataset`."""
    limit: int | None = None
    """Only so many images, spread evenly."""


def main(args: Args) -> None:
    """Prints a table."""
    models: dict[str, OcclusionModel] = {
        "thesis, undivided": ThesisModel(ThesisConfig(leaf_threshold=LEAF_THRESHOLD))
    }
    for way in WAYS:
        config = ThesisConfig(leaf_threshold=LEAF_THRESHOLD, separation=way)
        models[f"thesis, {way}"] = ThesisModel(config)
    models |= {f"improved, {way}": ImprovedModel(ImprovedConfig(separation=way)) for way in WAYS}
    judged: list[tuple[Judged, bool]] = []
    seconds = dict.fromkeys(models, 0.0)
    images = chosen_images(read_annotated(args.data).images, args.limit)
    count = 0
    for image in images:
        fruits = annotated_fruits(image)
        view = make_view(image, fruits)
        if view is None or not fruits:
            continue
        count += 1
        near = touching(view.masks)
        for name, model in models.items():
            start = time.process_time()
            estimates = model(view)
            seconds[name] += time.process_time() - start
            for fruit, estimate, is_near in zip(fruits, estimates, near, strict=True):
                truth, mask = fruit.visible_fraction, fruit.visible_mask
                if truth is None or mask is None or fruit.category != "tomato_ripe":
                    continue
                if mask.area >= max(LEAST_PIXELS, LEAST_WHOLE_PIXELS * truth):
                    one = Judged(
                        model=name,
                        file_name=image.file_name,
                        category=fruit.category,
                        visible_px=mask.area,
                        truth=truth,
                        estimate=estimate.visible_fraction,
                    )
                    judged.append((one, bool(is_near)))
    rows = []
    for name in models:
        cells = []
        for of in ([one for one, _ in judged], [one for one, is_near in judged if is_near]):
            found = score([one for one in of if one.model == name])
            cells += [str(found.count), f"{found.mae:.3f}", f"{found.bias:+.3f}", str(found.failures)]
        rows.append((name, *cells, f"{1000 * seconds[name] / max(count, 1):.0f}"))
    head = ("model", *("fruits", "MAE", "bias", "failures"), *("touching", "MAE", "bias", "failures"))
    print(f"{count} images of {args.data}, tomato_ripe, true masks\n")
    print(markdown_table((*head, "CPU ms an image"), rows))


def touching(masks: tuple[BinaryMask, ...]) -> NDArray[np.bool_]:
    """Which masks come within `NEAR_PX` of another. Shape (N,)."""
    kernel = np.ones((2 * NEAR_PX + 1, 2 * NEAR_PX + 1), np.uint8)
    covered = np.sum(np.array(masks, np.int32), axis=0)
    return np.array(
        [bool((covered - mask)[cv2.dilate(mask.astype(np.uint8), kernel) > 0].any()) for mask in masks]
    )


if __name__ == "__main__":
    main(tyro.cli(Args))
