"""Mask R-CNN, YOLO's files and the two commands, on drawn pictures."""

import json
import re
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from maniskill_tomato.cli import main
from maniskill_tomato.errors import CheckpointError, InvalidInputError
from maniskill_tomato.segmentation.datasets.annotations import AnnotatedImage, AnnotatedImages, Instance
from maniskill_tomato.segmentation.datasets.coco import write_coco
from maniskill_tomato.segmentation.detector_configs import MASK_RCNN_PRESETS
from maniskill_tomato.segmentation.efficientnet_lite import EfficientNetLite0
from maniskill_tomato.segmentation.instances import Instances, box_ellipse, mask_box
from maniskill_tomato.segmentation.mask_rcnn import Lite0Pyramid
from maniskill_tomato.segmentation.masks import EncodedMask
from maniskill_tomato.segmentation.metrics.detector_evaluation import coco_table, evaluate_segmenter
from maniskill_tomato.segmentation.segmenter import make_segmenter
from maniskill_tomato.segmentation.training.mask_rcnn_training import MaskRcnnTraining, mask_rcnn_target
from maniskill_tomato.segmentation.training.training_pictures import TrainingImages, training_picture
from maniskill_tomato.segmentation.training.yolo_training import (
    YOLO_SETTINGS,
    read_history,
    train_yolo,
    write_yolo_data,
    yolo_labels,
)

TINY = replace(
    MASK_RCNN_PRESETS["light-lite0"],
    epochs=2,
    steps_per_epoch=1,
    batch_size=1,
    longest_side=96,
    shortest_side=96,
    least_confidence=0.0,
    dropout=0.3,
)


def drawn_set(folder: Path, masks: bool = True) -> tuple[AnnotatedImage, ...]:
    """Three images of two red ellipses each, on files below `folder`."""
    rng = np.random.default_rng(0)
    images = []
    (folder / "images").mkdir(parents=True)
    for number in range(3):
        picture = np.full((96, 128, 3), (60, 140, 50), np.uint8)
        fruits = []
        for x in (32, 96):
            radius, y = rng.uniform(14, 24), rng.uniform(30, 66)
            mask = box_ellipse(
                np.array([x - radius, y - radius, x + radius, y + radius], np.float32), 96, 128
            )
            picture[mask] = (205, 40, 30)
            left, top, right, bottom = mask_box(mask)
            fruits.append(
                Instance(
                    category="tomato_ripe",
                    box_xywh=(left, top, right - left, bottom - top),
                    visible_mask=EncodedMask.encode(mask) if masks else None,
                )
            )
        name = f"images/{number}.png"
        cv2.imwrite(str(folder / name), picture[..., ::-1])
        images.append(
            AnnotatedImage(path=folder / name, file_name=name, width=128, height=96, instances=tuple(fruits))
        )
    write_coco(AnnotatedImages(images=tuple(images)), folder)
    return tuple(images)


def test_mask_rcnn_trains_goes_on_and_opens_as_a_segmenter(tmp_path: Path) -> None:
    images = drawn_set(tmp_path / "set")
    training = MaskRcnnTraining(TINY, TrainingImages(sets=[images], validation=images[:1]))
    before = {n: p.detach().clone() for n, p in training.network.named_parameters()}
    assert training.run(tmp_path / "run", lambda line: None, lambda: training.step == 1) is None
    again = MaskRcnnTraining(TINY, TrainingImages(sets=[images], validation=images[:1]))
    again.resume(tmp_path / "run")
    weights = again.run(tmp_path / "run", lambda line: None)
    assert weights is not None
    line = json.loads((tmp_path / "run" / "history.json").read_text())[-1]
    terms = {"loss_classifier", "loss_box_reg", "loss_mask", "loss_objectness", "loss_rpn_box_reg"}
    assert terms | {f"val_{term}" for term in terms} <= set(line)
    assert line["loss"] == pytest.approx(sum(line[term] for term in terms), rel=1e-5)
    moved = [n for n, p in again.network.named_parameters() if not torch.equal(p, before[n])]
    assert any("mask" in name for name in moved) and any("rpn" in name for name in moved)
    found = make_segmenter(weights, score_threshold=0.0)(images[0].load())
    assert found.masks.shape[1:] == (96, 128)
    assert set(found.categories) <= {"tomato"}


