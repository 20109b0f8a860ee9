"""`maniskill-tomato dataset` and `detect`: images and the fruits in them."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import tyro

from maniskill_tomato.cli.early_checks import check_counts, check_folder, check_place, check_segmenter
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.ray_jobs import jobs_on_ray


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
    plants: Path | None = None
    """Mesh file or folder whose plants of the split stand in front, each alone, instead of our own rows."""
    robot_share: float = 0.12
    """Share of the scenes in which another arm works; only some of their images show it."""
    jobs: int | None = None
    """Processes; by default one per processor core."""
    ray: bool = False
    """Do the work on a Ray cluster (extra `ray`): the one at RAY_ADDRESS, else one of this machine's cores."""

    def run(self) -> None:
        """Renders what is missing and says where it is."""
        check_folder("--real", self.real)
        check_counts(jobs=self.jobs, count=self.count, width=self.width, height=self.height)

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
            plants=None if self.plants is None else str(self.plants),
            robot_share=self.robot_share,
        )
        photos = read_annotated(self.real, self.real_split) if self.real is not None else None
        if photos is not None and photos.skipped:
            print(f"left out of {self.real}: {photos.skipped_text()}")
        jobs = self.jobs or len(os.sched_getaffinity(0))
        with jobs_on_ray(self.ray), tqdm(total=self.count, unit="image", disable=None) as bar:
            images = make_dataset(config, self.out, jobs=jobs, real=photos, on_scene=bar.update)
        page = write_statistics(images, self.out)
        fruits = sum(len(image.fruits) for image in images.images)
        print(f"images {len(images.images)}, visible fruits {fruits}")
        print(f"COCO   {self.out / 'annotations.json'} and {self.out / 'annotations_amodal.json'}")
        print(f"VOC    {self.out / 'Annotations'}")
        print(f"report {page}")


@dataclass(frozen=True, kw_only=True)
class ComposeDataset:
    """Draw rendered images and photos into the thesis's training, validation and test sets.

    Trainings and `judge segmenter` take them as OUT:train, OUT:validation and OUT:test.
    """

    preset: Literal["strategy-1", "strategy-2", "strategy-3", "yolo"] = "strategy-1"
    """Whose numbers of images: those of a Mask R-CNN strategy, or YOLO's photos. The sets of one seed contain each
    other, and the test images are the same for all strategies."""
    rendered: tuple[str, ...] = ()
    """Folder of `maniskill-tomato dataset`: one for all sets, or one each for training, validation and test."""
    photos: tuple[str, ...] = ()
    """Folder of photos in COCO's or Pascal VOC's format, or FOLDER:SPLIT for one list of it; one, or three as above.
    Their boxes are taken, and no masks."""
    train: tuple[int, int] | None = None
    """How many rendered images and photos to train on, if not the thesis's."""
    validation: tuple[int, int] | None = None
    """The same to validate on."""
    test: tuple[int, int] | None = None
    """The same to test on."""
    seed: int = 0
    """Draws the images."""
    out: Path = Path("runs/composed")
    """Folder of the images and of a COCO file for each set."""

    def run(self) -> None:
        """Draws, copies and says how many images each set has."""
        for name, places in (("--rendered", self.rendered), ("--photos", self.photos)):
            for place in places:
                check_place(name, place)

        from maniskill_tomato.segmentation.datasets.composition import PARTS, Counts, Part, compose

        asked: dict[Part, tuple[int, int] | None] = {
            "train": self.train,
            "validation": self.validation,
            "test": self.test,
        }
        counts: dict[Part, Counts] = {
            part: Counts(rendered=n[0], photos=n[1]) for part, n in asked.items() if n is not None
        }
        found = compose(self.preset, self.rendered, self.photos, self.out, seed=self.seed, counts=counts)
        for part in PARTS:
            images = found[part].images
            rendered = sum(any(i.visible_mask is not None for i in image.instances) for image in images)
            robots = sum(any(i.category == "robot" for i in image.instances) for image in images)
            fruits = sum(len(image.fruits) for image in images)
            print(
                f"{self.out}:{part}: {len(images)} images, {rendered} of them with masks, {robots} with the robot; "
                f"{fruits} visible fruits"
            )


@dataclass(frozen=True, kw_only=True)
class Detect:
    """Find the tomatoes in images: a JSON list with box, score, category and mask of each."""

    images: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="IMAGE_OR_FOLDER")]
    """An image, or a folder of images."""
    segmenter: str = "light"
    """light, colour, mask_rcnn or yolo, or a file of weights; by default the weights that ship."""
    out: Path = Path("detections.json")
    """File of the list."""
    writes_file: ClassVar = True
    score_threshold: float = 0.05
    """Leave out what is less certain; 0.3 is a good compromise to look at, lower ones to compute average precision."""
    quick: bool = False
    """Let the light segmenter look at each image as often as a robot on its way does: 4.5 times as quick, fewer small
    fruits found."""
    everything: bool = False
    """List leaves, stems and the robot too; for weights of Mask R-CNN that were trained on these classes."""
    pictures: Path | None = None
    """Also write each image with its fruits drawn over, into this folder."""

    def run(self) -> None:
        """Detects and says how many."""
        if not self.images.exists():
            raise InvalidInputError(f"IMAGE_OR_FOLDER: there is no image or folder {self.images}")
        check_segmenter("--segmenter", self.segmenter)
        if not 0 <= self.score_threshold <= 1:
            raise InvalidInputError(f"--score-threshold must be between 0 and 1, got {self.score_threshold}")

        from maniskill_tomato.files import refuse_inputs
        from maniskill_tomato.segmentation.datasets.picture_files import write_picture
        from maniskill_tomato.segmentation.detection_list import detect, drawing_files, image_files
        from maniskill_tomato.segmentation.drawing import draw_instances
        from maniskill_tomato.segmentation.instances import Image, Instances
        from maniskill_tomato.segmentation.segmenter import open_for_files

        image_files(self.images)
        refuse_inputs("--out", self.out, [Path(self.segmenter)])
        drawings = {} if self.pictures is None else drawing_files(self.images, self.pictures)
        segmenter = open_for_files(self.segmenter, self.score_threshold, thorough=not self.quick)

        def draw(name: str, image: Image, found: Instances) -> None:
            if name in drawings:
                write_picture(drawings[name], draw_instances(image, found, 0.3))

        summary = detect(self.images, segmenter, self.out, draw, self.everything)
        for reason in summary.skipped[:10]:
            print(f"skipped {reason}")
        if len(summary.skipped) > 10:
            print(f"skipped {len(summary.skipped) - 10} more")
        fruits = "tomato" if summary.detections == 1 else "tomatoes"
        others = f" and {summary.others} other things" if self.everything else ""
        print(
            f"{summary.detections} {fruits}{others} in {summary.images} images, {len(summary.skipped)} files skipped"
        )
        print(f"list {self.out}")
