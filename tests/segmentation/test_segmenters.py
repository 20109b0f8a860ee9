"""Segmenters behind one interface: what each finds, and what each refuses."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from maniskill_tomato.assets import ASSETS_DIR
from maniskill_tomato.errors import CheckpointError, InvalidInputError, MissingPackageError
from maniskill_tomato.segmentation.colour_segmenter import (
    ColourSegmenter,
    ellipse_likeness,
    split_by_watershed,
)
from maniskill_tomato.segmentation.instances import Image, Instances, box_ellipse, mask_box
from maniskill_tomato.segmentation.metrics.detection_metrics import mask_overlaps
from maniskill_tomato.segmentation.segmenter import SEGMENTERS, make_segmenter
from maniskill_tomato.segmentation.weights import load_weights, save_weights

RED, GREEN = (205, 40, 30), (60, 140, 50)


def disc(size: tuple[int, int], x: float, y: float, radius: float) -> NDArray[np.bool_]:
    return box_ellipse(np.array([x - radius, y - radius, x + radius, y + radius], np.float32), *size)


def drawn(
    *discs: tuple[float, float, float], colour: tuple[int, int, int] = RED
) -> tuple[Image, NDArray[np.bool_]]:
    """Discs (x, y, radius) on leaves with some noise, and their masks."""
    size = (120, 160)
    image = np.full((*size, 3), GREEN, np.int16)
    masks = np.array([disc(size, *d) for d in discs])
    for mask in masks:
        image[mask] = colour
    noise = np.random.default_rng(0).normal(0, 6, image.shape)
    return np.clip(image + noise, 0, 255).astype(np.uint8), masks


def test_the_colour_segmenter_finds_single_fruits() -> None:
    image, masks = drawn((40, 40, 18), (120, 80, 25))
    found = make_segmenter("colour")(image)
    assert len(found) == 2 and set(found.categories) == {"tomato_ripe"}
    overlaps = mask_overlaps(found.masks, masks)
    assert (overlaps.max(axis=0) > 0.9).all()
    assert (found.scores > 0.9).all()


def test_the_colour_segmenter_separates_fruits_that_touch() -> None:
    image, _ = drawn((50, 60, 22), (88, 60, 22))
    found = ColourSegmenter()(image)
    assert len(found) == 2
    centres = sorted((found.boxes[:, 0] + found.boxes[:, 2]) / 2)
    np.testing.assert_allclose(centres, [50, 88], atol=4)


def test_the_colour_segmenter_does_not_see_leaves_or_green_fruit() -> None:
    image, _ = drawn((50, 60, 22), colour=(120, 150, 70))
    assert len(ColourSegmenter()(image)) == 0


def test_depth_takes_far_fruits_away_and_parts_fruits_of_one_colour() -> None:
    image, masks = drawn((50, 60, 22), (80, 60, 22))
    depth = np.full(image.shape[:2], 0.9, np.float32)
    depth[masks[0]], depth[masks[1]] = 0.6, 0.5
    found = ColourSegmenter()(image, depth)
    assert len(found) == 2
    front = masks[1]
    overlaps = mask_overlaps(found.masks, np.array([front, masks[0] & ~front]))
    assert (overlaps.max(axis=0) > 0.8).all()
    depth[masks[0]] = 4.0
    assert len(ColourSegmenter()(image, depth)) == 1
    depth[:] = np.nan
    assert len(ColourSegmenter()(image, depth)) >= 1


def test_watershed_parts_are_disjoint_and_cover_the_whole_but_for_ridges() -> None:
    _, masks = drawn((40, 40, 20), (70, 50, 20), (110, 70, 30))
    whole: NDArray[np.bool_] = np.asarray(masks.any(axis=0))
    parts = split_by_watershed(whole)
    assert len(parts) == 3
    assert parts.sum(axis=0).max() == 1 and not (parts.any(axis=0) & ~whole).any()
    assert parts.any(axis=0).sum() > 0.95 * whole.sum()
    assert len(split_by_watershed(np.zeros((20, 30), bool))) == 0


def test_an_ellipse_is_more_like_one_than_a_crescent() -> None:
    whole = box_ellipse(np.array([10, 20, 70, 60], np.float32), 100, 100)
    crescent = whole & ~disc((100, 100), 45, 40, 22)
    assert ellipse_likeness(whole) > 0.97 > 0.75 > ellipse_likeness(crescent)
    assert ellipse_likeness(np.eye(3, dtype=bool)[:1]) == 0


def test_ground_truth_returns_the_labels_that_are_fruit() -> None:
    labels = np.zeros((30, 40), np.int32)
    labels[5:10, 6:20], labels[20:25, 1:4], labels[0:2, 0:2] = 7, 9, 3
    segmenter = make_segmenter(
        "ground_truth", labels=lambda: labels, categories={7: "tomato_ripe", 9: "tomato_unripe"}
    )
    found = segmenter(np.zeros((30, 40, 3), np.uint8))
    assert found.categories == ("tomato_ripe", "tomato_unripe")
    np.testing.assert_array_equal(found.boxes, [[6, 5, 20, 10], [1, 20, 4, 25]])
    np.testing.assert_array_equal(found.masks[0], labels == 7)
    with pytest.raises(InvalidInputError, match="of this view"):
        segmenter(np.zeros((31, 40, 3), np.uint8))


@pytest.mark.parametrize("name", ["colour", "light"])
@pytest.mark.parametrize(
    "image",
    [
        np.zeros((10, 10), np.uint8),
        np.zeros((10, 10, 4), np.uint8),
        np.zeros((10, 10, 3), np.float32),
        np.zeros((0, 10, 3), np.uint8),
    ],
)
def test_images_of_another_kind_are_refused(name: str, image: NDArray[np.uint8]) -> None:
    with pytest.raises(InvalidInputError, match="an image must"):
        make_segmenter(name)(image)


def test_depth_of_another_size_or_type_is_refused() -> None:
    image, _ = drawn((50, 60, 22))
    wrong: list[Any] = [np.zeros((10, 10), np.float32), np.zeros(image.shape[:2], np.uint16)]
    for depth in wrong:
        with pytest.raises(InvalidInputError, match="depth must"):
            make_segmenter("colour")(image, depth)


@pytest.mark.parametrize("name", ["colour", "light"])
@pytest.mark.parametrize("level", [0, 255])
def test_an_empty_image_has_no_fruit(name: str, level: int) -> None:
    found = make_segmenter(name)(np.full((96, 128, 3), level, np.uint8))
    assert len(found) == 0 and found.masks.shape == (0, 96, 128)


def test_unknown_names_missing_weights_and_wrong_options_are_clear() -> None:
    with pytest.raises(InvalidInputError, match="'light'.*'colour'.*FILE.pt"):
        make_segmenter("lihgt")
    with pytest.raises(CheckpointError, match="no weights at nowhere.pt"):
        make_segmenter("nowhere.pt")
    with pytest.raises(InvalidInputError, match="sharpness"):
        make_segmenter("colour", sharpness=3)
    with pytest.raises(InvalidInputError, match="between 0 and 1"):
        make_segmenter("light", score_threshold=2.0)
    with pytest.raises(CheckpointError, match="no Mask R-CNN weights ship"):
        make_segmenter("mask_rcnn")
    with pytest.raises(CheckpointError, match="no YOLO weights"):
        make_segmenter("yolo")


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"training": None}, "does not tell its training"),
        ({"format": None}, "has weight format None"),
        # Four terabytes in 32 bits, two bytes in the file.
        ({"state": {"a": torch.zeros(1).half().expand(10**6, 10**6)}}, "no whole tensors"),
        ({"state": {"a": torch.eye(2).to_sparse()}}, "no whole tensors"),
    ],
)
def test_weights_with_a_hostile_entry_are_refused(
    changed: dict[str, Any], words: str, tmp_path: Path
) -> None:
    path = tmp_path / "weights.pt"
    good = {"format": 1, "segmenter": "light", "config": {}, "state": {"a": torch.zeros(2)}, "training": {}}
    torch.save(good, path)
    assert load_weights(path, "light")["state"]["a"].shape == (2,)
    torch.save({**good, **changed}, path)
    with pytest.raises(CheckpointError, match=words):
        load_weights(path, "light")


def test_a_file_that_is_no_weights_is_refused(tmp_path: Path) -> None:
    (tmp_path / "photo.pt").write_bytes(b"not a file of tensors")
    with pytest.raises(CheckpointError, match="not a readable checkpoint"):
        make_segmenter(tmp_path / "photo.pt")
    save_weights(tmp_path / "odd.pt", "perceptron", {}, {})
    with pytest.raises(CheckpointError, match="perceptron"):
        make_segmenter(tmp_path / "odd.pt")


def test_yolo_says_what_to_install(tmp_path: Path) -> None:
    try:
        import ultralytics  # noqa: F401 # pyright: ignore[reportMissingImports]
    except ImportError:
        (tmp_path / "yolov8n.pt").write_bytes(b"weights")
        with pytest.raises(MissingPackageError, match=r"maniskill-tomato\[yolo\]"):
            make_segmenter(tmp_path / "yolov8n.pt")
    else:
        pytest.skip("ultralytics is installed")


def test_boxes_are_those_around_masks_and_the_best_come_first() -> None:
    masks = np.zeros((3, 20, 30), bool)
    masks[0, 2:5, 3:9], masks[2, 10:20, 0:30] = True, True
    found = Instances.from_masks(masks, np.array([0.4, 0.9, 0.8], np.float32))
    np.testing.assert_array_equal(found.boxes, [[0, 10, 30, 20], [3, 2, 9, 5]])
    np.testing.assert_allclose(found.scores, [0.8, 0.4])
    assert mask_box(masks[0]) == (3, 2, 9, 5)


def test_a_whole_fruit_behind_a_leaf_has_the_right_visible_fraction() -> None:
    whole = disc((100, 100), 50, 50, 30)
    visible = whole.copy()
    visible[:, 50:] = False
    found = Instances(
        boxes=np.array([[20, 20, 50, 80]], np.float32),
        scores=np.ones(1, np.float32),
        categories=("tomato",),
        masks=visible[None],
        amodal_boxes=np.array([[20, 20, 80, 80]], np.float32),
    )
    np.testing.assert_array_equal(found.amodal_masks()[0], whole)
    assert found.visible_fractions()[0] == pytest.approx(0.5, abs=0.01)
    with pytest.raises(InvalidInputError, match="amodal"):
        Instances.empty(10, 10).amodal_masks()


def test_instances_that_do_not_fit_together_are_refused() -> None:
    with pytest.raises(InvalidInputError, match="must have boxes"):
        Instances(
            boxes=np.zeros((2, 4), np.float32),
            scores=np.zeros(1, np.float32),
            categories=("tomato",) * 2,
            masks=np.zeros((2, 5, 5), bool),
        )


def test_every_segmenter_of_the_list_can_be_imported() -> None:
    for name in SEGMENTERS.own:
        assert callable(SEGMENTERS.load(name))


def test_the_shipped_weights_are_small_and_find_a_drawn_fruit() -> None:
    path = ASSETS_DIR / "perception" / "light_segmenter.pt"
    assert path.stat().st_size <= 20e6
    size = (240, 320)
    image = np.full((*size, 3), (52, 92, 44), np.float32)
    mask = disc(size, 150, 110, 45)
    y, x = np.mgrid[: size[0], : size[1]]
    shade = np.clip(1.15 - ((x - 135) ** 2 + (y - 90) ** 2) / 6000, 0.35, 1)
    image[mask] = (np.array((205, 40, 30)) * shade[mask][:, None]).astype(np.float32)
    blurred = cv2.GaussianBlur(image, (0, 0), 1.0).astype(np.uint8)
    found = make_segmenter()(blurred)
    overlaps = mask_overlaps(found.masks, mask[None])
    assert overlaps.max(initial=0) > 0.8 and found.categories[int(overlaps[:, 0].argmax())].startswith(
        "tomato"
    )