def test_mask_rcnn_on_imagenet_weights_leaves_its_first_layers_alone(tmp_path: Path) -> None:
    images = drawn_set(tmp_path / "set")
    config = replace(
        MASK_RCNN_PRESETS["light-lite0"],
        longest_side=96,
        shortest_side=96,
        steps_per_epoch=1,
        epochs=1,
        batch_size=1,
    )
    training = MaskRcnnTraining(config, TrainingImages(sets=[images]), pretrained=True)
    start = EfficientNetLite0()
    start.load_imagenet()
    weights = training.run(tmp_path / "run", lambda line: None)
    pyramid = training.network.backbone
    assert isinstance(pyramid, Lite0Pyramid)
    body = pyramid.body.state_dict()
    for name, before in start.state_dict().items():
        fixed = name.startswith(("stem", *(f"blocks.{i}." for i in range(6)))) or "running" in name
        fixed |= "tracked" in name
        assert torch.equal(body[name], before) == fixed, name
    assert weights is not None and make_segmenter(weights)(images[0].load()).masks.shape[1:] == (96, 128)


def test_a_picture_without_masks_does_not_train_the_mask_head(tmp_path: Path) -> None:
    images = drawn_set(tmp_path / "set", masks=False)
    training = MaskRcnnTraining(TINY, TrainingImages(sets=[images]))
    before = {n: p.detach().clone() for n, p in training.network.named_parameters() if "mask" in n}
    terms = training.train_step()
    assert terms["loss_mask"] == 0 and terms["loss_objectness"] > 0
    for name, parameter in training.network.named_parameters():
        if name in before and "bias" not in name:
            # Weight decay alone.
            decay = 1 - TINY.learning_rate(1) * TINY.weight_decay
            torch.testing.assert_close(parameter.detach(), before[name] * decay)


def test_the_target_of_mask_rcnn_leaves_out_fruits_set_aside(tmp_path: Path) -> None:
    (image, *_) = drawn_set(tmp_path / "set")
    picture = replace(training_picture(image), ignored=np.array([True, False]))
    target = mask_rcnn_target(picture, ("tomato", "robot"))
    assert target["boxes"].shape == (1, 4) and target["labels"].tolist() == [1]
    rows, columns = np.nonzero(target["masks"][0].numpy())
    expected = target["boxes"][0].tolist()
    assert [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1] == expected


def with_robot(image: AnnotatedImage) -> AnnotatedImage:
    """The image with a robot in its uppermost ten rows, which no ellipse reaches, and a leaf beside it."""
    arm, leaf = np.zeros((2, image.height, image.width), bool)
    arm[:10, 20:90] = True
    leaf[:10, :20] = True
    things = [
        Instance(category=name, box_xywh=box, visible_mask=EncodedMask.encode(mask))
        for name, box, mask in (
            ("leaf", (0.0, 0.0, 20.0, 10.0), leaf),
            ("robot", (20.0, 0.0, 70.0, 10.0), arm),
        )
    ]
    return replace(image, instances=(things[0], *image.instances, things[1]))


def test_the_robot_is_a_class_of_mask_rcnn_with_its_box_and_mask(tmp_path: Path) -> None:
    image = with_robot(drawn_set(tmp_path / "set")[0])
    target = mask_rcnn_target(training_picture(image, ["robot"]), ("tomato", "robot"))
    assert target["labels"].tolist() == [1, 1, 2]
    assert target["boxes"][2].tolist() == [20, 0, 90, 10]
    assert target["masks"][2].sum() == 700 and target["masks"][2, :10, 20:90].all()
    # Detectors of fruits alone are told of fruits alone.
    assert len(training_picture(image).boxes) == 2
    with_leaves = mask_rcnn_target(training_picture(image, ["leaf"]), ("tomato", "leaf"))
    assert with_leaves["labels"].tolist() == [1, 1, 2]


def test_mask_rcnn_learns_the_robot_where_pictures_show_it(tmp_path: Path) -> None:
    images = [with_robot(image) for image in drawn_set(tmp_path / "set")]
    training = MaskRcnnTraining(TINY, TrainingImages(sets=[images], validation=images[:1]))
    assert training.images.drawn(np.random.default_rng(0)).categories.tolist() == [0, 0, 5]  # type: ignore[union-attr]
    (checked,) = next(iter(training.validation_batches()))
    assert len(checked.boxes) == 3
    with pytest.raises(InvalidInputError, match="kettle"):
        MaskRcnnTraining(replace(TINY, categories=("tomato", "kettle")), TrainingImages(sets=[images]))


