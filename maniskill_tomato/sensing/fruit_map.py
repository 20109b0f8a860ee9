"""A map of fruits: tracks over views, each a sphere in the world with its uncertainty.

A detection is a sphere fitted to a mask and depth. `FruitMap.update` assigns the detections of a view to the tracks
jointly: the sum of their log likelihood ratios against new fruits is largest (`scipy.optimize.linear_sum_assignment`),
none farther than the chi-square gate allows. Each track is a Kalman filter of (x, y, z, radius); what is left begins
new tracks. Tracks that are more likely one sphere than two are merged, and a mask that covers several tracks is
divided among them. A track that a view does not show although it should have loses existence; one that is hidden in
it does not.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.robot.d435 import CameraIntrinsics
from maniskill_tomato.segmentation.masks import BinaryMask
from maniskill_tomato.sensing.measurement import DetectedFruit, Measurement, Position
from maniskill_tomato.sensing.posed_frame import PosedFrame
from maniskill_tomato.sensing.visible_fraction.crop import CropShape, WholeFruit
from maniskill_tomato.sensing.visible_fraction.estimate import Float64
from maniskill_tomato.sensing.visible_fraction.sphere import SphereConfig, round_outline, whole_silhouette

GATE: Final = 19.997355
"""Largest squared Mahalanobis distance of a detection from the track that it is assigned to: 99.95 % of chi-square
with four degrees of freedom."""

MERGE_GATE: Final = 13.276704
"""Largest squared Mahalanobis distance of two tracks that are merged: 99 % of it."""


@dataclass(frozen=True, kw_only=True)
class MapConfig:
    """Errors of detections and habits of fruits, measured on validation plants."""

    lateral_error_m: float = 0.0015
    """Standard deviation across the viewing direction of the centre of a wholly visible fruit, in [m]."""
    depth_error_m: float = 0.003
    """The same along it, in [m]."""
    radius_error_m: float = 0.0015
    """The same of the radius, in [m]."""
    lateral_growth: float = 1.6
    """Natural logarithm of how many times larger it is for a fruit that is all but hidden."""
    depth_growth: float = 1.6
    """The same along the viewing direction."""
    radius_growth: float = 1.4
    """The same of the radius."""
    few_pixels: float = 30.0
    """Visible pixels at which the variances are twice as large."""
    fruit_density: float = 1000.0
    """Fruits in a cubic metre of a truss, in [1/m^3]: how likely another fruit stands at a place beside a known one."""
    detection_rate: float = 0.95
    """Share of the well visible fruits that a view's detections hold."""
    false_rate: float = 0.05
    """Share of the detections that are no fruit."""
    ripeness_rate: float = 0.95
    """Share of the fruits whose ripeness is told correctly."""
    ripe_redness: float = 0.51
    """Redness (`DetectedFruit.redness`) that is as likely of a ripe fruit as of one that turns. On validation plants
    ripe fruits have 0.58 or more and turning ones 0.44 or less."""
    redness_slope: float = 60.0
    """Log-odds of being ripe that a redness larger by 1 adds."""
    single_error: float = 0.10
    """Standard error of one image's V_f of a fruit that is half visible; see `fraction_error`."""
    fused_error: float = 0.065
    """The same for V_f by the map's sphere."""
    error_scale: float = 1.0
    """Standard error of both together over that of two independent estimates."""
    stop_errors: float = 0.75
    """A fruit is taken for fully visible when V_f less so many standard errors is above the threshold."""


@dataclass(eq=False, kw_only=True)
class Track:
    """One fruit."""

    number: int
    """Its name in the map; no two tracks have had the same."""
    mean: Float64
    """Centre in the world frame and radius, in [m]. Shape (4,)."""
    covariance: Float64
    """Of these, in [m^2]. Shape (4, 4)."""
    ripe_log_odds: float = 0.0
    """Of being ripe."""
    existence_log_odds: float = 0.0
    """Of being a fruit at all."""
    views: int = 0
    """Views that it was detected in."""
    apart_from: set[int] = field(default_factory=set)
    """Numbers of tracks that were detected beside it in one view: they are other fruits."""
    seen_whole: WholeFruit | None = None
    """Size and shape in the last view that showed all of it."""

    @property
    def position_w(self) -> Position:
        """Centre in the world frame, in [m]. Shape (3,)."""
        return self.mean[:3]

    @property
    def radius_m(self) -> float:
        """In [m]."""
        return float(self.mean[3])

    @property
    def deviation_m(self) -> float:
        """Standard deviation of its place, in [m]."""
        return float(np.sqrt(np.trace(self.covariance[:3, :3])))

    @property
    def is_ripe(self) -> bool:
        """Whether it is more likely ripe than not."""
        return self.ripe_log_odds > 0.0

    @property
    def existence(self) -> float:
        """Probability that there is a fruit."""
        return float(1.0 / (1.0 + np.exp(-self.existence_log_odds)))


