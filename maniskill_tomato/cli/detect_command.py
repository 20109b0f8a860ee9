"""`maniskill-tomato detect`: fruits in image files."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from maniskill_tomato.cli.early_checks import check_segmenter
from maniskill_tomato.errors import InvalidInputError


@dataclass(frozen=True, kw_only=True)
class Detect:
    """Find the tomatoes in images: a JSON list with box, score, category and mask of each."""

    images: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="IMAGE_OR_FOLDER")]
    """An image, or a folder of images."""
    segmenter: str = "light"
    """light, colour, mask_rcnn or yolo, or a file of weights; by default the weights that ship."""
    out: Path = Path("detections.json")
    """File of the list."""
    score_threshold: float = 0.05
    """Leave out what is less certain; 0.3 is a good compromise to look at, lower ones to compute average precision."""
    quick: bool = False
    """Let the light segmenter look at each image as often as a robot on its way does: 4.5 times as quick, fewer small
    fruits found."""
    pictures: Path | None = None
    """Also write each image with its fruits drawn over, into this folder."""

    def run(self) -> None:
        """Detects and says how many."""
        if not self.images.exists():
            raise InvalidInputError(f"IMAGE_OR_FOLDER: there is no image or folder {self.images}")
        check_segmenter("--segmenter", self.segmenter)
        if not 0 <= self.score_threshold <= 1:
            raise InvalidInputError(f"--score-threshold must be between 0 and 1, got {self.score_threshold}")

        from maniskill_tomato.segmentation.datasets.picture_files import write_picture
        from maniskill_tomato.segmentation.detection_list import detect, image_files
        from maniskill_tomato.segmentation.drawing import draw_instances
        from maniskill_tomato.segmentation.instances import Image, Instances
        from maniskill_tomato.segmentation.segmenter import open_for_files

        image_files(self.images)
        segmenter = open_for_files(self.segmenter, self.score_threshold, thorough=not self.quick)

        def draw(name: str, image: Image, found: Instances) -> None:
            if self.pictures is not None:
                write_picture(self.pictures / f"{Path(name).stem}.jpg", draw_instances(image, found, 0.3))

        summary = detect(self.images, segmenter, self.out, draw)
        for reason in summary.skipped[:10]:
            print(f"skipped {reason}")
        if len(summary.skipped) > 10:
            print(f"skipped {len(summary.skipped) - 10} more")
        fruits = "tomato" if summary.detections == 1 else "tomatoes"
        print(
            f"{summary.detections} {fruits} in {summary.images} images, {len(summary.skipped)} files skipped"
        )
        print(f"list {self.out}")
