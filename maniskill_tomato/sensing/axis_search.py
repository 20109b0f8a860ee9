"""How far along the first view's optical axis a fruit stands that no view has shown.

A robot that is to find a fruit begins by looking towards it. Fruits hang near other fruits; where one of these stands
there is no second; and it is unlikely at a place that views have shown well without a fruit in it.
"""

from collections.abc import Iterable
from typing import Final

import numpy as np

from maniskill_tomato.sensing.fruit_map import MapConfig, Track, shown_of_sphere
from maniskill_tomato.sensing.measurement import Measurement, Position
from maniskill_tomato.sensing.visible_fraction.estimate import Float64

NEAREST: Final = 0.2
"""The nearest place, in [m]."""

FARTHEST: Final = 1.3
"""The farthest, in [m]."""

STEP: Final = 0.01
"""From one place to the next, in [m]."""

USUAL_DISTANCE: Final = 0.5
"""How far away fruits are that a robot begins to look at, in [m]."""

DISTANCE_SPREAD: Final = 0.15
"""Standard deviation of that, in [m]."""

NEIGHBOUR_DISTANCE: Final = 0.06
"""Standard deviation of a fruit's place about that of a neighbour, in [m]."""

ALONE: Final = 0.1
"""How likely a place far from all known fruits is, where one at a known fruit has 1."""

LARGEST_SPREAD: Final = 0.03
"""Fruits whose place is less certain say nothing of their neighbours, in [m]."""

SOLID_SPREAD: Final = 0.015
"""Nor do those whose place is less certain than this keep others from it, in [m]."""

SOLID_SHARE: Final = 0.85
"""Fruits that touch are as far apart as this share of the sum of their radii, since they are flat."""

SOLID: Final = 0.8
"""How sure it is that a fruit that was found is another one."""

BLUR: Final = 0.03
"""The place that is looked at has most of the probability about it, within this standard deviation, in [m]."""


class AxisSearch:
    """What views have told about the places along one axis."""

    def __init__(self, T_world_camera: Float64, config: MapConfig) -> None:
        """Begins before any view.

        Args:
            T_world_camera: Pose of the optical frame of the first view. Shape (4, 4).
            config: Of the fruits.
        """
        self._config = config
        self._distances = np.arange(NEAREST, FARTHEST, STEP)
        axis = T_world_camera[:3, 2]
        self._places: Float64 = T_world_camera[:3, 3] + self._distances[:, None] * axis
        self._missed = np.ones(len(self._distances))

    def miss(self, measurement: Measurement) -> None:
        """Takes in a view in which the fruit was not found."""
        frame, radius = measurement.frame, measurement.crop.radius_m
        for k, place in enumerate(self._places):
            shown = shown_of_sphere(np.array([*place, radius]), frame, frame.unshadowed_m)
            if shown is not None:
                self._missed[k] *= 1.0 - self._config.detection_rate * shown

    def place(self, tracks: Iterable[Track], radius_m: float) -> Position:
        """The likeliest place, world frame, in [m], by the views and the other fruits. Shape (3,).

        Args:
            tracks: The other fruits.
            radius_m: Of a fruit that was not found yet, in [m].
        """
        near, free = np.full(len(self._places), ALONE), np.ones(len(self._places))
        for track in tracks:
            apart = np.linalg.norm(self._places - track.position_w, axis=1)
            spread = float(np.sqrt(track.covariance[:3, :3].trace()))
            if spread < LARGEST_SPREAD:
                near += track.existence * np.exp(-0.5 * (apart / NEIGHBOUR_DISTANCE) ** 2)
            if spread < SOLID_SPREAD:
                touching = SOLID_SHARE * (track.radius_m + radius_m)
                free[apart < touching] *= 1.0 - SOLID * track.existence
        usual = np.exp(-0.5 * ((self._distances - USUAL_DISTANCE) / DISTANCE_SPREAD) ** 2)
        blur = np.exp(-0.5 * ((self._distances[:, None] - self._distances) / BLUR) ** 2)
        place: Position = self._places[int(np.argmax(blur @ (usual * near * free * self._missed)))]
        return place
