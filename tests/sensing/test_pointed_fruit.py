"""Which track somebody pointed at in a picture, against spheres whose outlines are drawn into it."""

import numpy as np
import pytest

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.robot.d435 import CameraIntrinsics
from maniskill_tomato.segmentation.instances import Instances
from maniskill_tomato.sensing.camera_perception import CameraPerception
from maniskill_tomato.sensing.fruit_detector import FruitDetector
from maniskill_tomato.sensing.fruit_map import FruitMap, MappedView, Track
from maniskill_tomato.sensing.measurement import Position
from maniskill_tomato.sensing.pointed_fruit import PointedFruit, identified
from maniskill_tomato.sensing.posed_frame import PosedFrame

INTRINSICS = CameraIntrinsics(width=160, height=120, fx=150.0, fy=150.0, cx=80.0, cy=60.0)
RADIUS = 0.03
TARGET = np.array([0.0, 0.0, 0.5])
BESIDE = np.array([0.055, 0.0, 0.48])
SLIVER = 0


def surface(centre: Position) -> np.ndarray:
    """Depth of a sphere before the camera, in [m], infinite where it is not. Shape (120, 160)."""
    rows, columns = np.mgrid[:120, :160] + 0.5
    rays = np.stack([(columns - 80.0) / 150.0, (rows - 60.0) / 150.0, np.ones_like(rows)], -1)
    a, b = (rays**2).sum(-1), rays @ centre
    inside = b**2 - a * (centre @ centre - RADIUS**2)
    return np.where(inside > 0, (b - np.sqrt(np.maximum(inside, 0.0))) / a, np.inf)


def picture() -> tuple[FruitDetector, PosedFrame]:
    """A target of which a leaf leaves a sliver, and a neighbour wholly in view; the detector knows both masks."""
    target, neighbour = surface(TARGET), surface(BESIDE)
    leaf = np.zeros((120, 160), np.bool_)
    leaf[:, :85] = True
    masks = np.stack([(target < neighbour) & ~leaf, (neighbour < target) & ~leaf])
    depth = np.minimum(np.minimum(target, neighbour), 1.2)
    depth[leaf] = 0.35
    frame = PosedFrame(
        depth_m=depth.astype(np.float32),
        intrinsics=INTRINSICS,
        T_world_camera=np.eye(4),
        rgb=np.zeros((120, 160, 3), np.uint8),
    )
    found = Instances.from_masks(masks, np.ones(2, np.float32), ("tomato_ripe",) * 2)
    return FruitDetector(lambda image, depth_m=None: found), frame


def pointed(fruit: int, tracks: tuple[int, int] = (0, 1)) -> PointedFruit:
    detector, frame = picture()
    return PointedFruit.of(MappedView(measurement=detector.measure(frame), tracks=tracks), fruit)


def map_of(*tracks: tuple[Position, float]) -> FruitMap:
    """Tracks at places with a standard deviation of each coordinate, in [m]."""
    fruits = FruitMap()
    for number, (place, deviation) in enumerate(tracks):
        covariance = np.diag([deviation**2] * 3 + [0.001**2])
        fruits.tracks[number] = Track(
            number=number, mean=np.array([*place, RADIUS]), covariance=covariance, ripe_log_odds=3.0
        )
    return fruits


def test_a_track_that_turns_out_to_be_the_fruit_beside_gives_the_target_to_the_one_on_its_pixels() -> None:
    fruits = map_of((BESIDE, 0.002), (TARGET, 0.002))
    assert identified([pointed(SLIVER, (0, 7))], fruits, 0) == 1


def test_a_badly_placed_sliver_gives_the_target_to_the_well_known_track_on_its_pixels() -> None:
    behind = TARGET + np.array([0.0, 0.0, 0.06])
    fruits = map_of((behind, 0.028), (TARGET, 0.002))
    assert identified([pointed(SLIVER, (0, 7))], fruits, 0) == 1


def test_a_well_known_track_on_the_pixels_stays_the_target_whatever_stands_before_it() -> None:
    before = TARGET - np.array([0.0, 0.0, 0.03])
    fruits = map_of((TARGET, 0.002), (before, 0.004))
    assert identified([pointed(SLIVER, (7, 8))], fruits, None) == 1
    assert identified([pointed(SLIVER, (0, 7))], fruits, 0) == 0


def test_a_fruit_that_the_picture_shows_beside_is_not_the_target() -> None:
    fruits = map_of((TARGET + 0.2, 0.03), (TARGET, 0.002))
    assert identified([pointed(SLIVER, (0, 1))], fruits, 0) == 0


def test_tracks_that_are_not_well_known_or_miss_the_pixels_are_not_the_target() -> None:
    fruits = map_of((TARGET + 0.2, 0.03), (TARGET, 0.02), (TARGET + np.array([0.0, 0.1, 0.0]), 0.002))
    assert identified([pointed(SLIVER, (0, 7))], fruits, 0) == 0
    assert identified([pointed(SLIVER, (0, 7))], FruitMap(), None) is None


def test_a_robot_that_was_pointed_at_a_fruit_looks_at_its_track() -> None:
    detector, frame = picture()
    perception = CameraPerception(1, detector)
    with pytest.raises(InvalidInputError, match="before the first view"):
        perception.point(0, 0)
    perception.begin(0)
    perception.look([frame])
    view = perception.last_view(0)
    assert view is not None
    order = [float(np.linalg.norm(fruit.centre_w - BESIDE)) for fruit in view.measurement.fruits]
    perception.point(0, int(np.argmin(order)))
    assert bool(perception.is_located[0]) and perception.target_fruit(0) == int(np.argmin(order))
    assert float(np.linalg.norm(perception.position_w(0) - BESIDE)) < 0.006
