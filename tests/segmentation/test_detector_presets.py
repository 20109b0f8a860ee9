"""The thesis's settings, number by number, and that the networks are built with them."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.segmentation.datasets.annotations import AnnotatedImage, Instance
from maniskill_tomato.segmentation.detector_configs import (
    MASK_RCNN_PRESETS,
    ClassicAugmentation,
    MaskRcnnConfig,
)
from maniskill_tomato.segmentation.training.anchors import anchor_sides, clustered_sizes, shape_overlaps
from maniskill_tomato.segmentation.training.augmentation import (
    brighter,
    classic_augmentation,
    contrasted,
)
from maniskill_tomato.segmentation.training.training_pictures import TrainingPicture
from maniskill_tomato.segmentation.training.yolo_training import YOLO_SETTINGS
from maniskill_tomato.segmentation.yolo import NMS_THRESHOLD, OBJECT_THRESHOLD

torchvision = pytest.importorskip("torchvision")


@pytest.mark.parametrize("name", ["strategy-1", "strategy-2", "strategy-3"])
def test_common_settings_are_those_of_table_4_2(name: str) -> None:
    config = MASK_RCNN_PRESETS[name]
    assert config.backbone == "resnet101"
    assert config.batch_size == 1
    assert config.momentum == 0.9
    assert config.weight_decay == 0.0001
    assert config.longest_side == 1024
    assert config.shortest_side == 800
    assert config.least_confidence == 0.5
    assert config.categories == ("tomato", "robot")


def test_strategy_1_is_table_4_3() -> None:
    config = MASK_RCNN_PRESETS["strategy-1"]
    assert (config.epochs, config.steps_per_epoch, config.validation_steps) == (80, 600, 100)
    assert config.anchor_sides == (32, 64, 128, 256, 512)
    assert config.proposal_nms == 0.7
    assert config.dropout == 0
    assert {config.learning_rate(epoch) for epoch in range(1, 81)} == {0.001}
    assert config.augmentation == ClassicAugmentation(
        probability=0.75, flip=True, blur_sigma=2.5, brightness=(0.8, 1.5), contrast=None
    )


def test_strategy_2_is_table_4_4() -> None:
    config = MASK_RCNN_PRESETS["strategy-2"]
    assert (config.epochs, config.steps_per_epoch, config.validation_steps) == (65, 1000, 120)
    assert config.anchor_sides == (16, 64, 128, 256, 512)
    assert config.proposal_nms == 0.7
    assert config.rois_per_image == 200
    assert config.dropout == 0.3
    rates = [config.learning_rate(epoch) for epoch in range(1, 66)]
    assert rates == [0.001] * 20 + [0.0001] * 45
    assert config.augmentation == ClassicAugmentation(
        probability=0.8, flip=True, blur_sigma=2.5, brightness=(0.7, 1.3), contrast=(0.6, 1.4)
    )


def test_strategy_3_is_the_proposal_of_section_6_2() -> None:
    config = MASK_RCNN_PRESETS["strategy-3"]
    assert (config.epochs, config.steps_per_epoch, config.validation_steps) == (80, 1000, 200)
    assert config.anchor_sides == MASK_RCNN_PRESETS["strategy-2"].anchor_sides
    assert config.augmentation == MASK_RCNN_PRESETS["strategy-2"].augmentation
    assert config.proposal_nms == 0.5
    assert config.rois_per_image == 300
    assert config.dropout == 0.5
    rates = [config.learning_rate(epoch) for epoch in range(1, 81)]
    assert rates == [0.001] * 10 + [0.0001] * 30 + [0.00001] * 40


def test_yolo_is_table_4_1() -> None:
    settings = YOLO_SETTINGS["thesis"]
    assert (settings["epochs"], settings["batch"], settings["lr0"], settings["patience"]) == (100, 1, 1e-4, 3)
    # 288 to 448 px: 368 px on average, and 80 px to either side.
    assert settings["imgsz"] == 368 and settings["multi_scale"] * 368 == pytest.approx(80)
    assert (OBJECT_THRESHOLD, NMS_THRESHOLD) == (0.5, 0.45)
    assert not settings["pretrained"]
    # "The absence of image augmentation" (4-2-2): what Ultralytics documents as augmentation of detection.
    for name in (
        *("hsv_h", "hsv_s", "hsv_v", "bgr", "degrees", "translate", "scale", "shear", "perspective"),
        *("flipud", "fliplr", "mosaic", "mixup", "cutmix", "copy_paste"),
    ):
        assert settings[name] == 0, name
    assert settings["augmentations"] == []


def test_stock_yolo_is_what_the_library_does_by_itself() -> None:
    stock = YOLO_SETTINGS["stock"]
    assert (stock["epochs"], stock["imgsz"]) == (100, 448)
    assert "lr0" not in stock and "mosaic" not in stock and not stock["pretrained"]


def test_a_scaled_training_keeps_its_schedule_and_the_anchors_size_over_the_picture() -> None:
    whole = MASK_RCNN_PRESETS["strategy-2"]
    small = whole.scaled(steps=0.01, size=0.5)
    assert (small.epochs, small.steps_per_epoch, small.validation_steps) == (65, 10, 1)
    assert (small.longest_side, small.shortest_side) == (512, 400)
    assert small.anchor_sides == (8, 32, 64, 128, 256)
    same = ("learning_rates", "dropout", "proposal_nms", "rois_per_image", "augmentation", "batch_size")
    assert [getattr(small, name) for name in same] == [getattr(whole, name) for name in same]
    assert whole.scaled() == whole
    assert whole.scaled(rates=5).learning_rates == ((1, 5e-3), (21, 5e-4))
    for rate in (0.5, 20.0):
        with pytest.raises(InvalidInputError, match="learning rates must be from 1 to 10"):
            whole.scaled(rates=rate)
    for factor in (0.0, 1.5):
        with pytest.raises(InvalidInputError, match="above 0 and at most 1"):
            whole.scaled(steps=factor)


def test_clusters_of_boxes_are_the_sizes_that_the_boxes_have() -> None:
    rng = np.random.default_rng(0)
    true = np.array([[10, 12], [30, 25], [60, 80], [150, 140], [300, 320]], float)
    sizes = np.concatenate([size * rng.uniform(0.95, 1.05, (40, 2)) for size in true])
    found = clustered_sizes(rng.permutation(sizes), 5)
    np.testing.assert_allclose(found, true, rtol=0.02)
    overlaps = shape_overlaps(np.array([[10.0, 10.0]]), np.array([[20.0, 5.0], [10.0, 10.0]]))
    # 10 x 5 px are common to a square of 100 px and a box of 100 px.
    np.testing.assert_allclose(overlaps, [[50 / 150, 1.0]])
    with pytest.raises(InvalidInputError, match="at least 5 boxes"):
        clustered_sizes(np.array([[10, 10]] * 20), 5)


def test_anchors_from_data_are_in_pixels_of_the_networks_input(tmp_path: Path) -> None:
    sides = (20.0, 40.0, 60.0, 120.0, 240.0)
    fruits = tuple(Instance(category="tomato", box_xywh=(0.0, 0.0, side, side)) for side in sides)
    leaf = Instance(category="leaf", box_xywh=(0.0, 0.0, 300.0, 300.0))
    tiny = Instance(category="tomato", box_xywh=(0.0, 0.0, 3.0, 3.0))
    image = AnnotatedImage(
        path=tmp_path / "a.png", file_name="a.png", width=640, height=480, instances=(*fruits, leaf, tiny)
    )
    config = MASK_RCNN_PRESETS["strategy-1"]
    # 480 px become 768, because 640 may not become more than 1024.
    assert anchor_sides([image], config) == tuple(round(1.6 * side) for side in sides)
    assert anchor_sides([image], config.scaled(size=0.5)) == tuple(round(0.8 * side) for side in sides)
    alike = tuple(Instance(category="tomato", box_xywh=(0.0, 0.0, 20 + k / 100, 20.0)) for k in range(9))
    with pytest.raises(InvalidInputError, match="too alike"):
        anchor_sides([replace(image, instances=alike)], config)


def test_settings_that_cannot_be_are_refused() -> None:
    with pytest.raises(InvalidInputError, match="dropout"):
        MaskRcnnConfig(dropout=1.0)
    with pytest.raises(InvalidInputError, match="epoch 1"):
        MaskRcnnConfig(learning_rates=((2, 1e-3),))
    with pytest.raises(InvalidInputError, match="anchor_sides"):
        MaskRcnnConfig(anchor_sides=(32, 64))
    with pytest.raises(InvalidInputError, match="probability"):
        ClassicAugmentation(probability=1.5)


def test_the_network_is_built_with_the_settings() -> None:
    from maniskill_tomato.segmentation.mask_rcnn import build_mask_rcnn

    config = replace(MASK_RCNN_PRESETS["strategy-3"], backbone="efficientnet_lite0")
    network: Any = build_mask_rcnn(config)
    assert [sizes[0] for sizes in network.rpn.anchor_generator.sizes] == [16, 64, 128, 256, 512]
    assert network.rpn.nms_thresh == 0.5
    assert network.roi_heads.fg_bg_sampler.batch_size_per_image == 300
    assert network.roi_heads.score_thresh == 0.5
    dropped = [m.p for m in network.roi_heads.box_head.modules() if isinstance(m, torch.nn.Dropout)]
    assert dropped == [0.5, 0.5]
    assert network.roi_heads.box_predictor.cls_score.out_features == 3
    images, _ = network.transform([torch.zeros(3, 480, 640)])
    assert images.tensors.shape[2:] == (1024, 1024)
    assert images.image_sizes == [(768, 1024)]


def half_and_half() -> TrainingPicture:
    """Dark on the left, bright on the right, with a fruit on the left."""
    image = np.full((40, 60, 3), 50, np.uint8)
    image[:, 30:] = 200
    labels = np.zeros((40, 60), np.int16)
    labels[10:20, 5:15] = 1
    return TrainingPicture(
        image=image,
        boxes=np.array([[5, 10, 15, 20]], np.float32),
        ignored=np.zeros(1, bool),
        labels=labels,
        whole_boxes=np.array([[2, 8, 18, 22]], np.float32),
    )


def test_brightness_and_contrast_follow_their_formulas() -> None:
    image = half_and_half().image
    assert brighter(image, 1.2)[0, 0, 0] == 60
    assert brighter(image, 1.5)[0, -1, 0] == 255
    assert contrasted(image, 0.6)[0, 0, 0] == int(127 + 0.6 * (50 - 127))
    assert contrasted(image, 1.4)[0, -1, 0] == int(127 + 1.4 * (200 - 127))


def test_each_change_comes_as_often_as_the_thesis_says_and_the_annotation_follows() -> None:
    config = MASK_RCNN_PRESETS["strategy-2"].augmentation
    picture, rng = half_and_half(), np.random.default_rng(0)
    unchanged = flipped = 0
    for _ in range(2000):
        changed = classic_augmentation(picture, config, rng)
        assert changed.labels is not None and changed.whole_boxes is not None
        left, top, right, bottom = changed.boxes[0].astype(int)
        assert (changed.labels[top:bottom, left:right] == 1).all() and (changed.labels == 1).sum() == 100
        if changed is picture:
            unchanged += 1
        elif left == 45:
            flipped += 1
            np.testing.assert_allclose(changed.whole_boxes[0], [42, 8, 58, 22])
    # Binomial: standard deviations of 0.9 %.
    assert unchanged / 2000 == pytest.approx(0.2, abs=0.03)
    assert flipped / 2000 == pytest.approx(0.2, abs=0.03)
