"""Touching tomatoes told apart, on groups of pixels whose border is known."""

from dataclasses import replace

import numpy as np
import pytest

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.robot.d435 import color_intrinsics
from maniskill_tomato.segmentation.masks import BinaryMask
from maniskill_tomato.sensing.visible_fraction.estimate import SegmentedImage
from maniskill_tomato.sensing.visible_fraction.improved import ImprovedConfig, ImprovedModel
from maniskill_tomato.sensing.visible_fraction.occlusion_models import make_occlusion_model
from maniskill_tomato.sensing.visible_fraction.separation import Separation, classified, separated
from maniskill_tomato.sensing.visible_fraction.thesis import ThesisConfig, ThesisModel

KINDS: tuple[Separation, ...] = ("watershed", "linear", "polynomial")

ROWS, COLUMNS = np.mgrid[:120, :160]


def disc(row: float, column: float, radius: float) -> BinaryMask:
    """Pixels within a radius of a place."""
    return np.asarray(np.hypot(ROWS - row, COLUMNS - column) <= radius)


def test_a_linear_classifier_of_two_groups_is_that_of_fisher() -> None:
    # An oblique ellipse and a disc, of equal weight: the border lies midway between the means along Fisher's
    # direction, the inverse of the mean covariance times the difference of the means.
    first = ((ROWS - 40 + COLUMNS - 50) / 30) ** 2 + ((ROWS - 40 - COLUMNS + 50) / 12) ** 2 <= 1
    second = disc(80, 110, 20)
    region = np.ones_like(first)
    told = classified(region, [first, second], 1)
    a, b = np.argwhere(first), np.argwhere(second)
    covariance = (np.cov(a.T, bias=True) + np.cov(b.T, bias=True)) / 2
    direction = np.linalg.solve(covariance, b.mean(0) - a.mean(0))
    side = (np.stack([ROWS, COLUMNS], axis=-1) - (a.mean(0) + b.mean(0)) / 2) @ direction
    # The fit sees some hundred pixels of each, so that the border may be off by about a pixel.
    sure = (np.abs(side) / np.linalg.norm(direction) > 1.5) & ~first & ~second
    np.testing.assert_array_equal(told[sure], (side[sure] > 0).astype(int))
    assert (told[first] == 0).all() and (told[second] == 1).all()


def test_a_polynomial_border_bends_where_a_straight_one_cannot() -> None:
    core, ring = disc(60, 80, 15), disc(60, 80, 45) & ~disc(60, 80, 35)
    between = disc(60, 80, 34) & ~disc(60, 80, 16)
    distance = np.hypot(ROWS - 60, COLUMNS - 80)
    told = classified(disc(60, 80, 45), [core, ring], 2)
    border = [distance[between & (told == 0)].max(), distance[between & (told == 1)].min()]
    # A circle of one radius, up to the raster.
    assert 16 < border[1] <= border[0] < 34 and border[0] - border[1] < 2
    assert (told[~disc(60, 80, 45)] == -1).all()
    straight = classified(disc(60, 80, 45), [core, ring], 1)
    assert np.ptp(distance[between & (straight == 0)]) > 15 or not (straight[between] == 0).any()


@pytest.mark.parametrize("how", KINDS)
def test_three_groups_each_get_what_lies_around_them(how: Separation) -> None:
    places = [(30.0, 40.0), (30.0, 110.0), (85.0, 75.0)]
    groups = [disc(*place, 18) for place in places]
    region = np.any([disc(*place, 27) for place in places], axis=0)
    told = separated(how, region, groups)
    nearest = np.argmin([np.hypot(ROWS - r, COLUMNS - c) for r, c in places], axis=0)
    decided = region & (told >= 0)
    assert decided.sum() > 0.95 * region.sum()
    assert (told[decided] == nearest[decided]).mean() > 0.98
    assert (told[~region] == -1).all()


def test_nothing_to_divide_gives_nothing() -> None:
    nothing = np.zeros((120, 160), bool)
    assert (classified(nothing, [disc(30, 30, 5)], 1) == -1).all()


def touching(cut: int) -> tuple[SegmentedImage, float]:
    """Two discs of 22 px that touch, and a strip of leaf before both of them from `cut` [px] above their middle on.

    Returns:
        The view, and the V_f of both.
    """
    intrinsics = replace(color_intrinsics(160, 120), fx=300.0, fy=300.0, cx=80.0, cy=60.0)
    discs = disc(60, 58, 22), disc(60, 102, 22) & ~disc(60, 58, 22)
    leaf = np.zeros((120, 160), bool)
    leaf[60 - cut : 60 + cut] = True
    rgb, depth = np.full((120, 160, 3), 180, np.uint8), np.full((120, 160), 1.5)
    rgb[discs[0] | discs[1]], depth[discs[0] | discs[1]] = (190, 30, 25), 0.4
    rgb[leaf], depth[leaf] = (60, 130, 50), 0.37
    masks = tuple(mask & ~leaf for mask in discs)
    view = SegmentedImage(rgb=rgb, depth_m=depth, masks=masks, intrinsics=intrinsics)
    return view, float(masks[0].sum() / discs[0].sum())


@pytest.mark.parametrize("how", KINDS)
@pytest.mark.parametrize("cut", [0, 4])
def test_a_contour_of_two_tomatoes_becomes_two(how: Separation, cut: int) -> None:
    view, truth = touching(cut)
    assert len(ThesisModel().run(view).contours) == 1
    model = ThesisModel(ThesisConfig(separation=how))
    assert len(model.run(view).contours) == 2
    estimates = model(view)
    for estimate, mask in zip(estimates, view.masks, strict=True):
        assert estimate.visible_fraction == pytest.approx(truth, abs=0.12)
        assert estimate.whole is not None and (estimate.whole & mask).sum() > 0.9 * mask.sum()
    assert estimates[0].whole is not None and estimates[1].whole is not None
    shared = (estimates[0].whole & estimates[1].whole).sum()
    assert shared < 0.1 * estimates[0].whole.sum()


@pytest.mark.parametrize("how", KINDS)
def test_the_improved_model_takes_either_way(how: Separation) -> None:
    view, truth = touching(4)
    for estimate in ImprovedModel(ImprovedConfig(separation=how, diameter_m=0.06))(view):
        assert estimate.visible_fraction == pytest.approx(truth, abs=0.12)


@pytest.mark.parametrize("name", ["thesis_watershed", "thesis_classifier"])
def test_both_ways_are_occlusion_models_by_name(name: str) -> None:
    view, _ = touching(0)
    rgb, depth, (left, right) = view.rgb.copy(), view.depth_m.copy(), view.masks
    strip = np.zeros_like(left)
    strip[54:66, :70] = True
    rgb[strip], depth[strip] = (60, 130, 50), 0.37
    hidden = replace(view, rgb=rgb, depth_m=depth, masks=(left & ~strip, right))
    truth = (left & ~strip).sum() / left.sum()
    assert truth < 0.75
    undivided = [estimate.visible_fraction for estimate in make_occlusion_model("thesis")(hidden)]
    assert undivided[0] == undivided[1]
    divided = [estimate.visible_fraction for estimate in make_occlusion_model(name)(hidden)]
    assert divided == pytest.approx([truth, 1.0], abs=0.12)


def test_an_unknown_way_is_refused() -> None:
    with pytest.raises(InvalidInputError, match=r"separation.*watershed"):
        ThesisConfig(separation="hope")  # type: ignore[arg-type]
    with pytest.raises(InvalidInputError, match=r"separation.*watershed"):
        ImprovedConfig(separation="hope")  # type: ignore[arg-type]
