"""The D435's intrinsics, limits and place on the flange, against values worked out by hand."""

import math

import numpy as np
import pytest

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.robot import d435
from maniskill_tomato.robot.d435 import CameraIntrinsics, color_intrinsics, depth_intrinsics


def test_nominal_colour_has_the_data_sheets_fields_of_view() -> None:
    full = color_intrinsics(1920, 1080)
    assert math.degrees(full.fov_y) == pytest.approx(42.5, abs=1e-9)
    assert math.degrees(full.fov_x) == pytest.approx(69.4, abs=0.1)


# 42.5 degrees of height: f = (height / 2) / tan(21.25 degrees) = height / 2 / 0.3888787.
@pytest.mark.parametrize(
    ("width", "height", "focal"),
    [
        (1920, 1080, 1388.61),
        (1280, 720, 925.738),
        (640, 480, 617.159),
        (160, 120, 154.290),
        (128, 128, 164.576),
    ],
)
def test_colour_keeps_its_vertical_field_of_view_up_to_16_by_9(width: int, height: int, focal: float) -> None:
    camera = color_intrinsics(width, height)
    assert camera.fx == camera.fy == pytest.approx(focal, rel=1e-5)
    assert (camera.cx, camera.cy) == (width / 2, height / 2)


def test_pictures_wider_than_the_imager_lose_rows_and_keep_the_width() -> None:
    wide, full = color_intrinsics(1920, 480), color_intrinsics(1920, 1080)
    assert wide.fov_x == pytest.approx(full.fov_x)
    assert wide.fov_y < full.fov_y


def test_measured_colour_is_what_one_device_reports() -> None:
    camera = color_intrinsics(640, 480, "measured")
    assert (camera.fx, camera.fy) == pytest.approx((612.4, 610.6))
    # The device reports 314.3 and 237.8, counted from the centre of the first pixel.
    assert (camera.cx, camera.cy) == pytest.approx((314.8, 238.3))
    assert math.degrees(camera.fov_x) == pytest.approx(55.2, abs=0.05)
    assert math.degrees(camera.fov_y) == pytest.approx(42.9, abs=0.05)
    assert color_intrinsics(1280, 720, "measured").fx == pytest.approx(918.6)


def test_an_unknown_calibration_is_refused_with_the_known_ones() -> None:
    with pytest.raises(InvalidInputError, match="'nominal', 'measured'"):
        color_intrinsics(640, 480, "factory")  # type: ignore[arg-type]


# Ranges of focal lengths that real devices report in these modes.
@pytest.mark.parametrize(
    ("width", "height", "low", "high"),
    [(640, 480, 382.9, 384.2), (848, 480, 422.8, 427.3), (1280, 720, 638.0, 645.0)],
)
def test_depth_modes_have_the_focal_lengths_of_real_devices(
    width: int, height: int, low: float, high: float
) -> None:
    assert low <= depth_intrinsics(width, height).fx <= high


def test_depth_fields_of_view_by_mode() -> None:
    assert math.degrees(depth_intrinsics(848, 480).fov_x) == pytest.approx(90.0)
    assert math.degrees(depth_intrinsics(640, 480).fov_x) == pytest.approx(79.6, abs=0.05)
    assert math.degrees(depth_intrinsics(640, 480).fov_y) == pytest.approx(64.0, abs=0.05)


def test_nearest_measurable_depth() -> None:
    # f * 50 mm / 126 with f = 424, 384 and 640 px.
    assert d435.min_depth(depth_intrinsics(848, 480)) == pytest.approx(0.168, abs=5e-4)
    assert d435.min_depth(depth_intrinsics(640, 480)) == pytest.approx(0.152, abs=5e-4)
    assert d435.min_depth(depth_intrinsics(1280, 720)) == pytest.approx(0.254, abs=5e-4)


def test_depth_noise_grows_with_the_square_of_the_distance() -> None:
    sigma = d435.depth_noise_std([0.3, 0.5, 0.8, 1.0], depth_intrinsics(848, 480))
    np.testing.assert_allclose(sigma, [0.34e-3, 0.94e-3, 2.4e-3, 3.8e-3], atol=0.03e-3)


def test_resizing_scales_each_axis() -> None:
    camera = CameraIntrinsics(width=640, height=480, fx=600.0, fy=610.0, cx=310.0, cy=250.0)
    assert camera.scaled(320, 120) == CameraIntrinsics(
        width=320, height=120, fx=300.0, fy=152.5, cx=155.0, cy=62.5
    )


