"""Precision, recall and average precision, against values by hand, a plain loop and COCO's own library."""

import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.segmentation.datasets.annotations import AnnotatedImage, Instance, ignored_fruit
from maniskill_tomato.segmentation.instances import Instances
from maniskill_tomato.segmentation.metrics.detection_metrics import (
    DetectionScore,
    ImageTruth,
    PrecisionRecall,
    image_truth,
    mask_overlaps,
    without_narrow,
)

pytest.importorskip("pycocotools")


def found_boxes(boxes: list[list[float]], scores: list[float], size: int = 100) -> Instances:
    """Detections whose masks fill their boxes."""
    masks = np.zeros((len(boxes), size, size), bool)
    for mask, (left, top, right, bottom) in zip(
        masks, np.array(boxes).reshape(-1, 4).astype(int), strict=True
    ):
        mask[top:bottom, left:right] = True
    return Instances(
        boxes=np.array(boxes, np.float32).reshape(-1, 4),
        scores=np.array(scores, np.float32),
        categories=("tomato",) * len(boxes),
        masks=masks,
    )


def true_boxes(boxes: list[list[float]], ignored: list[bool] | None = None, size: int = 100) -> ImageTruth:
    """Fruits whose masks fill their boxes."""
    return ImageTruth(
        boxes=np.array(boxes, np.float64).reshape(-1, 4),
        ignored=np.array(ignored or [False] * len(boxes), bool),
        masks=found_boxes(boxes, [1.0] * len(boxes), size).masks,
    )


def test_average_precision_is_the_one_worked_out_by_hand() -> None:
    """Scores .9 true, .8 false, .7 true, .6 true of four fruits.

    Precision 1, 1/2, 2/3, 3/4; recall 1/4, 1/4, 2/4, 3/4; best precision from there on 1, 3/4, 3/4, 3/4; so
    AP = 1/4 * 1 + 1/4 * 3/4 + 1/4 * 3/4 = 0.625 (Eq. 4-3).
    """
    fruits: list[list[float]] = [[0.0, 0, 10, 10], [20, 0, 30, 10], [40, 0, 50, 10], [60, 0, 70, 10]]
    found = found_boxes([fruits[0], [80, 80, 90, 90], fruits[1], fruits[2]], [0.9, 0.8, 0.7, 0.6])
    score = DetectionScore()
    score.add(found, true_boxes(fruits))
    curve = score.precision_recall()
    np.testing.assert_allclose(curve.precision, [1, 1 / 2, 2 / 3, 3 / 4])
    np.testing.assert_allclose(curve.recall, [1 / 4, 1 / 4, 2 / 4, 3 / 4])
    assert curve.average_precision == pytest.approx(0.625)
    assert curve.at_score(0.75) == pytest.approx((0.5, 0.25))


def test_a_second_detection_of_the_same_fruit_is_false() -> None:
    score = DetectionScore()
    score.add(found_boxes([[0, 0, 10, 10], [0, 0, 10, 11]], [0.9, 0.8]), true_boxes([[0, 0, 10, 10]]))
    np.testing.assert_allclose(score.precision_recall().precision, [1, 0.5])


def test_an_overlap_just_below_the_threshold_is_false_and_at_it_true() -> None:
    truth = true_boxes([[0, 0, 10, 10]])
    for width, true in ((19.9, True), (20.0, True), (20.1, False)):
        score = DetectionScore()
        score.add(found_boxes([[0, 0, width, 10]], [0.9]), truth)
        assert (score.precision_recall().average_precision == 1) is true


def test_a_fruit_set_aside_counts_neither_way() -> None:
    truth = true_boxes([[0, 0, 10, 10], [50, 50, 60, 60]], [False, True])
    score = DetectionScore()
    score.add(found_boxes([[50, 50, 60, 60], [0, 0, 10, 10]], [0.9, 0.8]), truth)
    curve = score.precision_recall()
    assert (curve.fruits, len(curve.scores), curve.average_precision) == (1, 1, 1.0)


def test_without_fruits_average_precision_is_not_a_number_and_without_detections_it_is_zero() -> None:
    nothing = DetectionScore()
    nothing.add(Instances.empty(100, 100), true_boxes([]))
    assert math.isnan(nothing.precision_recall().average_precision)
    missed = DetectionScore()
    missed.add(Instances.empty(100, 100), true_boxes([[0, 0, 10, 10]]))
    assert missed.precision_recall().average_precision == 0


def test_masks_are_compared_only_where_there_are_masks() -> None:
    truth = ImageTruth(boxes=np.array([[0.0, 0, 10, 10]]), ignored=np.zeros(1, bool))
    with pytest.raises(InvalidInputError, match="only boxes"):
        DetectionScore("mask").add(found_boxes([[0, 0, 10, 10]], [0.5]), truth)


