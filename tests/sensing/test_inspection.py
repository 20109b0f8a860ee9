"""The inspection of a row, against tracks and spheres whose truth is known."""

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from maniskill_tomato.robot.d435 import color_intrinsics
from maniskill_tomato.robot.look_at import look_at_pose
from maniskill_tomato.segmentation.instances import Instances
from maniskill_tomato.sensing.fruit_detector import FruitDetector
from maniskill_tomato.sensing.fruit_map import FruitMap, MapConfig, Track
from maniskill_tomato.sensing.inspection import LOST_AFTER, Aim, Inspection
from maniskill_tomato.sensing.measurement import Measurement
from maniskill_tomato.sensing.posed_frame import PosedFrame
from maniskill_tomato.sensing.view_lattice import ViewLattice
from maniskill_tomato.sensing.visible_fraction.crop import FLATNESS

Place = NDArray[np.float64]

INTRINSICS = color_intrinsics(160, 120)
RADIUS = 0.027
HERE = np.array([0.4, 0.0, 0.5])
BEHIND = 0.95
"""Depth of what stands behind the fruits, in [m]."""


@pytest.fixture(scope="module")
def lattice() -> ViewLattice:
    return ViewLattice()


def track(number: int, place: tuple[float, float, float], *, deviation: float = 0.003) -> Track:
    return Track(
        number=number,
        mean=np.array([*place, RADIUS]),
        covariance=np.diag([deviation**2] * 3 + [0.001**2]),
        ripe_log_odds=3.0,
        existence_log_odds=3.0,
        views=4,
    )


def map_of(*tracks: Track) -> FruitMap:
    fruits = FruitMap()
    fruits.tracks = {one.number: one for one in tracks}
    return fruits


def view_of(centre: Place | None, *, hidden: float = 0.0) -> Measurement:
    """A red, flat tomato seen from `HERE` before a wall, a share of its pixels from the left hidden by a near leaf.

    Without a centre the wall alone.
    """
    towards = np.array([0.8, 0.0, 0.5]) if centre is None else centre
    pose = look_at_pose(torch.as_tensor(HERE)[None], torch.as_tensor(towards)[None])[0].numpy()
    depth = np.full((120, 160), BEHIND)
    mask = np.zeros(depth.shape, np.bool_)
    if centre is not None:
        rays = INTRINSICS.ray_directions(INTRINSICS.pixel_centres())
        # It is a sphere in a world that is stretched upwards.
        stretch = pose[:3, :3].T @ np.diag([1.0, 1.0, 1.0 / FLATNESS]) @ pose[:3, :3]
        rays, local = rays @ stretch, stretch @ pose[:3, :3].T @ (centre - pose[:3, 3])
        square, along = (rays**2).sum(-1), rays @ local
        inside = along**2 - square * (local @ local - RADIUS**2)
        hit = inside > 0.0
        depth[hit] = ((along - np.sqrt(np.maximum(inside, 0.0))) / square)[hit]
        columns = np.nonzero(hit)[1]
        cut = np.quantile(columns, hidden) if hidden else -1
        covered = hit & (np.arange(160)[None] < cut)
        depth[covered] = 0.25
        mask = hit & ~covered
    masks = mask[None] if mask.any() else np.zeros((0, *mask.shape), np.bool_)
    frame = PosedFrame(
        depth_m=depth.astype(np.float32),
        intrinsics=INTRINSICS,
        T_world_camera=pose,
        rgb=np.tile(np.array([200, 40, 30], np.uint8), (120, 160, 1)),
        true_fruits=Instances.from_masks(masks, categories=("tomato_ripe",) * len(masks)),
    )
    return FruitDetector(None).measure(frame)


def inspection(**changes: object) -> Inspection:
    return Inspection(**{"threshold": 0.8, "stop_errors": 1.0, "scan_places": (), **changes})  # type: ignore[arg-type]


def test_the_nearest_fruit_in_reach_is_next_and_one_of_uncertain_place_is_not(lattice: ViewLattice) -> None:
    fruits = map_of(
        track(0, (0.8, 0.3, 0.5)),
        track(1, (0.8, 0.1, 0.5)),
        track(2, (0.7, 0.0, 0.5), deviation=0.05),
        track(3, (2.5, 0.0, 0.5)),
    )
    aim = inspection().next(fruits, HERE, lattice)
    assert aim is not None and aim.track == 1
    np.testing.assert_array_equal(aim.position_w, fruits.tracks[1].position_w)