def test_cropping_keeps_the_shape_of_pixels() -> None:
    camera = CameraIntrinsics(width=640, height=480, fx=600.0, fy=610.0, cx=310.0, cy=250.0)
    # The centred 480 x 480 square, then halved: (310 - 80) / 2 = 115.
    assert camera.cropped(240, 240) == CameraIntrinsics(
        width=240, height=240, fx=300.0, fy=305.0, cx=115.0, cy=125.0
    )


def test_projection_and_rays_by_hand() -> None:
    camera = CameraIntrinsics(width=100, height=80, fx=50.0, fy=40.0, cx=50.0, cy=40.0)
    np.testing.assert_allclose(camera.project([0.2, -0.1, 2.0]), [55.0, 38.0])
    np.testing.assert_allclose(camera.ray_directions([55.0, 38.0]), [0.1, -0.05, 1.0])
    np.testing.assert_array_equal(camera.matrix, [[50, 0, 50], [0, 40, 40], [0, 0, 1]])


def test_points_behind_the_camera_have_no_image() -> None:
    camera = color_intrinsics(64, 48)
    assert np.isnan(camera.project([[0.1, 0.1, -1.0], [0.1, 0.1, 0.0]])).all()


def test_rays_through_all_pixels_project_back_onto_their_centres() -> None:
    camera = color_intrinsics(32, 24, "measured")
    centres = camera.pixel_centres()
    assert centres.shape == (24, 32, 2)
    np.testing.assert_array_equal(centres[3, 5], [5.5, 3.5])
    np.testing.assert_allclose(camera.project(1.7 * camera.ray_directions(centres)), centres, atol=1e-9)


@pytest.mark.parametrize(
    "field",
    [
        *({"width": 0}, {"height": -1}, {"fx": 0.0}, {"fy": float("nan")}, {"width": 10**9}, {"fx": 1e9}),
        *({"cx": float("inf")}, {"cy": float("nan")}, {"cy": -1e9}),
    ],
)
def test_impossible_intrinsics_are_refused(field: dict[str, float]) -> None:
    values: dict[str, float] = dict(width=64, height=48, fx=50.0, fy=50.0, cx=32.0, cy=24.0) | field
    with pytest.raises(InvalidInputError, match=next(iter(field))):
        CameraIntrinsics(**values)  # type: ignore[arg-type]


@pytest.mark.parametrize("fov", [0.0, math.pi, -1.0])
def test_an_impossible_field_of_view_is_refused(fov: float) -> None:
    with pytest.raises(InvalidInputError, match="fov_y"):
        CameraIntrinsics.from_fov(width=64, height=48, fov_y=fov)


def test_the_camera_looks_along_the_flange_axis_with_its_top_towards_minus_x() -> None:
    rotation = d435.T_flange_camera_color_optical[:3, :3]
    np.testing.assert_allclose(rotation @ [0, 0, 1], [0, 0, 1], atol=1e-15)  # viewing direction
    np.testing.assert_allclose(rotation @ [0, -1, 0], [-1, 0, 0], atol=1e-15)  # up in the picture
    np.testing.assert_allclose(rotation @ [-1, 0, 0], [0, 1, 0], atol=1e-15)  # left in the picture
    assert np.linalg.det(rotation) == pytest.approx(1.0)


def test_places_of_the_imagers_on_the_flange() -> None:
    # The housing is centred on the axis, its left imager 17.5 mm to the left (+y); glass at 50 mm, imagers 4.2 behind.
    np.testing.assert_allclose(d435.T_flange_camera_depth[:3, 3], [0.0, 0.0175, 0.0458], atol=1e-12)
    np.testing.assert_allclose(d435.T_flange_camera_color[:3, 3], [0.0, 0.0325, 0.0458], atol=1e-12)
    np.testing.assert_allclose(d435.T_flange_camera_color_optical[:3, 3], [0.0, 0.0325, 0.0458], atol=1e-12)


def test_depth_to_colour_moves_points_15_mm_to_the_right() -> None:
    expected = np.linalg.inv(d435.T_flange_camera_color_optical) @ d435.T_flange_camera_depth_optical
    np.testing.assert_allclose(d435.T_color_optical_depth_optical, expected, atol=1e-12)
    np.testing.assert_allclose(d435.T_color_optical_depth_optical[:3, 3], [0.015, 0.0, 0.0], atol=1e-12)


def test_constants_cannot_be_changed_by_accident() -> None:
    for constant in (
        d435.T_flange_camera,
        d435.T_flange_camera_color_optical,
        d435.T_color_optical_depth_optical,
    ):
        with pytest.raises(ValueError, match="read-only"):
            constant[0, 3] = 1.0