@dataclass(frozen=True, kw_only=True)
class Fraction:
    """V_f of a fruit in a view."""

    value: float
    """The estimate."""
    error: float
    """Its standard error."""
    single: float
    """What the view alone says; NaN if nothing."""
    fused: float
    """By the map's sphere; NaN if it does not stand in the view."""

    @classmethod
    def nothing(cls) -> "Fraction":
        """Of a fruit that is not seen."""
        return cls(value=0.0, error=0.0, single=0.0, fused=0.0)


@dataclass(frozen=True, eq=False, kw_only=True)
class MappedView:
    """A view with what the map makes of it."""

    measurement: Measurement
    """The detections, a mask that covered several tracks divided."""
    tracks: tuple[int, ...]
    """Number of each detection's track; `NO_TRACK` where there is none, in a second picture from one place."""

    def detection(self, number: int | None) -> int | None:
        """Index of a track's detection; None if the view has none."""
        return self.tracks.index(number) if number in self.tracks else None


Divide = Callable[[Measurement, int, Sequence[BinaryMask]], Measurement]
"""Measures a view anew with other masks instead of one of its detections."""


class FruitMap:
    """The tracks of one environment."""

    def __init__(self, config: MapConfig | None = None, divide: Divide | None = None) -> None:
        """Begins without a track.

        Args:
            config: Errors and habits; measured defaults if None.
            divide: Divides masks that cover several tracks; if None they stay whole.
        """
        self.config = config or MapConfig()
        self.tracks: dict[int, Track] = {}
        """By their numbers."""
        self.crop = CropShape()
        """What the fruits that were seen whole tell about the size and shape of the others."""
        self._divide = divide
        self._next = 0
        self._merged: dict[int, int] = {}

    def current(self, number: int) -> int | None:
        """What a track is called now that others may have taken it in; None if it is gone."""
        while number in self._merged:
            number = self._merged[number]
        return number if number in self.tracks else None

    def update(self, measurement: Measurement, identities: Sequence[int | None] | None = None) -> MappedView:
        """Takes in a view.

        Args:
            measurement: Its detections.
            identities: Which fruit each detection shows, for a true association: the fruit's number is then its
                track's. None to find out.

        Returns:
            The view with the track of each detection.
        """
        if identities is None:
            measurement = self._divided(measurement)
            numbers = self._assigned(measurement)
        else:
            numbers = self._identified(identities)
        camera = measurement.camera_position
        assigned: list[int] = []
        for fruit, number in zip(measurement.fruits, numbers, strict=True):
            if number is None:
                number, self._next = self._next, self._next + 1
            if number in self.tracks:
                self._correct(self.tracks[number], *self.sphere_of(fruit, camera))
            else:
                self.tracks[number] = self._born(number, *self.sphere_of(fruit, camera))
            self._count(self.tracks[number], fruit)
            assigned.append(number)
        for number in assigned:
            self.tracks[number].apart_from |= set(assigned) - {number}
        self._miss(measurement, set(assigned))
        names = {number: number for number in assigned}
        if identities is None:
            self._merge()
            kept = {number: self.current(number) for number in assigned}
            names = {number: number if now is None else now for number, now in kept.items()}
        self.crop = CropShape.of(
            track.seen_whole
            for track in self.tracks.values()
            if track.is_ripe and track.seen_whole is not None
        )
        return MappedView(measurement=measurement, tracks=tuple(names[number] for number in assigned))

    def again(self, measurement: Measurement, last: MappedView) -> MappedView:
        """A second picture from the place of the last view, which tells nothing more of the tracks that there are.

        The same leaves stand in front of the same fruits, so that its errors are those of the last view.

        Args:
            measurement: The picture's detections.
            last: The view.

        Returns:
            The picture with the track of the detection that each overlaps with, else with the one that it is assigned
            to; `NO_TRACK` where there is none.
        """
        measurement = self._divided(measurement)
        before = [last.measurement.mask(k) for k in range(len(last.tracks))]
        tracks: list[int | None] = []
        for k in range(len(measurement.fruits)):
            mask = measurement.mask(k)
            overlaps = [np.count_nonzero(mask & m) / np.count_nonzero(mask | m) for m in before]
            best = int(np.argmax(overlaps)) if overlaps else None
            same = best is not None and overlaps[best] > SAME_OVERLAP
            tracks.append(self.current(last.tracks[best]) if best is not None and same else None)
        for k, assigned in enumerate(self._assigned(measurement)):
            if tracks[k] is None and assigned not in tracks:
                tracks[k] = assigned
        return MappedView(
            measurement=measurement, tracks=tuple(NO_TRACK if number is None else number for number in tracks)
        )

    def sphere_of(self, fruit: DetectedFruit, camera: Position) -> tuple[Float64, Float64]:
        """A detection as a measurement of centre and radius.

        Along the viewing direction it is less certain than across, and the less of the fruit is visible the less it is
        certain.

        Args:
            fruit: The detection.
            camera: Where it was seen from, world frame, in [m]. Shape (3,).

        Returns:
            Mean and covariance, world frame, in [m] and [m^2]. Shapes (4,), (4, 4).
        """
        c = self.config
        is_known = fruit.is_depth_measured and np.isfinite(fruit.visible_fraction)
        fraction = fruit.visible_fraction if is_known else 0.0
        hidden, few = 1.0 - fraction, 1.0 + c.few_pixels / max(fruit.pixels, 1)
        lateral = few * (c.lateral_error_m * np.exp(c.lateral_growth * hidden)) ** 2
        along = few * (c.depth_error_m * np.exp(c.depth_growth * hidden)) ** 2
        radius = few * (c.radius_error_m * np.exp(c.radius_growth * hidden)) ** 2
        centre, radius_m = fruit.centre_w, fruit.radius_m
        if not fruit.is_depth_measured:
            along = max(UNMEASURED_DEPTH, UNMEASURED_SHARE * float(np.linalg.norm(centre - camera))) ** 2
            radius += self.crop.radius_spread_m**2
        if not np.isfinite(radius_m):
            radius_m, radius = self.crop.radius_m, self.crop.radius_spread_m**2
        away = (centre - camera) / max(float(np.linalg.norm(centre - camera)), 1e-9)
        covariance = np.zeros((4, 4))
        covariance[:3, :3] = lateral * np.eye(3) + (along - lateral) * np.outer(away, away)
        covariance[3, 3] = radius
        return np.array([*centre, radius_m]), covariance

    def fraction(self, measurement: Measurement, index: int | None, number: int | None) -> Fraction:
        """V_f of a track in a view: that of the single image and that by the map's sphere, weighted by their variances.

        A view without depth of the fruit, from too near or in the shadow of a leaf, says nothing by itself.

        Args:
            measurement: The view.
            index: The track's detection; None if it has none, which makes V_f 0.
            number: The track.
        """
        if index is None or number is None:
            return Fraction.nothing()
        c, fruit, track = self.config, measurement.fruits[index], self.tracks[number]
        single = float(fruit.visible_fraction)
        fused = _fused_fraction(measurement, index, track, self.crop.flatness)
        parts = []
        if np.isfinite(single) and fruit.is_depth_measured:
            parts.append((single, fraction_error(single, c.single_error)))
        if np.isfinite(fused):
            # What is not known of the radius counts as far as something hides the outline.
            radius = 2.0 * float(np.sqrt(track.covariance[3, 3])) / track.radius_m * fused * (1.0 - fused)
            if not fruit.is_depth_measured:
                radius += _outline_error(measurement, track) * fused
            parts.append((fused, float(np.hypot(fraction_error(fused, c.fused_error), radius))))
        if not parts:
            return Fraction(value=0.0, error=1.0, single=single, fused=fused)
        weights = np.array([1.0 / error**2 for _, error in parts])
        value = float(weights @ [v for v, _ in parts] / weights.sum())
        error = c.error_scale / float(np.sqrt(weights.sum()))
        return Fraction(value=value, error=error, single=single, fused=fused)

    # ------------------------------------------------------------------ assignment

    def _identified(self, identities: Sequence[int | None]) -> list[int | None]:
        self._next = max([self._next, *(j + 1 for j in identities if j is not None)], default=0)
        taken: set[int] = set()
        numbers: list[int | None] = []
        for j in identities:
            if j in taken or j is None:
                numbers.append(None)
            else:
                taken.add(j)
                numbers.append(j)
        self._next = max(self._next, UNKNOWN_FRUITS)
        return numbers

    def _assigned(self, measurement: Measurement) -> list[int | None]:
        """The track of each detection; None for a new one."""
        tracks = list(self.tracks.values())
        if not tracks or not measurement.fruits:
            return [None] * len(measurement.fruits)
        camera = measurement.camera_position
        gains = np.full((len(measurement.fruits), len(tracks)), -np.inf)
        towards = np.stack([fruit.direction_w for fruit in measurement.fruits])
        for column, track in enumerate(tracks):
            # Only detections whose ray passes near the track can be it.
            away = track.position_w - camera
            beside = np.linalg.norm(away - (towards @ away)[:, None] * towards, axis=1)
            near = np.flatnonzero(beside < FARTHEST_RAY * track.radius_m)
            if len(near):
                shown = shown_share(track, measurement)
                for row in near:
                    gains[row, column] = self._gain(track, measurement.fruits[row], camera, shown)
        from scipy.optimize import linear_sum_assignment  # Slow to load, and only maps need it.

        rows, columns = linear_sum_assignment(np.maximum(gains, 0.0), maximize=True)
        numbers: list[int | None] = [None] * len(measurement.fruits)
        for row, column in zip(rows, columns, strict=True):
            if gains[row, column] > 0.0:
                numbers[row] = tracks[column].number
        return numbers

    def _gain(self, track: Track, fruit: DetectedFruit, camera: Position, shown: float | None) -> float:
        """Log likelihood ratio: a detection of this track, against one of another fruit with this track missed."""
        c = self.config
        ripe = 1.0 / (1.0 + np.exp(-track.ripe_log_odds))
        same = ripe if fruit.is_ripe else 1.0 - ripe
        agreement = np.log(2.0 * (c.ripeness_rate * same + (1.0 - c.ripeness_rate) * (1.0 - same)))
        rate = c.detection_rate * (0.5 if shown is None else max(shown, LEAST_SHOWN))
        density = self._density(track, *self.sphere_of(fruit, camera))
        return float(density - self._new_density() + agreement + np.log(rate / (1.0 - rate)))

    def _density(self, track: Track, mean: Float64, covariance: Float64) -> float:
        """Logarithm of a track's density at a measurement, in [1/m^4]; minus infinity beyond the gate."""
        innovation = mean - track.mean
        spread = track.covariance + covariance
        distance = float(innovation @ np.linalg.solve(spread, innovation))
        if distance > GATE:
            return -np.inf
        return -0.5 * distance - 0.5 * float(np.linalg.slogdet(2.0 * np.pi * spread)[1])

    def _new_density(self) -> float:
        """Logarithm of the density of other fruits in place and radius, in [1/m^4]."""
        density = self.config.fruit_density / (np.sqrt(2.0 * np.pi) * self.crop.radius_spread_m)
        return float(np.log(density))

    # ------------------------------------------------------------------ tracks

    def _born(self, number: int, mean: Float64, covariance: Float64) -> Track:
        # The radius is known beforehand, from other fruits.
        track = Track(number=number, mean=mean.copy(), covariance=covariance.copy())
        gain = track.covariance[:, 3] / (track.covariance[3, 3] + self.crop.radius_spread_m**2)
        track.mean = track.mean + gain * (self.crop.radius_m - track.mean[3])
        track.covariance = track.covariance - np.outer(gain, track.covariance[3])
        return track

    def _correct(self, track: Track, mean: Float64, covariance: Float64) -> None:
        """Kalman's correction with a measurement of the whole state, in Joseph's form."""
        gain = np.linalg.solve((track.covariance + covariance).T, track.covariance.T).T
        rest = np.eye(4) - gain
        track.mean = track.mean + gain @ (mean - track.mean)
        track.covariance = rest @ track.covariance @ rest.T + gain @ covariance @ gain.T

    def _count(self, track: Track, fruit: DetectedFruit) -> None:
        c = self.config
        told = float(np.log(c.ripeness_rate / (1.0 - c.ripeness_rate)))
        if fruit.category != "tomato":
            track.ripe_log_odds += told if fruit.is_ripe else -told
        elif track.views == 0:
            track.ripe_log_odds = told
        if np.isfinite(fruit.redness):
            colour = c.redness_slope * (fruit.redness - c.ripe_redness)
            track.ripe_log_odds += float(np.clip(colour, -LARGEST_COLOUR, LARGEST_COLOUR))
        track.ripe_log_odds = float(np.clip(track.ripe_log_odds, -LARGEST_LOG_ODDS, LARGEST_LOG_ODDS))
        track.existence_log_odds += float(np.log(c.detection_rate / c.false_rate)) * float(
            np.clip(fruit.score, 0.0, 1.0)
        )
        track.existence_log_odds = min(track.existence_log_odds, LARGEST_LOG_ODDS)
        track.views += 1
        if fruit.seen_whole is not None:
            track.seen_whole = fruit.seen_whole

    def _miss(self, measurement: Measurement, detected: set[int]) -> None:
        """Takes existence from tracks that should have been detected; those that are hidden keep theirs."""
        for number, track in list(self.tracks.items()):
            if number in detected:
                continue
            shown = shown_share(track, measurement)
            if shown is None:
                continue
            track.existence_log_odds += float(np.log(1.0 - self.config.detection_rate * shown))
            if track.existence_log_odds < SMALLEST_LOG_ODDS:
                del self.tracks[number]

    def _merge(self) -> None:
        for a, b in itertools.combinations(sorted(self.tracks), 2):
            if a not in self.tracks or b not in self.tracks:
                continue
            first, second = self.tracks[a], self.tracks[b]
            if _overlap(first, second):
                # At most one of both places is right.
                if second.deviation_m < first.deviation_m:
                    first.mean, first.covariance = second.mean, second.covariance
                self._absorb(first, second)
                continue
            if (b in first.apart_from or a in second.apart_from) and not _is_same_place(first, second):
                continue
            if not self._is_one(first, second):
                continue
            self._correct(first, second.mean, second.covariance)
            self._absorb(first, second)

    def _absorb(self, first: Track, second: Track) -> None:
        """Ends the second track, which the first one stands for from now on."""
        first.ripe_log_odds = float(
            np.clip(first.ripe_log_odds + second.ripe_log_odds, -LARGEST_LOG_ODDS, LARGEST_LOG_ODDS)
        )
        first.existence_log_odds = max(first.existence_log_odds, second.existence_log_odds)
        first.views += second.views
        first.seen_whole = first.seen_whole or second.seen_whole
        first.apart_from |= second.apart_from
        self._merged[second.number] = first.number
        del self.tracks[second.number]

    def _is_one(self, first: Track, second: Track) -> bool:
        difference = first.mean - second.mean
        if np.linalg.norm(difference[:3]) > 0.5 * (first.radius_m + second.radius_m):
            return False  # Two solid fruits can be as near as that.
        spread = first.covariance + second.covariance
        distance = float(difference @ np.linalg.solve(spread, difference))
        if distance > MERGE_GATE:
            return False
        density = -0.5 * distance - 0.5 * float(np.linalg.slogdet(2.0 * np.pi * spread)[1])
        return bool(density > self._new_density())

    # ------------------------------------------------------------------- division

    def _divided(self, measurement: Measurement) -> Measurement:
        """The view with masks that cover several known fruits divided among these."""
        if self._divide is None:
            return measurement
        frame, index = measurement.frame, 0
        known = [
            circle
            for track in self.tracks.values()
            if track.views >= SURE_VIEWS
            and track.existence_log_odds > 0.0
            and (circle := outline(track.mean, frame.T_world_camera, frame.intrinsics)) is not None
        ]
        while index < len(measurement.fruits):
            parts = self._parts(measurement, index, known)
            if parts is None:
                index += 1
            else:
                measurement = self._divide(measurement, index, parts)
                index += len(parts)
        return measurement

    def _parts(
        self, measurement: Measurement, index: int, known: Sequence[tuple[float, float, float]]
    ) -> list[BinaryMask] | None:
        """A detection's mask divided among the well-known tracks that it covers, by their outlines; None if it is of
        one fruit."""
        pixels = measurement.fruits[index].pixels
        near = [circle for circle in known if pixels > COVERED_SHARE * np.pi * circle[2] ** 2]
        if len(near) < 2:
            return None
        circles: list[tuple[float, float, float]] = []
        mask = measurement.mask(index)
        for circle in near:
            if _covered(mask, circle) <= COVERED_SHARE:
                continue
            if all(np.hypot(circle[0] - x, circle[1] - y) > max(circle[2], r) for x, y, r in circles):
                circles.append(circle)
        if len(circles) < 2:
            return None
        rows, columns = np.nonzero(mask)
        away = np.stack([np.hypot(columns + 0.5 - x, rows + 0.5 - y) / r for x, y, r in circles])
        nearest = away.argmin(0)
        parts = []
        for k in range(len(circles)):
            part = np.zeros_like(mask)
            part[rows[nearest == k], columns[nearest == k]] = True
            if part.any():
                parts.append(part)
        return parts if len(parts) > 1 else None