def test_pictures_without_masks_leave_the_masks_of_others_in_their_batch_to_be_learned(
    tmp_path: Path,
) -> None:
    (drawn, *_) = drawn_set(tmp_path / "set")
    (boxed, *_) = drawn_set(tmp_path / "boxes", masks=False)
    training = MaskRcnnTraining(replace(TINY, batch_size=2), TrainingImages(sets=[[drawn], [boxed]]))
    pictures = [training_picture(drawn), training_picture(boxed)]
    terms = training.losses(training.network.train(), pictures)
    assert terms["loss_mask"] > 0
    torch.manual_seed(1)
    alone = training.losses(training.network, pictures[:1])
    torch.manual_seed(1)
    beside = training.losses(training.network, pictures)
    # The picture with masks comes first, so that it draws the same regions; it is half of the batch.
    torch.testing.assert_close(beside["loss_mask"], alone["loss_mask"] / 2)
    assert beside["loss_box_reg"] > alone["loss_box_reg"] / 2


def test_yolo_labels_are_shares_of_the_image(tmp_path: Path) -> None:
    fruit = Instance(category="tomato", box_xywh=(10.0, 20.0, 30.0, 40.0))
    leaf = Instance(category="leaf", box_xywh=(0.0, 0.0, 50.0, 50.0))
    image = AnnotatedImage(
        path=tmp_path / "a.png", file_name="a.png", width=100, height=200, instances=(fruit, leaf)
    )
    assert yolo_labels(image) == "0 0.250000 0.200000 0.300000 0.200000\n"
    # 3 px are narrower than what is asked for.
    tiny = Instance(category="tomato", box_xywh=(10.0, 20.0, 3.0, 40.0))
    assert yolo_labels(replace(image, instances=(tiny, leaf))) == ""
    images = drawn_set(tmp_path / "set")
    data = write_yolo_data(images[:2], images[2:], tmp_path / "yolo")
    assert "val: images/val" in data.read_text()
    assert len(list((tmp_path / "yolo" / "labels" / "train").iterdir())) == 2
    assert (tmp_path / "yolo" / "images" / "val" / "000000.png").is_file()


def test_yolo_losses_are_read_as_those_of_the_others(tmp_path: Path) -> None:
    path = tmp_path / "results.csv"
    path.write_text(
        "epoch,time,train/box_loss,train/cls_loss,metrics/mAP50(B),val/box_loss,val/cls_loss\n"
        "1,240.4,3.8,3.6,0,4.1,3.9\n2,460.4,3.1,2.8,0.01,3.5,3.3\n"
    )
    assert read_history(path) == [
        {"step": 1, "box_loss": 3.8, "cls_loss": 3.6, "val_box_loss": 4.1, "val_cls_loss": 3.9},
        {"step": 2, "box_loss": 3.1, "cls_loss": 2.8, "val_box_loss": 3.5, "val_cls_loss": 3.3},
    ]
    path.write_text("epoch,train/box_loss\n1,none\n")
    with pytest.raises(CheckpointError, match="no list of losses"):
        read_history(path)


def test_yolo_is_trained_by_its_library_and_its_best_weights_and_losses_are_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: dict[str, object] = {}

    class Library:
        """What is asked of Ultralytics, and the files that it leaves."""

        def __init__(self, model: str) -> None:
            asked["model"] = model

        def train(self, **settings: object) -> None:
            asked.update(settings)
            folder = Path(str(settings["project"])) / str(settings["name"])
            (folder / "weights").mkdir(parents=True)
            (folder / "weights" / "best.pt").write_bytes(b"best")
            (folder / "results.csv").write_text("epoch,train/box_loss,val/box_loss\n1,3.8,4.1\n2,3.1,3.5\n")

    monkeypatch.setitem(sys.modules, "ultralytics", SimpleNamespace(YOLO=Library))
    images = drawn_set(tmp_path / "set")
    of_both = TrainingImages(sets=[images[:1], images[1:2]], validation=images[2:])
    weights = train_yolo(of_both, tmp_path / "run", YOLO_SETTINGS["thesis"], "yolov3.yaml", seed=4)
    assert weights.read_bytes() == b"best"
    assert asked["model"] == "yolov3.yaml" and asked["seed"] == 4
    assert YOLO_SETTINGS["thesis"].items() <= asked.items()
    data = Path(str(asked["data"])).parent
    assert len(list((data / "labels" / "train").iterdir())) == 2
    assert len(list((data / "labels" / "val").iterdir())) == 1
    assert (tmp_path / "run" / "losses.png").is_file() and (tmp_path / "run" / "yolo.json").is_file()