def test_an_unripe_fruit_or_one_that_hardly_exists_is_not_looked_at(lattice: ViewLattice) -> None:
    unripe, unsure = track(0, (0.8, 0.0, 0.5)), track(1, (0.8, 0.1, 0.5))
    unripe.ripe_log_odds = unsure.existence_log_odds = -1.0
    row = inspection()
    assert row.next(map_of(unripe, unsure), HERE, lattice) is None and row.is_over


def test_a_fruit_that_is_seen_fully_is_done_and_its_fragments_are_not_looked_at(lattice: ViewLattice) -> None:
    row, fruits = inspection(), FruitMap()
    place = np.array([0.75, 0.02, 0.5])
    assert row.take_in(fruits, fruits.update(view_of(place, hidden=0.5))) == []
    (number,) = fruits.tracks
    aim = row.next(fruits, HERE, lattice)
    assert aim is not None and aim.track == number and not row.is_done(fruits, 1, 20)
    assert row.take_in(fruits, fruits.update(view_of(place))) == [number]
    assert row.is_full(number) and row.is_done(fruits, 2, 20)
    fruits.tracks[9] = track(9, (0.765, 0.02, 0.5))
    assert row.next(fruits, HERE, lattice) is None and row.is_over


def test_of_two_tracks_that_are_one_fruit_only_the_better_known_is_looked_at(lattice: ViewLattice) -> None:
    known, fragment = track(1, (0.8, 0.0, 0.5)), track(2, (0.78, 0.0, 0.5))
    known.views, fragment.views = 9, 2
    fruits, looks = map_of(known, fragment), inspection()
    aim = looks.next(fruits, HERE, lattice)
    assert aim is not None and aim.track == 1, "though the fragment is nearer"
    looks.aim = Aim(fragment.position_w, 2)
    assert looks.is_done(fruits, moves=1, max_moves=20)


def test_the_list_tells_where_a_fruit_is_and_from_where_it_is_seen_fully() -> None:
    row, fruits = inspection(), FruitMap()
    place = np.array([0.75, 0.02, 0.5])
    for hidden in (0.5, 0.0, 0.6):
        row.take_in(fruits, fruits.update(view_of(place, hidden=hidden)))
    (listed,) = row.fruits(fruits)
    # A pixel is 3 mm there.
    np.testing.assert_allclose(listed.position_w, place, atol=0.004)
    assert listed.radius_m == pytest.approx(RADIUS, abs=0.002)
    assert listed.is_ripe and listed.is_fully_seen and listed.visible_fraction > 0.9
    assert listed.best is not None and listed.best.view == 1 and listed.best.picture is not None
    towards = (HERE - place) / np.linalg.norm(HERE - place)
    assert listed.approach_w is not None
    np.testing.assert_allclose(listed.approach_w, towards, atol=0.02)


def test_a_fruit_listed_twice_is_listed_once() -> None:
    fruits = map_of(track(0, (0.8, 0.0, 0.5)), track(1, (0.81, 0.01, 0.5)), track(2, (0.8, 0.08, 0.5)))
    fruits.tracks[1].views = 9
    assert [fruit.number for fruit in inspection().fruits(fruits)] == [1, 2]