UNMEASURED_DEPTH: Final = 0.1
"""Least standard deviation of a distance that was not measured on the fruit itself, in [m]."""

UNMEASURED_SHARE: Final = 0.2
"""The same as a share of the distance: sizes of fruits differ by 0.14, and part of the fruit may be hidden."""

NO_TRACK: Final = -1
"""Stands for the track of a detection that has none."""

SAME_OVERLAP: Final = 0.5
"""Intersection over union of the masks of one fruit in two pictures from the same place."""

FARTHEST_RAY: Final = 4.0
"""A track's detections have their middle at most so many radii beside its centre."""

LEAST_SHOWN: Final = 0.1
"""A track that seems hidden may yet be detected, as often as one that is shown by this share."""

UNKNOWN_FRUITS: Final = 10_000
"""With true identities, numbers from here on are those of detections that show no fruit."""

LARGEST_LOG_ODDS: Final = 8.0
LARGEST_COLOUR: Final = 4.0
"""Log-odds of being ripe that the colour of one view adds at most."""

SMALLEST_LOG_ODDS: Final = -2.0
"""A track with a smaller log-odds of existence is forgotten."""

SAME_PLACE: Final = 0.25
"""Tracks that were detected beside each other are one fruit when they are nearer than this share of the sum of their
radii."""

