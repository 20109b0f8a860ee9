"""Errors of occlusion models on annotated images, summed up."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from maniskill_tomato.experiments.occlusion_report import report_occlusion
from maniskill_tomato.experiments.occlusion_scores import (
    Judged,
    by_band,
    compared_outline,
    judge,
    markdown,
    outline_cells,
    score,
)
from maniskill_tomato.robot.d435 import color_intrinsics
from maniskill_tomato.segmentation.datasets.annotations import AnnotatedImage, CameraView, Instance
from maniskill_tomato.segmentation.datasets.picture_files import write_picture
from maniskill_tomato.segmentation.instances import Instances, mask_box
from maniskill_tomato.segmentation.masks import EncodedMask
from maniskill_tomato.sensing.visible_fraction.estimate import Estimate
from maniskill_tomato.sensing.visible_fraction.sphere import SphereModel


def test_scores_follow_from_the_errors() -> None:
    def one(truth: float, estimate: float) -> Judged:
        return Judged(
            model="m", file_name="a", category="tomato", visible_px=1, truth=truth, estimate=estimate
        )

    judged = [one(0.1, 0.2), one(0.9, 0.8), one(0.5, float("nan"))]
    result = score(judged)
    assert result.mae == pytest.approx((0.1 + 0.1 + 0.5) / 3) and result.failures == 1
    assert result.bias == pytest.approx(0.0) and result.rmse == pytest.approx(0.1)
    assert [s.count for _, s in by_band(judged)] == [1, 0, 1, 0, 1, 0]
    assert "| m | 3 | 0.233 |" in markdown(judged, {"m": 3.0})


SIZE = (320, 240)
INTRINSICS = color_intrinsics(*SIZE)


def discs(tmp_path: Path) -> tuple[AnnotatedImage, list[NDArray[np.bool_]]]:
    """An image of three fruits, 58 mm wide and 0.85 times as high, at 0.5 m: free, half behind a board, free."""
    columns, rows = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    radius = 0.029 * INTRINSICS.fx / 0.5
    depth = np.full(columns.shape, 1.0)
    masks, instances = [], []
    for k, (x, y) in enumerate(((70.0, 120.0), (160.0, 120.0), (250.0, 120.0))):
        away = ((columns - x) ** 2 + ((rows - y) / 0.85) ** 2) / radius**2
        whole = away < 1.0
        depth[whole] = 0.5 - 0.029 * np.sqrt(1.0 - away[whole])
        seen = whole & ~((columns > x) & (k == 1))
        depth[(np.abs(columns - x - 20) < 20) & (np.abs(rows - y) < 40) & (k == 1)] = 0.4
        masks.append(seen)
        encoded = EncodedMask.encode(seen)
        instances.append(
            Instance(
                category="tomato_ripe",
                box_xywh=encoded.box_xywh,
                visible_mask=encoded,
                visible_fraction=float(seen.sum() / whole.sum()),
                name=f"fruit_{k}",
            )
        )
    write_picture(tmp_path / "a.png", np.full((*columns.shape, 3), 90, np.uint8))
    write_picture(tmp_path / "d.png", np.round(1000 * depth).astype(np.uint16))
    level = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1], [0, 0, 0, 1]])
    return (
        AnnotatedImage(
            path=tmp_path / "a.png",
            file_name="a.png",
            width=SIZE[0],
            height=SIZE[1],
            instances=tuple(instances),
            depth_path=tmp_path / "d.png",
            camera=CameraView(T_world_optical=level, matrix=INTRINSICS.matrix),
        ),
        masks,
    )


def test_fruits_that_a_segmenter_misses_are_failures_and_the_others_are_measured(tmp_path: Path) -> None:
    image, masks = discs(tmp_path)
    found = masks[:2]

    def segmenter(image: NDArray[np.uint8], depth_m: NDArray[np.float32] | None = None) -> Instances:
        return Instances(
            boxes=np.array([mask_box(mask) for mask in found], np.float32),
            scores=np.array([0.9, 0.8], np.float32),
            categories=("tomato_ripe",) * 2,
            masks=np.array(found),
        )

    judged, _ = judge((image,), {"sphere": SphereModel()}, segmenter=segmenter, min_total=0)
    assert [j.truth for j in judged] == pytest.approx([1.0, 0.5, 1.0], abs=0.03)
    assert judged[0].estimate == pytest.approx(1.0, abs=0.1)
    assert judged[1].estimate == pytest.approx(0.5, abs=0.1)
    assert np.isnan(judged[2].estimate) and score(judged).failures == 1
    # A mask that shares less than half with a fruit is not that fruit's.
    found = [np.roll(masks[0], 25, axis=1), masks[1]]
    judged, _ = judge((image,), {"sphere": SphereModel()}, segmenter=segmenter, min_total=0)
    assert np.isnan(judged[0].estimate) and np.isfinite(judged[1].estimate)


def test_silhouettes_are_compared_whole_and_where_they_are_hidden() -> None:
    columns = np.arange(40)[None].repeat(20, axis=0)
    whole, visible = columns < 20, columns < 10
    encoded = EncodedMask.encode(visible)

    def fruit(truth: NDArray[np.bool_] | None, seen: NDArray[np.bool_] = visible) -> Instance:
        return Instance(
            category="tomato",
            box_xywh=encoded.box_xywh,
            visible_mask=EncodedMask.encode(seen),
            amodal_mask=None if truth is None else EncodedMask.encode(truth),
        )

    def estimate(silhouette: NDArray[np.bool_]) -> Estimate:
        return Estimate(visible=1.0, total=1.0, whole=silhouette)

    assert compared_outline(fruit(whole), estimate(whole)) == (1.0, 1.0)
    # 15 of 20 columns, and 5 of the 10 that are hidden.
    assert compared_outline(fruit(whole), estimate(columns < 15)) == (0.75, 0.5)
    assert compared_outline(fruit(whole), Estimate.failed()) == (0.0, 0.0)
    # Nothing is hidden, or the truth is not known.
    alone = compared_outline(fruit(whole, whole), estimate(columns < 15))
    assert alone[0] == 0.75 and np.isnan(alone[1])
    assert np.isnan(compared_outline(fruit(None), estimate(whole))).all()


def test_the_table_of_silhouettes_has_means_over_tomatoes() -> None:
    def one(whole: float, hidden: float) -> Judged:
        common: dict[str, Any] = {"model": "m", "file_name": "a", "category": "tomato", "visible_px": 1}
        return Judged(**common, truth=0.5, estimate=0.5, whole_iou=whole, hidden_iou=hidden)

    nan = float("nan")
    assert outline_cells([one(0.9, 0.6), one(0.7, nan), one(nan, nan)]) == [("m", "2", "0.800", "1", "0.600")]
    assert outline_cells([one(nan, nan)]) == []


def test_the_page_lists_the_largest_errors_first_and_says_what_went_wrong(tmp_path: Path) -> None:
    image, _ = discs(tmp_path)
    models = ("thesis", "sphere")
    report_occlusion(
        [image],
        tmp_path / "out",
        models=models,
        categories=("tomato_ripe",),
        min_visible=100,
        min_total=400,
    )
    page = (tmp_path / "out" / "report.html").read_text()
    listed = page[page.index("Largest errors, 6 of n = 6 estimates") :]
    rows = [
        re.findall(r"<td[^>]*>(.*?)</td>", row)
        for row in re.findall(r'<tr><th scope="row">a.png.*?</tr>', listed)
    ]
    # The thesis's model looks for red, of which the picture has none.
    assert [(model, why) for model, _, why, *_ in rows[:3]] == [("thesis", "no estimate")] * 3
    errors = [abs(float(row[4].replace("none", "0")) - float(row[3])) for row in rows]
    assert len(rows) == 6 and errors == sorted(errors, reverse=True)
    assert {row[0] for row in rows[3:]} == {"sphere"} and errors[3] < 0.2