def test_overlaps_agree_with_a_count_of_pixels() -> None:
    rng = np.random.default_rng(0)
    corners = rng.integers(0, 40, (6, 2))
    boxes = np.concatenate([corners, corners + rng.integers(1, 40, (6, 2))], axis=1).astype(np.float64)
    masks = found_boxes(boxes.tolist(), [1.0] * 6).masks
    overlaps = mask_overlaps(masks[:3], masks[3:])
    for i in range(3):
        for j in range(3):
            shared = (masks[i] & masks[3 + j]).sum()
            assert overlaps[i, j] == pytest.approx(shared / (masks[i] | masks[3 + j]).sum())


def random_scene(rng: np.random.Generator) -> tuple[Instances, ImageTruth]:
    """Fruits, some set aside, and detections around them, elsewhere and doubled."""
    corners = rng.uniform(0, 70, (8, 2))
    fruits = np.concatenate([corners, corners + rng.uniform(8, 30, (8, 2))], axis=1).round()
    near = fruits[rng.integers(0, 8, 9)] + rng.normal(0, 2.5, (9, 4)).round()
    near[:, 2:] = np.maximum(near[:, 2:], near[:, :2] + 3)
    far = rng.uniform(0, 60, (3, 2)).round()
    boxes = np.clip(np.concatenate([near, np.concatenate([far, far + 15], axis=1)]), 0, 100)
    scores = rng.permutation(np.linspace(0.1, 0.9, 12))
    return found_boxes(boxes.tolist(), scores.tolist()), true_boxes(
        fruits.tolist(), (rng.random(8) < 0.25).tolist()
    )


@pytest.mark.parametrize("overlap", ["box", "mask"])
def test_average_precision_agrees_with_coco(overlap: str) -> None:
    """COCO reads the interpolated curve at 101 recalls instead of all: the sums differ by at most a step."""
    rng = np.random.default_rng(1)
    scenes = [random_scene(rng) for _ in range(40)]
    score = DetectionScore(overlap)  # type: ignore[arg-type]
    for found, truth in scenes:
        score.add(found, truth)
    average = score.precision_recall().average_precision
    theirs = score.coco_metrics()["AP50"]
    assert 0.2 < average < 0.9
    assert theirs == pytest.approx(average, abs=0.01)


@pytest.mark.parametrize("overlap", ["box", "mask"])
def test_precision_and_recall_agree_with_a_plain_loop_over_pixels(overlap: str) -> None:
    rng = np.random.default_rng(2)
    for _ in range(25):
        found, truth = random_scene(rng)
        assert truth.masks is not None
        hits: list[bool] = []
        taken: set[int] = set()
        for d in sorted(range(len(found)), key=lambda d: -found.scores[d]):
            shared = [int((found.masks[d] & mask).sum()) for mask in truth.masks]
            union = [int((found.masks[d] | mask).sum()) for mask in truth.masks]
            options = [
                f
                for f in range(len(shared))
                if not truth.ignored[f] and f not in taken and 2 * shared[f] >= union[f]
            ]
            if options:
                taken.add(max(options, key=lambda f: shared[f] / union[f]))
                hits.append(True)
            elif not any(2 * shared[f] >= found.masks[d].sum() for f in np.flatnonzero(truth.ignored)):
                hits.append(False)
        score = DetectionScore(overlap)  # type: ignore[arg-type]
        score.add(found, truth)
        curve = score.precision_recall()
        np.testing.assert_allclose(curve.recall, np.cumsum(hits) / max((~truth.ignored).sum(), 1))
        np.testing.assert_allclose(curve.precision, np.cumsum(hits) / np.arange(1, len(hits) + 1))


def test_loose_boxes_cost_precision_and_recall_at_the_overlaps_that_they_miss_and_only_in_their_size() -> (
    None
):
    """A box 22 px wide on a fruit of 16 px has an overlap of 16 / 22 = 0.727: found at five of COCO's ten overlaps."""
    score = DetectionScore()
    fruits = [[10.0, 10.0, 26.0, 26.0], [30.0, 30.0, 80.0, 80.0]]
    score.add(found_boxes([[10, 10, 32, 26], [30, 30, 80, 80]], [0.9, 0.8]), true_boxes(fruits))
    metrics = score.coco_metrics()
    assert (metrics["AP_small"], metrics["AR_small"]) == pytest.approx((0.5, 0.5))
    assert (metrics["AP_medium"], metrics["AR_medium"]) == pytest.approx((1, 1))
    assert metrics["AP_large"] == metrics["AR_large"] == -1, "there is no large fruit"
    assert metrics["AR100"] == pytest.approx(0.75)
    precision = score.precision_by_overlap()
    assert precision.keys() == {"all", "small", "medium"}
    np.testing.assert_allclose(precision["small"], [1] * 5 + [0] * 5)
    np.testing.assert_allclose(precision["medium"], 1)
    assert precision["all"].mean() == pytest.approx(metrics["AP"])


