"""Tracks of fruits over views, against spheres whose truth is known."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.stats import chi2

from maniskill_tomato.robot.d435 import color_intrinsics
from maniskill_tomato.robot.look_at import look_at_pose
from maniskill_tomato.segmentation.instances import Instances
from maniskill_tomato.segmentation.masks import BinaryMask
from maniskill_tomato.sensing.fruit_detector import FruitDetector
from maniskill_tomato.sensing.fruit_map import (
    GATE,
    MERGE_GATE,
    NO_TRACK,
    FruitMap,
    MapConfig,
    Track,
    outline,
)
from maniskill_tomato.sensing.measurement import DetectedFruit, Measurement
from maniskill_tomato.sensing.posed_frame import PosedFrame
from maniskill_tomato.sensing.visible_fraction.crop import FLATNESS

Place = NDArray[np.float64]

INTRINSICS = color_intrinsics(160, 120)
FRUIT = np.array([0.9, 0.0, 0.6])
NEIGHBOUR = FRUIT + [0.0, 0.06, 0.0]
RADIUS = 0.027
CAMERAS = ((0.5, -0.1, 0.6), (0.5, 0.1, 0.65), (0.55, 0.0, 0.7), (0.5, -0.05, 0.55), (0.6, 0.1, 0.6))
BEHIND = 1.5


def look_from(camera: tuple[float, float, float], towards: Place = FRUIT) -> Place:
    position = torch.tensor([camera], dtype=torch.float64)
    pose: Place = look_at_pose(position, torch.as_tensor(towards)[None])[0].numpy()
    return pose


def cast(
    camera: tuple[float, float, float],
    spheres: list[Place],
    *,
    leaf: Place | None = None,
    merged: bool = False,
    flatness: float = FLATNESS,
) -> PosedFrame:
    """Tomatoes of one radius and so many times as high as wide, before a wall, a leaf of 8 cm about a place in front of
    them; exact masks."""
    pose = look_from(camera)
    rays = INTRINSICS.ray_directions(INTRINSICS.pixel_centres())
    # They are spheres in a world that is stretched upwards.
    stretch = pose[:3, :3].T @ np.diag([1.0, 1.0, 1.0 / flatness]) @ pose[:3, :3]
    stretched = rays @ stretch
    square = (stretched**2).sum(-1)
    depth = np.full(square.shape, BEHIND)
    owner = np.full(square.shape, -1)
    for k, sphere in enumerate(spheres):
        centre = stretch @ pose[:3, :3].T @ (sphere - pose[:3, 3])
        along = stretched @ centre
        inside = along**2 - square * (centre @ centre - RADIUS**2)
        hit = np.where(inside > 0.0, (along - np.sqrt(np.maximum(inside, 0.0))) / square, np.inf)
        owner = np.where(hit < depth, k, owner)
        depth = np.minimum(hit, depth)
    if leaf is not None:
        centre = pose[:3, :3].T @ (leaf - pose[:3, 3])
        at = rays * centre[2] - centre
        covers = (np.abs(at[..., 0]) < 0.04) & (np.abs(at[..., 1]) < 0.04)
        owner = np.where(covers, -1, owner)
        depth = np.where(covers, centre[2], depth)
    masks = (
        np.stack([owner == k for k in range(len(spheres))]) if spheres else np.zeros((0, *depth.shape), bool)
    )
    if merged:
        masks = np.asarray(masks.any(0))[None]
    return PosedFrame(
        depth_m=depth.astype(np.float32),
        intrinsics=INTRINSICS,
        T_world_camera=pose,
        true_fruits=Instances.from_masks(masks, categories=("tomato_ripe",) * len(masks)),
    )


DETECTOR = FruitDetector(None)


def detection(place: Place, camera: Place, fraction: float = 1.0, ripe: bool = True) -> DetectedFruit:
    away = place - camera
    return DetectedFruit(
        category="tomato_ripe" if ripe else "tomato_unripe",
        score=1.0,
        corner=(0, 0),
        crop=np.ones((30, 30), np.bool_),
        visible_fraction=fraction,
        centre_w=place,
        radius_m=RADIUS,
        is_depth_measured=True,
        direction_w=away / np.linalg.norm(away),
    )


def view(camera: tuple[float, float, float], *fruits: DetectedFruit) -> Measurement:
    frame = PosedFrame(
        depth_m=np.full((120, 160), BEHIND, np.float32),
        intrinsics=INTRINSICS,
        T_world_camera=look_from(camera),
    )
    return Measurement(frame=frame, fruits=fruits)


def only(fruits: FruitMap) -> int:
    (number,) = fruits.tracks
    return number


def test_several_views_of_a_sphere_make_one_track_at_its_place_with_its_radius() -> None:
    fruits = FruitMap()
    errors = []
    for camera in CAMERAS:
        fruits.update(DETECTOR.measure(cast(camera, [FRUIT])))
        errors.append(np.sqrt(np.trace(fruits.tracks[only(fruits)].covariance[:3, :3])))
    track = fruits.tracks[only(fruits)]
    assert track.views == len(CAMERAS) and track.is_ripe and track.existence > 0.9
    # A pixel is 3 mm there.
    np.testing.assert_allclose(track.position_w, FRUIT, atol=0.003)
    assert track.radius_m == pytest.approx(RADIUS, abs=0.002)
    assert all(after < before for before, after in zip(errors, errors[1:], strict=False))


def test_two_fruits_that_touch_stay_two_whichever_is_detected_first() -> None:
    for order in (1, -1):
        fruits = FruitMap()
        for camera in CAMERAS:
            measured = DETECTOR.measure(cast(camera, [FRUIT, NEIGHBOUR]))
            fruits.update(replace(measured, fruits=measured.fruits[::order]))
        assert len(fruits.tracks) == 2
        nearest = [min(t.position_w.tolist() for t in fruits.tracks.values())[1]]
        assert nearest[0] == pytest.approx(0.0, abs=0.06)
        places = sorted(float(track.position_w[1]) for track in fruits.tracks.values())
        np.testing.assert_allclose(places, [0.0, 0.06], atol=0.005)


def test_detections_are_assigned_jointly_not_one_after_the_other() -> None:
    """Both are nearest to the same track; only together do they tell which is which."""
    fruits = FruitMap()
    camera = (0.5, 0.0, 0.6)
    at = np.array(camera)
    first, second = FRUIT, FRUIT + [0.0, 0.05, 0.0]
    before = fruits.update(view(camera, detection(first, at, 0.4), detection(second, at, 0.4)))
    shift = np.array([0.0, -0.008, 0.0])
    after = fruits.update(
        view(camera, detection(second + 2 * shift, at, 0.4), detection(first + shift, at, 0.4))
    )
    assert after.tracks == before.tracks[::-1]


def test_the_gates_are_quantiles_of_chi_square_with_four_degrees_of_freedom() -> None:
    assert GATE == pytest.approx(chi2.ppf(0.9995, 4), abs=1e-5)
    assert MERGE_GATE == pytest.approx(chi2.ppf(0.99, 4), abs=1e-5)


def test_a_detection_beyond_the_gate_begins_another_track() -> None:
    fruits = FruitMap()
    camera = (0.5, 0.0, 0.6)
    at = np.array(camera)
    for _ in range(2):
        fruits.update(view(camera, detection(FRUIT, at)))
    sigma = np.sqrt(np.diag(fruits.tracks[0].covariance + fruits.sphere_of(detection(FRUIT, at), at)[1]))
    far = FRUIT + [0.0, float(np.sqrt(chi2.ppf(0.9999, 4)) * sigma[1]) + 0.03, 0.0]
    assert fruits.update(view(camera, detection(far, at))).tracks == (1,)


def test_a_hidden_fruit_keeps_its_existence_and_one_that_is_gone_loses_it() -> None:
    fruits = FruitMap()
    for camera in CAMERAS[:3]:
        fruits.update(DETECTOR.measure(cast(camera, [FRUIT])))
    known = fruits.tracks[only(fruits)].existence_log_odds
    camera = CAMERAS[3]
    towards = np.array(camera) - FRUIT
    leaf = FRUIT + 0.1 * towards / np.linalg.norm(towards)
    for _ in range(5):
        fruits.update(DETECTOR.measure(cast(camera, [FRUIT], leaf=leaf)))
    assert fruits.tracks[only(fruits)].existence_log_odds > known - 0.5
    for _ in range(5):
        fruits.update(DETECTOR.measure(cast(camera, [])))
    assert not fruits.tracks


def test_what_lies_outside_the_picture_keeps_its_existence() -> None:
    fruits = FruitMap()
    fruits.update(DETECTOR.measure(cast(CAMERAS[0], [FRUIT])))
    known = fruits.tracks[0].existence_log_odds
    away = replace(cast(CAMERAS[0], []), T_world_camera=look_from((0.5, 0.0, 0.6), FRUIT + [0.0, 2.0, 0.0]))
    fruits.update(DETECTOR.measure(away))
    assert fruits.tracks[0].existence_log_odds == known


def test_two_tracks_of_one_sphere_become_one_and_keep_the_name_that_was_given() -> None:
    fruits = FruitMap()
    left, right = (0.6, -0.25, 0.6), (0.6, 0.25, 0.6)
    poor = 0.15
    fruits.update(view(left, detection(FRUIT + [0.0, -0.014, 0.0], np.array(left), poor)))
    number = only(fruits)
    # From the other side it seems to stand far enough away to be another one.
    fruits.update(view(right, detection(FRUIT + [0.03, 0.028, 0.012], np.array(right), 0.6)))
    assert len(fruits.tracks) == 2
    for camera in CAMERAS:
        seen = fruits.update(DETECTOR.measure(cast(camera, [FRUIT])))
        assert set(seen.tracks) <= fruits.tracks.keys()
    assert len(fruits.tracks) == 1
    assert fruits.current(number) == only(fruits)


def test_two_pieces_of_one_fruit_become_one_track_again_and_two_that_touch_do_not() -> None:
    camera = np.array(CAMERAS[0])
    for apart, left in ((0.008, 1), (0.045, 2)):
        fruits, beside = FruitMap(), FRUIT + [0.0, apart, 0.0]
        # A leaf across a fruit makes two masks of it, whose spheres are fitted to less of it.
        first = fruits.update(view(CAMERAS[0], detection(FRUIT, camera), detection(beside, camera)))
        assert len(set(first.tracks)) == left
        for place in CAMERAS[1:]:
            fruits.update(view(place, detection(FRUIT, np.array(place)), detection(beside, np.array(place))))
        assert len(fruits.tracks) == left


def test_a_mask_over_two_known_fruits_is_divided_between_them() -> None:
    fruits = FruitMap(divide=DETECTOR.divide)
    for camera in CAMERAS[:3]:
        fruits.update(DETECTOR.measure(cast(camera, [FRUIT, NEIGHBOUR])))
    both = set(fruits.tracks)
    measured = DETECTOR.measure(cast(CAMERAS[0], [FRUIT, NEIGHBOUR], merged=True))
    assert len(measured.fruits) == 1
    seen = fruits.update(measured)
    assert set(seen.tracks) == both == set(fruits.tracks)
    truth = cast(CAMERAS[0], [FRUIT, NEIGHBOUR]).true_fruits
    assert truth is not None
    for mask in truth.masks:
        assert max(_overlap(seen.measurement.mask(k), mask) for k in range(2)) > 0.9


def test_ripeness_follows_what_most_views_say() -> None:
    fruits = FruitMap()
    at = np.array(CAMERAS[0])
    for ripe in (False, True, True):
        fruits.update(view(CAMERAS[0], detection(FRUIT, at, ripe=ripe)))
    assert fruits.tracks[only(fruits)].is_ripe
    for ripe in (False, False, False):
        fruits.update(view(CAMERAS[0], detection(FRUIT, at, ripe=ripe)))
    assert not fruits.tracks[only(fruits)].is_ripe


@pytest.mark.parametrize("hidden", [0.25, 0.5, 0.75])
def test_the_visible_fraction_by_the_maps_sphere_is_near_the_truth(hidden: float) -> None:
    fruits = FruitMap()
    for camera in CAMERAS:
        fruits.update(DETECTOR.measure(cast(camera, [FRUIT])))
    camera = (0.5, 0.0, 0.6)
    pose = look_from(camera)
    # The leaf's edge passes over the fruit.
    leaf = FRUIT - 0.1 * pose[:3, 2] + (0.04 - RADIUS * (1 - 2 * hidden) - RADIUS * 0.0) * pose[:3, 0] * -1
    frame = cast(camera, [FRUIT], leaf=leaf)
    whole = cast(camera, [FRUIT])
    assert frame.true_fruits is not None and whole.true_fruits is not None
    truth = frame.true_fruits.masks[0].sum() / whole.true_fruits.masks[0].sum()
    assert 0.1 < truth < 0.9
    seen = fruits.update(DETECTOR.measure(frame))
    number = only(fruits)
    fraction = fruits.fraction(seen.measurement, seen.detection(number), number)
    assert fraction.fused == pytest.approx(truth, abs=0.06)
    assert abs(fraction.value - truth) < 2.5 * fraction.error


def test_a_wholly_visible_fruit_is_surer_than_a_half_visible_one_and_an_unseen_one_has_none() -> None:
    fruits = FruitMap()
    seen = fruits.update(DETECTOR.measure(cast(CAMERAS[0], [FRUIT])))
    whole = fruits.fraction(seen.measurement, 0, seen.tracks[0])
    assert whole.value > 0.97 and whole.value - 2 * whole.error > 0.8
    half = detection(FRUIT, np.array(CAMERAS[0]), 0.5)
    measured = replace(seen.measurement, fruits=(half,))
    assert fruits.fraction(measured, 0, seen.tracks[0]).error > 2 * whole.error
    assert fruits.fraction(seen.measurement, None, seen.tracks[0]).value == 0.0


def test_true_identities_make_the_tracks_whatever_the_places() -> None:
    fruits = FruitMap()
    at = np.array(CAMERAS[0])
    for place in (FRUIT, FRUIT + 0.2):
        seen = fruits.update(view(CAMERAS[0], detection(place, at), detection(NEIGHBOUR, at)), [7, None])
        assert seen.tracks[0] == 7
    assert fruits.tracks[7].views == 2


def test_a_fruit_without_a_depth_of_its_own_is_found_again_by_the_ray_to_it() -> None:
    fruits = FruitMap()
    for camera in CAMERAS[:3]:
        fruits.update(DETECTOR.measure(cast(camera, [FRUIT])))
    before = fruits.tracks[only(fruits)].position_w.copy()
    at = np.array(CAMERAS[3])
    nearer = replace(detection(at + 0.7 * (FRUIT - at), at, 0.3), is_depth_measured=False)
    assert fruits.update(view(CAMERAS[3], nearer)).tracks == (only(fruits),)
    np.testing.assert_allclose(fruits.tracks[only(fruits)].position_w, before, atol=0.002)


def test_a_spheres_outline_holds_its_pixels() -> None:
    frame = cast(CAMERAS[1], [FRUIT], flatness=1.0)
    circle = outline(np.array([*FRUIT, RADIUS]), frame.T_world_camera, INTRINSICS)
    assert circle is not None and frame.true_fruits is not None
    v, u = np.indices(frame.depth_m.shape) + 0.5
    disc = np.hypot(u - circle[0], v - circle[1]) < circle[2]
    assert _overlap(disc, frame.true_fruits.masks[0]) > 0.95
    behind = np.array([*(frame.T_world_camera[:3, 3] - 0.3 * frame.T_world_camera[:3, 2]), RADIUS])
    assert outline(behind, frame.T_world_camera, INTRINSICS) is None


def test_less_of_a_fruit_says_less_of_where_it_is_most_of_all_along_the_view() -> None:
    fruits, at = FruitMap(MapConfig()), np.array([0.5, 0.0, 0.6])
    spreads = [
        np.sqrt(np.diag(fruits.sphere_of(detection(FRUIT, at, fraction), at)[1]))
        for fraction in (1.0, 0.4, 0.1)
    ]
    for more, less in zip(spreads, spreads[1:], strict=False):
        assert (less > more).all()
    # The camera looks along x.
    assert all(spread[0] > spread[1] for spread in spreads)


def _overlap(a: BinaryMask, b: BinaryMask) -> float:
    return float(np.count_nonzero(a & b) / np.count_nonzero(a | b))


def test_a_view_without_depth_is_judged_by_the_maps_sphere_alone() -> None:
    """A mask without depth looks like a whole small fruit; the map knows how large it is."""
    fruits = FruitMap()
    for camera in CAMERAS:
        fruits.update(DETECTOR.measure(cast(camera, [FRUIT])))
    frame = cast((0.5, 0.0, 0.6), [FRUIT])
    assert frame.true_fruits is not None
    mask = frame.true_fruits.masks[0].copy()
    rows = np.flatnonzero(mask.any(axis=1))
    mask[rows[len(rows) // 2] :] = False
    half = replace(
        frame,
        depth_m=np.where(mask, 0.0, frame.depth_m).astype(np.float32),
        true_fruits=Instances.from_masks(mask[None], categories=("tomato_ripe",)),
    )
    measured = DETECTOR.measure(half)
    assert not measured.fruits[0].is_depth_measured
    assert fruits.fraction(measured, 0, only(fruits)).value == pytest.approx(0.5, abs=0.1)


def test_colour_tells_a_fruit_that_turns_from_a_ripe_one_where_the_segmenter_is_wrong() -> None:
    camera = np.array(CAMERAS[0])
    for redness, is_ripe in ((0.30, False), (0.64, True)):
        fruits = FruitMap()
        for called_ripe in (True, False, not is_ripe):
            seen = replace(detection(FRUIT, camera, ripe=called_ripe), redness=redness)
            fruits.update(view(CAMERAS[0], seen))
        assert fruits.tracks[only(fruits)].is_ripe == is_ripe


def test_the_redness_of_a_detection_is_that_of_its_visible_pixels() -> None:
    frame = cast(CAMERAS[0], [FRUIT])
    assert frame.true_fruits is not None
    colours = np.full((*frame.depth_m.shape, 3), (40, 160, 60), np.uint8)
    colours[frame.true_fruits.masks[0]] = (180, 60, 30)
    (seen,) = DETECTOR.measure(replace(frame, rgb=colours)).fruits
    assert seen.redness == pytest.approx((180 - 60) / (180 + 60))
    (blind,) = DETECTOR.measure(frame).fruits
    assert np.isnan(blind.redness)


def test_the_same_picture_again_tells_nothing_more() -> None:
    fruits = FruitMap()
    measured = DETECTOR.measure(cast(CAMERAS[0], [FRUIT]))
    first = fruits.update(measured)
    track = fruits.tracks[only(fruits)]
    mean, covariance, existence = track.mean.copy(), track.covariance.copy(), track.existence_log_odds
    again = fruits.again(measured, first)
    assert again.tracks == (track.number,) and track.views == 1
    np.testing.assert_array_equal(track.mean, mean)
    np.testing.assert_array_equal(track.covariance, covariance)
    assert track.existence_log_odds == existence
    elsewhere = DETECTOR.measure(cast(CAMERAS[0], [NEIGHBOUR + [0.0, 0.06, 0.0]]))
    assert fruits.again(elsewhere, first).tracks == (NO_TRACK,)
    # A detection that the last picture lacked is found again by its place.
    missed = fruits.again(DETECTOR.measure(cast(CAMERAS[0], [])), first)
    assert fruits.again(measured, missed).tracks == (track.number,)


@pytest.mark.parametrize("camera", [(0.5, 0.0, 0.6), (0.6, 0.0, 0.85)])
def test_v_f_of_a_flat_fruit_behind_a_leaf_counts_its_own_outline(camera: tuple[float, float, float]) -> None:
    fruits = FruitMap()
    for clear in CAMERAS:
        fruits.update(DETECTOR.measure(cast(clear, [FRUIT])))
    pose = look_from(camera)
    # The leaf's upper edge lies a third of a radius below the middle, for a camera whose y axis points down.
    leaf = FRUIT - 0.08 * pose[:3, 2] + (0.04 + RADIUS / 3.0) * pose[:3, 1]
    whole, hidden = cast(camera, [FRUIT]), cast(camera, [FRUIT], leaf=leaf)
    assert whole.true_fruits is not None and hidden.true_fruits is not None
    truth = np.count_nonzero(hidden.true_fruits.masks) / np.count_nonzero(whole.true_fruits.masks)
    view = fruits.update(DETECTOR.measure(hidden))
    number = only(fruits)
    fraction = fruits.fraction(view.measurement, view.detection(number), number)
    assert 0.5 < truth < 0.85
    # A pixel is 3 mm there. By a circle `single` is 0.07 too small.
    assert fraction.fused == pytest.approx(truth, abs=0.045)
    assert fraction.single == pytest.approx(truth, abs=0.045)


@pytest.mark.parametrize(("apart", "left"), [(0.025, [0.0]), (0.055, [0.0, 0.055])])
def test_of_two_well_known_tracks_in_one_place_the_better_known_stays(
    apart: float, left: list[float]
) -> None:
    fruits = FruitMap()
    for number, (y, deviation) in enumerate(((apart, 0.005), (0.0, 0.002))):
        fruits.tracks[number] = Track(
            number=number,
            mean=np.array([0.5, y, 0.6, 0.032]),
            covariance=deviation**2 * np.eye(4),
            existence_log_odds=8.0,
            apart_from={1 - number},
        )
    fruits.update(DETECTOR.measure(cast(CAMERAS[0], [])))
    assert sorted(round(float(track.position_w[1]), 6) for track in fruits.tracks.values()) == left
    assert fruits.current(1) == (0 if len(left) == 1 else 1)


def test_the_map_learns_the_size_of_a_crop_from_fruits_that_it_sees_whole() -> None:
    fruits = FruitMap()
    before = fruits.crop
    near = 0.5 * (np.array(CAMERAS[0]) + FRUIT)
    fruits.update(DETECTOR.measure(cast((near[0], near[1], near[2]), [FRUIT])))
    assert fruits.crop.radius_error < 0.5 * before.radius_error
    assert abs(np.log(fruits.crop.radius_m / RADIUS)) < 0.1