SOLID_OVERLAP: Final = 0.4
"""Centres nearer than this share of the sum of the radii belong to one fruit, as for the detections of one view."""

SURE_VIEWS: Final = 2
"""A mask is divided only among tracks that were detected in so many views."""

COVERED_SHARE: Final = 0.6
"""A mask covers a track when it holds this share of its outline's pixels."""

LEAST_FRACTION_ERROR: Final = 0.01
"""Standard error of V_f of a fruit that seems wholly visible."""

SURFACE_MARGIN: Final = 1.0
"""Depths up to so many radii in front of a fruit's centre and as many behind it are its own."""


def outline(
    sphere: Float64, T_world_camera: Float64, intrinsics: CameraIntrinsics
) -> tuple[float, float, float] | None:
    """The circle that a sphere makes in a picture.

    Args:
        sphere: Centre in the world frame and radius, in [m]. Shape (4,).
        T_world_camera: Pose of the optical frame. Shape (4, 4).
        intrinsics: The camera's.

    Returns:
        x, y, radius, in [px]; None for a sphere that reaches behind the camera.
    """
    centre = T_world_camera[:3, :3].T @ (sphere[:3] - T_world_camera[:3, 3])
    x, y, z, radius = float(centre[0]), float(centre[1]), float(centre[2]), float(sphere[3])
    if z <= 1.2 * radius:
        return None
    i = intrinsics
    return i.fx * x / z + i.cx, i.fy * y / z + i.cy, i.fx * radius / float(np.sqrt(z**2 - radius**2))


