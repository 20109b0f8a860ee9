"""Where on the first view's axis a fruit is looked for that no view has shown."""

import numpy as np
import pytest
from numpy.typing import NDArray

from maniskill_tomato.robot.d435 import color_intrinsics
from maniskill_tomato.sensing.axis_search import AxisSearch
from maniskill_tomato.sensing.fruit_map import MapConfig, Track
from maniskill_tomato.sensing.measurement import Measurement
from maniskill_tomato.sensing.posed_frame import PosedFrame

RADIUS = 0.027
"""Of all fruits, in [m]."""

POSE = np.eye(4)
"""A camera at the origin that looks along z."""


def fruit(*position: float) -> Track:
    return Track(
        number=0, mean=np.array([*position, RADIUS]), covariance=np.eye(4) * 1e-6, existence_log_odds=8.0
    )


def view(depth: float, pose: NDArray[np.float64] = POSE) -> Measurement:
    intrinsics = color_intrinsics(320, 240)
    frame = PosedFrame(
        depth_m=np.full((240, 320), depth, np.float32), intrinsics=intrinsics, T_world_camera=pose
    )
    return Measurement(frame=frame, fruits=())


@pytest.mark.parametrize("wall", [0.4, 0.6, 0.8])
def test_a_fruit_that_was_not_seen_in_front_of_a_leaf_is_looked_for_behind_it(wall: float) -> None:
    search = AxisSearch(POSE, MapConfig())
    for _ in range(2):
        search.miss(view(wall))
    assert wall < search.place([], RADIUS)[2] < wall + 0.2


@pytest.mark.parametrize("distance", [0.35, 0.5, 0.7])
def test_a_fruit_is_looked_for_beside_other_fruits_and_not_in_them(distance: float) -> None:
    search = AxisSearch(POSE, MapConfig())
    assert search.place([fruit(0.06, 0.0, distance)], RADIUS)[2] == pytest.approx(distance, abs=0.05)
    inside = fruit(0.0, 0.0, distance)
    assert 0.03 < np.linalg.norm(search.place([inside], RADIUS) - inside.position_w) < 0.15


def test_a_place_that_another_view_shows_empty_is_given_up() -> None:
    search = AxisSearch(POSE, MapConfig())
    search.miss(view(0.3))
    before = search.place([], RADIUS)
    aside = np.eye(4)
    # From the right, half a metre beside the axis, everything before a wall far behind it is in sight.
    aside[:3, :3] = [[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]
    aside[:3, 3] = [0.5, 0.0, before[2]]
    search.miss(view(2.0, aside))
    assert np.linalg.norm(search.place([], RADIUS) - before) > 0.05
