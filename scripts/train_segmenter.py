"""Trains the light segmenter on annotated images (COCO or Pascal VOC); a training that was stopped goes on.

Example:
    python scripts/train_segmenter.py --data data/train real_photos:train --shares 0.6 0.4 \\
        --validation real_photos:val --out runs/segmenter
"""

import logging
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

import tyro

from maniskill_tomato.errors import TomatoError
from maniskill_tomato.learning.interrupt import stop_on_signals
from maniskill_tomato.perception.annotations import AnnotatedImage
from maniskill_tomato.perception.light_training import CHECKPOINT, LightTrainConfig, LightTraining
from maniskill_tomato.perception.training_pictures import read_place


@dataclass(frozen=True, kw_only=True)
class Args:
    """Options."""

    data: tuple[str, ...]
    """Folders of annotated images, or FOLDER:SPLIT for one list of a folder (`photos:train` for its train.txt)."""
    shares: tuple[float, ...] = ()
    """How often each folder is drawn from; by default all alike."""
    validation: str | None = None
    """Images whose losses are logged too, in the same form."""
    limit: int | None = None
    """Use only this many images of each folder, the first of its list."""
    out: Path = Path("runs/segmenter")
    """Folder of the training; one that holds a training of the same settings goes on."""
    start_from: Path | None = None
    """Weights to begin with instead of random ones."""
    config: LightTrainConfig = field(default_factory=LightTrainConfig)
    """How to train."""


def read_images(place: str, limit: int | None = None) -> tuple[AnnotatedImage, ...]:
    """The first images of FOLDER or FOLDER:SPLIT; what is left out is named on standard error."""
    found = read_place(place)
    if found.skipped:
        print(f"{place}: {found.skipped_text()}", file=sys.stderr)
    return found.images[:limit]


def main(argv: list[str] | None = None) -> None:
    """Trains; errors made on purpose end with one line and exit status 2."""
    logging.basicConfig(level=logging.WARNING, format="%(message)s", stream=sys.stderr)
    start = time.perf_counter()
    try:
        args = tyro.cli(Args, args=argv, description=__doc__)
        sets = [read_images(place, args.limit) for place in args.data]
        training = LightTraining(
            args.config,
            sets,
            args.shares or (1.0,) * len(sets),
            read_images(args.validation) if args.validation else (),
            args.start_from,
        )
        if (args.out / CHECKPOINT).is_file():
            training.resume(args.out)
        with stop_on_signals() as request:
            path = training.run(
                args.out, lambda line: print(line, flush=True), lambda: request.reason is not None
            )
    except TomatoError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    took = f"after {time.perf_counter() - start:.0f} s"
    print(f"weights {path} {took}" if path else f"stopped {took}; the same command goes on")


if __name__ == "__main__":
    main()