def test_a_fruit_that_no_view_shows_is_given_up(lattice: ViewLattice) -> None:
    row, fruits = inspection(), map_of(track(0, (0.8, 0.3, 0.5)))
    assert row.next(fruits, HERE, lattice) is not None
    for _ in range(LOST_AFTER // 2):  # Half as many, because no view has shown anything of it.
        assert not row.is_done(fruits, 1, 20)
        row.take_in(fruits, fruits.update(view_of(None)))
        fruits.tracks[0] = track(0, (0.8, 0.3, 0.5))
    assert row.is_done(fruits, 1, 20)
    assert row.next(fruits, HERE, lattice) is None and row.is_over


def test_a_fruit_that_was_half_seen_gets_another_chance_when_nothing_else_is_left(
    lattice: ViewLattice,
) -> None:
    row, fruits = inspection(), FruitMap()
    row.take_in(fruits, fruits.update(view_of(np.array([0.75, 0.02, 0.5]), hidden=0.5)))
    (number,) = fruits.tracks
    fruits.tracks[99] = track(99, (0.8, 0.3, 0.5))
    looked_at = []
    while (aim := row.next(fruits, HERE, lattice)) is not None:
        looked_at.append(aim.track)
        assert row.is_done(fruits, 20, 20)
    assert looked_at == [number, 99, number]


def test_a_fruit_is_given_up_after_its_moves(lattice: ViewLattice) -> None:
    row, fruits = inspection(), map_of(track(0, (0.8, 0.3, 0.5)))
    row.next(fruits, HERE, lattice)
    assert not row.is_done(fruits, 19, 20) and row.is_done(fruits, 20, 20)


def test_parts_of_the_row_that_no_view_has_shown_are_looked_at_once(lattice: ViewLattice) -> None:
    shown, unshown = (0.85, 0.0, 0.5), (0.85, 0.6, 0.5)
    row, fruits = inspection(scan_places=(shown, unshown)), FruitMap()
    row.take_in(fruits, fruits.update(view_of(None)))
    aim = row.next(fruits, HERE, lattice)
    assert aim is not None and aim.track is None
    np.testing.assert_array_equal(aim.position_w, unshown)
    assert row.is_done(fruits, 1, 20)
    assert row.next(fruits, HERE, lattice) is None and row.is_over


def test_a_part_behind_something_near_is_not_shown(lattice: ViewLattice) -> None:
    behind = (1.1, 0.0, 0.5)
    row, fruits = inspection(scan_places=(behind,)), FruitMap()
    frame = view_of(None)
    frame.frame.depth_m[:] = 0.3
    row.take_in(fruits, fruits.update(frame))
    assert row.next(fruits, HERE, lattice) is not None


def test_knowledge_of_a_track_goes_over_to_the_one_that_takes_it_in() -> None:
    row = inspection()
    fruits = FruitMap(MapConfig())
    place = np.array([0.75, 0.02, 0.5])
    row.take_in(fruits, fruits.update(view_of(place)))
    (number,) = fruits.tracks
    # A second track at the same place, from a view of something else, is one with the first.
    fruits.tracks[7] = track(7, (0.751, 0.02, 0.5), deviation=0.01)
    row.given_up[7] = 1
    row.take_in(fruits, fruits.update(view_of(None)))
    assert fruits.current(7) == number and row.is_full(number) and row.given_up == {number: 1}


def test_a_fruit_of_which_nobody_knows_how_far_away_it_is_is_worth_one_move_at_last(
    lattice: ViewLattice,
) -> None:
    unsure, beside = track(5, (0.8, 0.0, 0.5), deviation=0.05), track(6, (0.8, 0.05, 0.5), deviation=0.05)
    row, fruits = inspection(), map_of(unsure, beside, track(0, (0.8, 0.5, 0.5)))
    aim = row.next(fruits, HERE, lattice)
    assert aim is not None and aim.track == 0, "first those whose place is known"
    del fruits.tracks[0]
    aim = row.next(fruits, HERE, lattice)
    assert aim is not None and aim.track is None
    np.testing.assert_array_equal(aim.position_w, unsure.position_w)
    assert not row.is_done(fruits, 0, 20) and row.is_done(fruits, 1, 20)
    assert row.next(fruits, HERE, lattice) is None, "the same move was for the one beside it"


def test_a_piece_of_a_known_fruit_is_not_looked_for(lattice: ViewLattice) -> None:
    piece, faint = track(5, (0.8, 0.0, 0.5), deviation=0.05), track(6, (0.8, 0.3, 0.5), deviation=0.05)
    faint.existence_log_odds = 0.5
    row, fruits = inspection(), map_of(piece, faint, track(0, (0.84, 0.02, 0.5)))
    row.given_up[0] = 2
    assert row.next(fruits, HERE, lattice) is None and row.is_over


def test_where_more_views_did_not_help_v_f_itself_decides_and_not_its_lower_bound(
    lattice: ViewLattice,
) -> None:
    row, fruits = inspection(), FruitMap()
    row.take_in(fruits, fruits.update(view_of(np.array([0.75, 0.02, 0.5]), hidden=0.2)))
    (number,) = fruits.tracks
    assert not row.is_full(number)
    assert row.next(fruits, HERE, lattice) is not None
    row.give_up(number)
    assert row.is_full(number)
    (listed,) = row.fruits(fruits)
    assert listed is not None and listed.is_fully_seen and listed.visible_fraction > 0.8
    assert listed.visible_fraction - listed.fraction_error < 0.8
    assert row.next(fruits, HERE, lattice) is None, "so that it is not looked at again"
