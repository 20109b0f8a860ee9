"""Leaves, stems and the robot beside the fruits: learned, told, judged and listed."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from maniskill_tomato.cli import main
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.segmentation.colour_segmenter import ColourSegmenter
from maniskill_tomato.segmentation.datasets.annotations import AnnotatedImage, AnnotatedImages, Instance
from maniskill_tomato.segmentation.datasets.coco import write_coco
from maniskill_tomato.segmentation.detector_configs import MASK_RCNN_PRESETS, MaskRcnnConfig
from maniskill_tomato.segmentation.instances import Instances
from maniskill_tomato.segmentation.mask_rcnn import MaskRcnnSegmenter, build_mask_rcnn
from maniskill_tomato.segmentation.masks import Box, EncodedMask
from maniskill_tomato.segmentation.metrics.detector_evaluation import coco_cells, evaluate_segmenter
from maniskill_tomato.segmentation.metrics.evaluation_page import write_evaluation_page
from maniskill_tomato.segmentation.training.mask_rcnn_training import MaskRcnnTraining, mask_rcnn_target
from maniskill_tomato.segmentation.training.training_pictures import TrainingImages

CLASSES = ("tomato", "robot", "leaf", "stem")

TINY = replace(
    MASK_RCNN_PRESETS["light-lite0"],
    epochs=1,
    steps_per_epoch=1,
    batch_size=1,
    longest_side=96,
    shortest_side=96,
    least_confidence=0.0,
    categories=CLASSES,
    bfloat16=False,
)

PLANT: tuple[tuple[str, Box, tuple[int, int, int]], ...] = (
    ("tomato_ripe", (10.0, 40.0, 30.0, 30.0), (205, 40, 30)),
    ("leaf", (50.0, 10.0, 40.0, 30.0), (30, 120, 30)),
    ("leaf", (50.0, 50.0, 40.0, 40.0), (60, 150, 60)),
    ("stem", (100.0, 0.0, 10.0, 96.0), (120, 140, 40)),
)
"""Category, box in [px] and colour of what a drawn picture shows."""


def drawn(folder: Path, name: str, named: tuple[str, ...]) -> AnnotatedImage:
    """A picture of `PLANT` in which only things of some categories are annotated."""
    picture = np.full((96, 128, 3), 210, np.uint8)
    instances = []
    for category, (x, y, w, h), colour in PLANT:
        mask = np.zeros((96, 128), bool)
        mask[int(y) : int(y + h), int(x) : int(x + w)] = True
        picture[mask] = colour
        if category in named:
            instances.append(
                Instance(category=category, box_xywh=(x, y, w, h), visible_mask=EncodedMask.encode(mask))
            )
    (folder / "images").mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(folder / name), picture[..., ::-1])
    return AnnotatedImage(
        path=folder / name, file_name=name, width=128, height=96, instances=tuple(instances)
    )


def plant_and_photo(folder: Path) -> list[AnnotatedImage]:
    """A picture with everything annotated, and one with the fruit alone."""
    images = [
        drawn(folder, "images/plant.png", ("tomato_ripe", "leaf", "stem")),
        drawn(folder, "images/photo.png", ("tomato_ripe",)),
    ]
    write_coco(AnnotatedImages(images=tuple(images)), folder)
    return images


def test_pictures_that_do_not_say_where_leaves_are_teach_nothing_about_them(tmp_path: Path) -> None:
    plant, photo = plant_and_photo(tmp_path)
    training = MaskRcnnTraining(TINY, TrainingImages(sets=[[photo, plant]], validation=[photo, plant]))
    assert training.images.sets == [(plant,)] and training.images.validation == (plant,)
    target = mask_rcnn_target(training.images.drawn(np.random.default_rng(0)), CLASSES)
    assert target["labels"].tolist() == [1, 3, 3, 4]
    assert [int(mask.sum()) for mask in target["masks"]] == [int(w * h) for _, (_, _, w, h), _ in PLANT]
    with pytest.raises(
        InvalidInputError, match=r"none of the 1 images in set 2 of 2 has a leaf.*rendered images"
    ):
        MaskRcnnTraining(TINY, TrainingImages(sets=[[plant], [photo]]))
    # Who learns fruits and the robot alone learns from photos too.
    fruits = MaskRcnnTraining(
        replace(TINY, categories=("tomato", "robot")), TrainingImages(sets=[[photo, plant]])
    )
    assert fruits.images.sets == [[photo, plant]]


def test_a_set_with_leaves_but_no_stem_cannot_teach_stems(tmp_path: Path) -> None:
    image = drawn(tmp_path, "images/leaves.png", ("tomato_ripe", "leaf"))
    with pytest.raises(InvalidInputError, match="has a stem annotated"):
        MaskRcnnTraining(TINY, TrainingImages(sets=[[image]]))
    leaves = replace(TINY, categories=("tomato", "leaf"))
    assert MaskRcnnTraining(leaves, TrainingImages(sets=[[image]])).images.sets == [(image,)]


@pytest.mark.parametrize("classes", [("leaf", "stem"), ("tomato", "leaf", "leaf"), ()])
def test_classes_are_different_ones_with_the_tomato(classes: tuple[str, ...]) -> None:
    with pytest.raises(InvalidInputError, match="classes must be"):
        MaskRcnnConfig(categories=classes)


def test_mask_rcnn_tells_all_classes_and_as_a_segmenter_of_fruits_the_fruits_alone() -> None:
    picture = np.random.default_rng(0).integers(0, 255, (96, 128, 3)).astype(np.uint8)
    segmenter = MaskRcnnSegmenter(build_mask_rcnn(TINY), CLASSES)
    things, fruits = segmenter.things(picture), segmenter(picture)
    assert set(things.categories) > {"tomato"} and set(things.categories) <= set(CLASSES)
    of_fruits = [k for k, name in enumerate(things.categories) if name == "tomato"]
    assert set(fruits.categories) == {"tomato"} and len(fruits) == len(of_fruits)
    np.testing.assert_array_equal(fruits.masks, things.masks[of_fruits])


class FindsTheFirstOfEach:
    """Of every picture of `PLANT` the fruit and the upper leaf, and a stem where there is none."""

    categories = CLASSES

    def things(self, image: NDArray[np.uint8], depth_m: NDArray[np.float32] | None = None) -> Instances:
        masks = np.zeros((3, *image.shape[:2]), bool)
        masks[0, 40:70, 10:40] = masks[1, 10:40, 50:90] = masks[2, :20, :10] = True
        return Instances.from_masks(masks, categories=("tomato", "leaf", "stem"))

    def __call__(self, image: NDArray[np.uint8], depth_m: NDArray[np.float32] | None = None) -> Instances:
        return self.things(image, depth_m).fruits()


def test_every_class_is_judged_by_itself_and_leaves_only_where_they_are_annotated(tmp_path: Path) -> None:
    plant, photo = plant_and_photo(tmp_path)
    judged = evaluate_segmenter(FindsTheFirstOfEach(), [plant, photo], tmp_path / "out")
    metrics = judged.metrics
    assert metrics["fruits"] == 2 and metrics["box_AP50"] == metrics["mask_AP50"] == 1
    # One of two leaves with an overlap of 1. The leaf that is found in the photo is no error, as nobody says where
    # leaves are.
    assert metrics["leaf_things"] == 2
    assert metrics["leaf_box_AP50"] == metrics["leaf_mask_AP50"] == metrics["coco_leaf_mask_AR100"] == 0.5
    assert metrics["stem_things"] == 1 and metrics["stem_box_AP50"] == 0
    # Nobody annotated a robot.
    assert not any("robot" in name for name in metrics)
    head, rows = coco_cells(metrics)
    assert [row[0] for row in rows] == ["box", "mask", "leaf box", "leaf mask", "stem box", "stem mask"]
    page = write_evaluation_page(judged, tmp_path / "out", {"segmenter": "test", "data": "drawn"}).read_text()
    assert "leaf masks" in page and "count these instead of fruits" in page
    fruits_alone = evaluate_segmenter(ColourSegmenter(), [plant], tmp_path / "alone")
    assert not any("leaf" in name for name in fruits_alone.metrics)


def test_the_commands_train_classes_and_list_what_was_found(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plant_and_photo(tmp_path / "set")
    options = ["--input-scale", "0.2", "--epochs", "1", "--steps-per-epoch", "1", "--step-scale", "0.01"]
    options += ["--bfloat16", "False", "--out", str(tmp_path / "run")]
    data = ["--data", str(tmp_path / "set")]
    main(["train-segmenter", "mask-rcnn", "--classes", *CLASSES, *options, *data])
    assert "1 of 2 images name no leaf or stem, left out" in capsys.readouterr().out
    weights, images, out = (
        tmp_path / "run" / "weights.pt",
        tmp_path / "set" / "images",
        tmp_path / "list.json",
    )
    detect = ["detect", str(images), "--segmenter", str(weights), "--score-threshold", "0", "--out", str(out)]
    main([*detect, "--everything"])
    listed = {entry["category"] for entry in json.loads(out.read_text())}
    assert (
        listed <= set(CLASSES)
        and listed - {"tomato"}
        and "other things in 2 images" in capsys.readouterr().out
    )
    main(detect)
    assert {entry["category"] for entry in json.loads(out.read_text())} <= {"tomato"}
    with pytest.raises(SystemExit):
        main(["detect", str(images), "--segmenter", "colour", "--everything", "--out", str(out)])
    assert "--everything needs a segmenter that tells more than fruits" in capsys.readouterr().err
