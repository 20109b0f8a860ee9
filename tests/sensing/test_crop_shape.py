"""What fruits that are seen whole tell about the size and shape of the others of their crop."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy import stats

from maniskill_tomato.robot.d435 import CameraIntrinsics
from maniskill_tomato.sensing.visible_fraction.crop import (
    CROP_SPREAD,
    RADIUS_SPREAD,
    USUAL_RADIUS,
    CropShape,
    WholeFruit,
)
from maniskill_tomato.sensing.visible_fraction.estimate import SegmentedImage
from maniskill_tomato.sensing.visible_fraction.sphere import SphereModel

INTRINSICS = CameraIntrinsics(width=320, height=240, fx=300.0, fy=300.0, cx=160.0, cy=120.0)
UP = np.array([0.0, -1.0, 0.0])
DISTANCE = 0.5


def view_of(radius: float, flatness: float, leaf: bool = False) -> SegmentedImage:
    """A spheroid with an upright axis before a wall, cast ray by ray; a leaf may hide its left half."""
    columns, rows = np.meshgrid(np.arange(320) + 0.5, np.arange(240) + 0.5)
    rays = np.stack([(columns - 160.0) / 300.0, (rows - 120.0) / 300.0, np.ones_like(rows)], -1)
    scale = np.array([1.0, 1.0 / flatness, 1.0])
    a = ((rays * scale) ** 2).sum(-1)
    b = rays[..., 2] * DISTANCE
    c = DISTANCE**2 - radius**2
    inside = b**2 - a * c
    hit = inside > 0
    depth = np.where(hit, (b - np.sqrt(np.maximum(inside, 0.0))) / a, 1.2)
    if leaf:
        hidden = columns < 160
        depth, hit = np.where(hidden, 0.3, depth), hit & ~hidden
    return SegmentedImage(
        rgb=np.zeros((240, 320, 3), np.uint8),
        depth_m=depth,
        masks=(hit,),
        intrinsics=INTRINSICS,
        up_optical=UP,
        crop=CropShape(),
    )


@pytest.mark.parametrize(("radius", "flatness"), [(0.02, 1.0), (0.029, 0.85), (0.05, 1.2), (0.024, 1.4)])
def test_a_whole_fruit_tells_its_size_and_shape(radius: float, flatness: float) -> None:
    (estimate,) = SphereModel()(view_of(radius, flatness))

    assert estimate.seen_whole is not None
    assert estimate.seen_whole.radius_m == pytest.approx(radius, rel=0.03)
    assert estimate.seen_whole.flatness == pytest.approx(flatness, rel=0.03)


def test_a_half_hidden_fruit_tells_neither() -> None:
    (estimate,) = SphereModel()(view_of(0.03, 0.85, leaf=True))

    assert estimate.seen_whole is None


def test_a_fruit_without_depth_of_its_own_tells_neither() -> None:
    seen = view_of(0.03, 0.85)
    (mask,) = seen.masks
    # A gap in leaves, through which the wall is seen round the fruit.
    gap = cv2.dilate(mask.astype(np.uint8), np.ones((13, 13), np.uint8)) > 0
    shadowed = replace(seen, depth_m=np.where(mask, 0.0, np.where(gap, 1.2, 0.45)))
    (estimate,) = SphereModel()(shadowed)

    assert estimate.seen_whole is None


def test_the_size_of_a_crop_is_the_posterior_of_a_normal_model() -> None:
    seen = [WholeFruit(radius_m=r, flatness=1.2) for r in (0.048, 0.055, 0.051)]
    crop = CropShape.of(seen)

    # By numbers instead of conjugacy.
    grid = np.linspace(np.log(0.01), np.log(0.1), 20_001)
    density = stats.norm.pdf(grid, np.log(USUAL_RADIUS), CROP_SPREAD)
    for fruit in seen:
        density = density * stats.norm.pdf(np.log(fruit.radius_m), grid, RADIUS_SPREAD)
    density /= density.sum()
    mean = float(density @ grid)
    assert np.log(crop.radius_m) == pytest.approx(mean, abs=1e-4)
    assert crop.radius_error == pytest.approx(float(np.sqrt(density @ (grid - mean) ** 2)), rel=1e-3)
    assert 1.1 < crop.flatness < 1.2
    assert CropShape.of([]).radius_m == pytest.approx(USUAL_RADIUS)


def test_knowing_the_crop_tells_how_much_of_a_hidden_fruit_is_seen() -> None:
    half = view_of(0.05, 1.2, leaf=True)
    known = CropShape(radius_m=0.05, radius_error=0.05, flatness=1.2)
    told = SegmentedImage(**{**vars(half), "crop": known})

    (blind,), (knowing,) = SphereModel()(half), SphereModel()(told)

    assert abs(knowing.visible_fraction - 0.5) < 0.03
    assert abs(knowing.visible_fraction - 0.5) <= abs(blind.visible_fraction - 0.5)
