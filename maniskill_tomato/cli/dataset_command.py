"""The command `maniskill-tomato dataset`."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from maniskill_tomato.cli.early_checks import check_count, check_folder

# OpenCV, SAPIEN and PyTorch take seconds to import; the command imports what it needs when it runs.


@dataclass(frozen=True, kw_only=True)
class Dataset:
    """Render annotated images of tomato rows: COCO (visible and amodal), Pascal VOC, depth, a page of statistics."""

    out: Path = Path("runs/dataset")
    """Its folder. A data set that was stopped goes on there, and one with a larger --count grows."""
    count: int = 1000
    """Images, without the photos."""
    seed: int = 0
    """The same seed gives the same images."""
    split: Literal["train", "validation", "held_out"] = "train"
    """Whose plants; no plant is in two splits."""
    real: Path | None = None
    """A folder of annotated photos in COCO's or Pascal VOC's format to copy in."""
    real_split: str | None = None
    """Which list of them, such as train for train.txt; all by default."""
    width: int = 640
    """Of a rendered image, in [px]."""
    height: int = 480
    """Of a rendered image, in [px]."""
    vary_crop: bool = True
    """Cherry and beef tomatoes and other leaf densities too, instead of the tasks' own plants alone."""
    jobs: int | None = None
    """Processes; by default one per processor core."""

    def run(self) -> None:
        """Renders what is missing and says where it is."""
        check_folder("--real", self.real)
        check_count("--jobs", self.jobs)
        for flag, value in (("--count", self.count), ("--width", self.width), ("--height", self.height)):
            check_count(flag, value)

        from tqdm import tqdm

        from maniskill_tomato.segmentation.datasets.reading import read_annotated
        from maniskill_tomato.segmentation.synthesis.dataset_page import write_statistics
        from maniskill_tomato.segmentation.synthesis.dataset_rendering import DatasetConfig, make_dataset

        config = DatasetConfig(
            count=self.count,
            seed=self.seed,
            split=self.split,
            width=self.width,
            height=self.height,
            vary_crop=self.vary_crop,
        )
        photos = read_annotated(self.real, self.real_split) if self.real is not None else None
        if photos is not None and photos.skipped:
            print(f"left out of {self.real}: {photos.skipped_text()}")
        jobs = self.jobs or len(os.sched_getaffinity(0))
        with tqdm(total=self.count, unit="image", disable=None) as bar:
            images = make_dataset(config, self.out, jobs=jobs, real=photos, on_scene=bar.update)
        page = write_statistics(images, self.out)
        fruits = sum(len(image.fruits) for image in images.images)
        print(f"images {len(images.images)}, visible fruits {fruits}")
        print(f"COCO   {self.out / 'annotations.json'} and {self.out / 'annotations_amodal.json'}")
        print(f"VOC    {self.out / 'Annotations'}")
        print(f"page   {page}")
