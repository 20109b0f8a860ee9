"""A fruit that somebody pointed at in a picture, and which track of the map it is.

The pixels that were pointed at stay true when the map changes its mind: a sliver behind a leaf may be placed wrongly,
or taken for the fruit beside it, but the fruit that it belongs to lies on the rays through its pixels.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from maniskill_tomato.sensing.fruit_map import NO_TRACK, FruitMap, MappedView, Track
from maniskill_tomato.sensing.measurement import Position
from maniskill_tomato.sensing.visible_fraction.estimate import Float64, fruit_depth

PIXELS: Final = 64
"""Of a fruit so many pixels are kept at most."""

WELL_KNOWN: Final = 0.25
"""A place is known well enough to tell which pixels a fruit fills, if its standard deviation is less than this share of
the radius."""

OWN_SHARE: Final = 0.6
"""A track that stands nearest on so many of the pixels is the fruit."""

OTHER_SHARE: Final = 0.3
"""A well-known track that covers fewer of them is not."""

DEPTH_GATE: Final = 1.0
"""Where depth was measured, a track's surface is so many radii from it at most, beside its own uncertainty."""


@dataclass(frozen=True, eq=False, kw_only=True)
class PointedFruit:
    """The pixels of a fruit in one picture, as rays."""

    origin_w: Position
    """Of the camera, world frame, in [m]. Shape (3,)."""
    directions_w: Float64
    """Unit vectors through the pixels, world frame. Shape (n, 3)."""
    distance_m: float
    """From the camera to the visible surface, in [m]; NaN where no depth was measured."""
    beside: frozenset[int]
    """Tracks of the other detections of that picture."""

    @classmethod
    def of(cls, view: MappedView, fruit: int) -> "PointedFruit":
        """The pixels of a detection.

        Args:
            view: The picture.
            fruit: Index in its fruits.
        """
        frame, mask = view.measurement.frame, view.measurement.mask(fruit)
        rows, columns = np.nonzero(mask)
        chosen = np.linspace(0, len(rows) - 1, min(len(rows), PIXELS)).astype(int)
        pixels = np.stack([columns[chosen] + 0.5, rows[chosen] + 0.5], axis=1)
        rays = frame.intrinsics.ray_directions(pixels)
        lengths = np.linalg.norm(rays, axis=1)
        return cls(
            origin_w=frame.T_world_camera[:3, 3],
            directions_w=rays / lengths[:, None] @ frame.T_world_camera[:3, :3].T,
            distance_m=fruit_depth(frame.measured_m, mask) * float(lengths.mean()),
            beside=frozenset(view.tracks) - {view.tracks[fruit], NO_TRACK},
        )

    def surfaces(self, tracks: Sequence[Track]) -> Float64:
        """How far away each track's surface is on each ray, in [m]. Shape (n, K).

        Infinite where the ray misses it, or where depth was measured and is another.
        """
        away = np.stack([track.position_w for track in tracks]) - self.origin_w
        radius = np.array([track.radius_m for track in tracks])
        along = self.directions_w @ away.T
        beside = np.maximum((away**2).sum(1) - along**2, 0.0)
        surface = along - np.sqrt(np.maximum(radius**2 - beside, 0.0))
        hit = (beside < radius**2) & (along > 0.0)
        if np.isfinite(self.distance_m):
            deviation = np.array([track.deviation_m for track in tracks])
            hit &= np.abs(surface - self.distance_m) < DEPTH_GATE * radius + 2.0 * deviation
        return np.where(hit, surface, np.inf)


def identified(pointed: Sequence[PointedFruit], fruits: FruitMap, now: int | None) -> int | None:
    """The track that was pointed at.

    Args:
        pointed: Pictures in which it was, one or more.
        fruits: The map.
        now: The track that it is taken for; None for none.

    Returns:
        The present one if it is well known and covers the pixels, or if there is no better one; else the well-known
        track that stands nearest on most of them.
    """
    present = None if now is None else fruits.tracks.get(now)
    if present is not None and _is_well_known(present):
        covered = [np.isfinite(fruit.surfaces([present])).mean() for fruit in pointed]
        if np.mean(covered) > OTHER_SHARE:
            return now
    others = {fruits.current(number) for fruit in pointed for number in fruit.beside}
    known = [
        track
        for track in fruits.tracks.values()
        if track.is_ripe and _is_well_known(track) and track.number not in others
    ]
    if not known:
        return now
    shares = np.zeros(len(known))
    for fruit in pointed:
        surface = fruit.surfaces(known)
        nearest = surface.argmin(1)[np.isfinite(surface).any(1)]
        shares += np.bincount(nearest, minlength=len(known)) / (len(surface) * len(pointed))
    best = int(shares.argmax())
    return known[best].number if shares[best] > OWN_SHARE else now


def _is_well_known(track: Track) -> bool:
    return track.deviation_m < WELL_KNOWN * track.radius_m