def test_without_detections_precision_is_zero_at_every_overlap_and_without_fruits_there_is_none() -> None:
    score = DetectionScore()
    assert score.precision_by_overlap() == {}
    score.add(found_boxes([], []), true_boxes([[0, 0, 10, 10]]))
    assert not score.precision_by_overlap()["all"].any()


def test_detections_beyond_coco_s_hundred_count_in_the_curve() -> None:
    """A fruit that the 151st detection of an image finds: COCO looks at a hundred of them, Eq. 4-2 at all."""
    score = DetectionScore()
    misses = [[50.0, 50, 60, 60]] * 150
    found = found_boxes([*misses, [0, 0, 10, 10]], [*np.linspace(0.9, 0.5, 150).tolist(), 0.4])
    score.add(found, true_boxes([[0, 0, 10, 10]]))
    assert score.precision_recall().recall[-1] == 1 and len(score.precision_recall().recall) == 151
    assert score.coco_metrics()["AR100"] == 0


def test_the_curve_of_a_perfect_detector_has_area_one() -> None:
    ones: NDArray[np.float64] = np.ones(4)
    curve = PrecisionRecall(scores=ones, precision=ones, recall=np.arange(1, 5) / 4, fruits=4)
    assert curve.average_precision == 1


def test_rendered_fruits_that_no_one_would_label_are_set_aside_and_labelled_ones_are_not() -> None:
    def fruit(width: float, fraction: float | None) -> Instance:
        return Instance(category="tomato", box_xywh=(10.0, 10.0, width, 40.0), visible_fraction=fraction)

    # 12 of 640 px for what is rendered; whoever draws boxes by hand has chosen what counts.
    assert not ignored_fruit(fruit(12.0, 0.5), 640)
    assert ignored_fruit(fruit(11.9, 0.5), 640)
    assert ignored_fruit(fruit(12.0, 0.5), 1280)
    assert not ignored_fruit(fruit(11.9, None), 640)
    assert not ignored_fruit(fruit(6.0, None), 640) and ignored_fruit(fruit(5.9, None), 640)
    assert ignored_fruit(fruit(5.9, 0.5), 640, smallest_share=0.0)
    assert not ignored_fruit(fruit(6.0, 0.1), 640, smallest_share=0.0)
    assert ignored_fruit(fruit(40.0, 0.0999), 640)


def test_detections_too_narrow_to_be_asked_for_do_not_count_unless_they_find_a_fruit() -> None:
    found = found_boxes(
        [
            [10, 10, 21, 30],  # 11 px wide, of which 220 px are among the 240 px of the first fruit
            [50, 50, 61, 70],  # 11 px wide, where nothing is annotated
            [80, 10, 91, 30],  # 11 px wide, on a fruit that is set aside
            [50, 10, 62, 30],  # 12 px wide, where nothing is annotated: false
        ],
        [0.9, 0.8, 0.7, 0.6],
    )
    truth = true_boxes([[10, 10, 22, 30], [80, 10, 91, 30]], [False, True])
    narrow = ImageTruth(boxes=truth.boxes, ignored=truth.ignored, masks=truth.masks, least_side=12.0)
    assert without_narrow(found, narrow).scores.tolist() == pytest.approx([0.9, 0.6])
    assert len(without_narrow(found, truth)) == 4
    nothing = ImageTruth(boxes=np.zeros((0, 4)), ignored=np.zeros(0, bool), least_side=12.0)
    assert without_narrow(found, nothing).scores.tolist() == pytest.approx([0.6])


def test_fruits_of_the_rows_behind_can_be_set_aside_and_labels_by_hand_ask_for_every_size() -> None:
    def image(fraction: float | None) -> AnnotatedImage:
        fruits = [
            Instance(
                category="tomato_ripe",
                box_xywh=(10.0, 10.0, 40.0, 40.0),
                visible_fraction=fraction,
                name=name,
            )
            for name in ("fruit_01", "left/fruit_02", "behind_1_-2/fruit_03", None)
        ]
        return AnnotatedImage(
            path=Path("a.png"), file_name="a.png", width=640, height=480, instances=tuple(fruits)
        )

    assert image_truth(image(0.5)).ignored.tolist() == [False] * 4
    assert image_truth(image(0.5), rows_behind=False).ignored.tolist() == [False, False, True, False]
    # 12 of 640 px where a renderer annotated, nothing where a person did.
    assert image_truth(image(0.5)).least_side == 12 and image_truth(image(None)).least_side == 0