def shown_share(track: Track, measurement: Measurement) -> float | None:
    """The share of a track's outline that a view should show by its depth.

    Returns:
        1 if nothing is in front of it, also where the depth is that of what stands behind; 0 if it is hidden; None if
        it lies outside the picture.
    """
    frame = measurement.frame
    return shown_of_sphere(track.mean, frame, frame.depth_m, track.deviation_m)


def shown_of_sphere(
    sphere: Float64, frame: PosedFrame, depth_m: NDArray[np.floating[Any]], deviation: float = 0.0
) -> float | None:
    """The same for a sphere that nothing was seen of.

    Args:
        sphere: Centre in the world frame and radius, in [m]. Shape (4,).
        frame: The view.
        depth_m: Its depth, in [m]. Shape (H, W).
        deviation: Standard deviation of the sphere's place, in [m].
    """
    circle = outline(sphere, frame.T_world_camera, frame.intrinsics)
    if circle is None:
        return None
    x, y, radius = circle
    height, width = depth_m.shape
    if not (radius < x < width - radius and radius < y < height - radius):
        return None
    step = max(radius / 6.0, 1.0)
    offsets = np.arange(-radius, radius + step, step)
    dx, dy = np.meshgrid(offsets, offsets)
    disc = dx**2 + dy**2 < (0.8 * radius) ** 2
    columns = np.clip((x + dx[disc]).astype(int), 0, width - 1)
    rows = np.clip((y + dy[disc]).astype(int), 0, height - 1)
    depth = depth_m[rows, columns]
    if frame.robot_mask is not None:
        depth = np.where(frame.robot_mask[rows, columns], 0.0, depth)
    z = float((frame.T_world_camera[:3, :3].T @ (sphere[:3] - frame.T_world_camera[:3, 3]))[2])
    front = z - SURFACE_MARGIN * float(sphere[3]) - deviation
    return float(np.mean(np.isfinite(depth) & (depth > front)))


