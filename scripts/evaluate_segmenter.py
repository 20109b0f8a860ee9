"""Evaluates a segmenter on annotated images: precision, recall, AP (Eq. 4-1 to 4-3), COCO's AP, curves and pictures.

Example:
    python scripts/evaluate_segmenter.py --data real_photos:val --segmenter runs/segmenter/weights.pt --out runs/judged
"""

import json
import logging
import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

from maniskill_tomato.errors import TomatoError
from maniskill_tomato.files import write_atomically
from maniskill_tomato.segmentation.datasets.annotations import SMALLEST_SHARE
from maniskill_tomato.segmentation.datasets.reading import read_place
from maniskill_tomato.segmentation.metrics.detector_evaluation import evaluate_segmenter
from maniskill_tomato.segmentation.segmenter import open_for_files


@dataclass(frozen=True, kw_only=True)
class Args:
    """Options."""

    data: str
    """Folder of annotated images, or FOLDER:SPLIT for one list of it (`photos:val` for its val.txt)."""
    segmenter: str = "light"
    """Name of a segmenter, or a file of weights."""
    thorough: bool = False
    """Let the light segmenter look at each image as often as `maniskill-tomato detect` does."""
    limit: int | None = None
    """Look at this many images only, spread over the list."""
    smallest_share: float = SMALLEST_SHARE
    """Rendered fruits narrower than this share of the image's longer side are set aside; 0: the tiniest alone."""
    out: Path = Path("runs/segmenter-evaluation")
    """Folder of metrics.json, precision_recall.png and pictures.jpg."""


def main(argv: list[str] | None = None) -> None:
    """Evaluates; errors made on purpose end with one line and exit status 2."""
    logging.basicConfig(level=logging.WARNING, format="%(message)s", stream=sys.stderr)
    try:
        args = tyro.cli(Args, args=argv, description=__doc__)
        segmenter = open_for_files(args.segmenter, 0.02, args.thorough)
        found = read_place(args.data)
        if found.skipped:
            print(f"{args.data}: {found.skipped_text()}", file=sys.stderr)
        metrics = evaluate_segmenter(segmenter, found.images, args.out, args.limit, args.smallest_share)
        write_atomically(
            args.out / "metrics.json",
            json.dumps(
                {"segmenter": args.segmenter, "thorough": args.thorough, "data": args.data, **metrics},
                indent=1,
            ).encode(),
        )
    except TomatoError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    for name, value in metrics.items():
        print(f"{name:24} {value:.4g}")


if __name__ == "__main__":
    main()