def test_the_training_command_writes_weights_and_curves(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    drawn_set(tmp_path / "set")
    network = ("--network.neck-width", "8", "--augmentation.size", "64")
    options = ("--steps", "2", "--log-every", "1", "--batch-size", "2", *network)
    arguments = ["light", "--data", str(tmp_path / "set"), "--validation", str(tmp_path / "set"), *options]
    main(["train-segmenter", *arguments, "--out", str(tmp_path / "run")])
    assert "weights" in capsys.readouterr().out
    assert {p.name for p in (tmp_path / "run").iterdir()} == {
        "checkpoint.pt",
        "history.json",
        "losses.png",
        "weights.pt",
    }
    with pytest.raises(SystemExit) as exit_info:
        main(["train-segmenter", "light", "--data", str(tmp_path / "nowhere")])
    assert exit_info.value.code == 2 and "--data: there is no folder" in capsys.readouterr().err


def test_judging_finds_a_perfect_segmenter_perfect(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    drawn_set(tmp_path / "set")
    main(
        [
            "judge",
            "segmenter",
            "--data",
            str(tmp_path / "set"),
            "--segmenter",
            "colour",
            "--out",
            str(tmp_path / "out"),
        ]
    )
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["fruits"] == 6 and metrics["box_AP50"] == 1 and metrics["mask_AP50"] == 1
    assert metrics["coco_mask_AP50"] == pytest.approx(1)
    assert metrics["coco_box_AP"] == metrics["coco_box_AR100"] == pytest.approx(1)
    for name in ("precision_recall.png", "overlaps.png"):
        picture = cv2.imread(str(tmp_path / "out" / name))
        assert picture is not None and picture.std() > 5
    assert (tmp_path / "out" / "pictures.jpg").is_file()
    out = capsys.readouterr().out
    assert "box_AP50" in out
    header, *rows = out[out.index("COCO ") :].splitlines()[:3]
    assert re.split(r"  +", header)[1:5] == ["AP50", "AP50-95", "AP75", "AR"]
    assert [row.split()[:5] for row in rows] == [[kind, *["1.000"] * 4] for kind in ("box", "mask")]


def test_of_the_row_in_front_ap_over_all_overlaps_and_ar_are_told_too(tmp_path: Path) -> None:
    def right_one_behind(image: AnnotatedImage) -> AnnotatedImage:
        left, right = image.instances
        return replace(image, instances=(left, replace(right, name="behind_1_0/fruit")))

    class FindsTheLeftHalf:
        """Of the three images the first two, and of these the left fruit."""

        def __init__(self) -> None:
            self.images = 0

        def __call__(self, image: NDArray[np.uint8], depth_m: NDArray[np.float32] | None = None) -> Instances:
            self.images += 1
            mask = image[..., 0] > 180
            mask[:, 64:] = False
            if self.images > 2:
                return Instances.empty(*mask.shape)
            return Instances(
                boxes=np.array([mask_box(mask)], np.float32),
                scores=np.array([0.9], np.float32),
                categories=("tomato_ripe",),
                masks=mask[None],
            )

    images = [right_one_behind(image) for image in drawn_set(tmp_path / "set")]
    done: list[int] = []
    evaluation = evaluate_segmenter(FindsTheLeftHalf(), images, tmp_path / "out", on_image=done.append)
    metrics = evaluation.metrics
    assert done == [1, 1, 1]
    # The third image, of which nothing was found, comes first.
    errors = [(judged.file_name, judged.fruits, judged.missed, judged.false) for judged in evaluation.worst]
    assert errors == [(images[k].file_name, 2, missed, 0) for k, missed in ((2, 2), (0, 1), (1, 1))]
    # Two of the three in front, two of all six, each with an overlap of 1.
    assert metrics["front_fruits"] == 3
    assert metrics["coco_front_box_AR100"] == metrics["coco_front_mask_AR100"] == pytest.approx(2 / 3)
    assert metrics["coco_front_box_AP"] == pytest.approx(2 / 3, abs=0.01)
    assert metrics["coco_box_AR100"] == pytest.approx(1 / 3)
    kinds = [row.split("  ")[0] for row in coco_table(metrics).splitlines()[1:]]
    assert kinds == ["box", "mask", "front box", "front mask"]