def fraction_error(fraction: float, half: float) -> float:
    """Standard error of an estimate of V_f, largest for a fruit that is half visible.

    Args:
        fraction: The estimate.
        half: The error at V_f = 0.5.
    """
    return float(LEAST_FRACTION_ERROR + half * (4.0 * fraction * (1.0 - fraction)) ** 0.7)


def _overlap(first: Track, second: Track) -> bool:
    """Whether two tracks stand in each other as no two solids can, and both places are well known."""
    radii = first.radius_m + second.radius_m
    apart = float(np.linalg.norm(first.position_w - second.position_w))
    known = max(first.deviation_m, second.deviation_m)
    return apart < SOLID_OVERLAP * radii and known < SOLID_OVERLAP * radii


def _is_same_place(first: Track, second: Track) -> bool:
    """Whether two tracks cannot be two solids: a leaf across one fruit makes two detections of it."""
    apart = float(np.linalg.norm(first.position_w - second.position_w))
    return apart < SAME_PLACE * (first.radius_m + second.radius_m)


def _covered(mask: BinaryMask, circle: tuple[float, float, float]) -> float:
    """The share of a circle's pixels that a mask holds."""
    x, y, radius = circle
    height, width = mask.shape
    left, top = max(int(x - radius), 0), max(int(y - radius), 0)
    right, bottom = min(int(x + radius) + 1, width), min(int(y + radius) + 1, height)
    if left >= right or top >= bottom:
        return 0.0
    u, v = np.meshgrid(np.arange(left, right) + 0.5, np.arange(top, bottom) + 0.5)
    disc = (u - x) ** 2 + (v - y) ** 2 < radius**2
    return float(np.count_nonzero(mask[top:bottom, left:right] & disc) / (np.pi * radius**2))


def _outline_error(measurement: Measurement, track: Track) -> float:
    """Standard error of the size of a track's outline in a view, as a share of its area."""
    away = track.position_w - measurement.camera_position
    distance = float(np.linalg.norm(away))
    towards = away / distance
    along = float(np.sqrt(towards @ track.covariance[:3, :3] @ towards))
    return 2.0 * along / distance


def _fused_fraction(measurement: Measurement, index: int, track: Track, flatness: float) -> float:
    """V_f of a detection by the track's sphere: visible pixels over those and the hidden ones of its outline."""
    frame = measurement.frame
    circle = outline(track.mean, frame.T_world_camera, frame.intrinsics)
    if circle is None:
        return float("nan")
    mask = measurement.mask(index)
    pose = frame.T_world_camera
    stretch = round_outline(pose[2, :3], pose[:3, :3].T @ (track.position_w - pose[:3, 3]), flatness)
    depth, fruits, owns = measurement.depth_by_fruits
    own = owns[index]
    # Without depth nobody knows what is hidden: all of the outline that is not seen counts.
    farthest = own + SphereConfig().edge_step_m if np.isfinite(own) else np.inf
    whole, outside = whole_silhouette(mask, circle, depth, farthest, own, fruits, stretch)
    visible = np.count_nonzero(mask)
    return float(min(visible / (np.count_nonzero(whole) + outside), 1.0))
