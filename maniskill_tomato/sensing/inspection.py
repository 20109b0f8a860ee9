"""The inspection of a row through a camera: which fruit to look at next, and what was found out of each.

A simulated row and a robot share it. All it knows is the `FruitMap`. The next fruit is the nearest ripe one in reach
that no view has shown fully yet. When there is none, the robot looks at a part of the row that it has not looked at,
then where it has detected fruits without knowing how far away they are, and once more at fruits that were given up.
When nothing of this is left, the inspection is over.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from maniskill_tomato.segmentation.masks import BinaryMask
from maniskill_tomato.sensing.fruit_map import FruitMap, MappedView, Track
from maniskill_tomato.sensing.measurement import Position
from maniskill_tomato.sensing.posed_frame import PosedFrame
from maniskill_tomato.sensing.view_lattice import ViewLattice

SURE_ERROR: Final = 0.01
"""Fruits whose place is more certain than this standard deviation of a coordinate, in [m], come before the parts of the
row that no view has shown."""

LARGEST_ERROR: Final = 0.02
"""Less certain ones come after these; they are often slivers whose depth is that of a leaf. Those that are less certain
than this, in [m], are not looked at."""

LISTED_ERROR: Final = 0.01
"""A fruit that no view shows fully is listed when its place is more certain than this, in [m]."""

LOST_AFTER: Final = 6
"""A fruit is given up after so many views in a row that do not show it."""

STALE_AFTER: Final = 6
"""It is given up, too, after so many views in a row that do not show more of it than those before."""

LEAST_GAIN: Final = 0.02
"""A view shows more of a fruit when its V_f is larger by more than this."""

LITTLE: Final = 0.15
"""One of which no view has shown more than this V_f is given up after half as many views: it may be none."""

GLIMPSED_EXISTENCE: Final = 1.0
"""A fruit whose distance nobody knows is worth one move when its log-odds of existence are above this."""

GLIMPSED_WITHIN: Final = 0.12
"""The move is for all such fruits that are nearer to each other than this, in [m]."""

EXPLAINED: Final = 2.0
"""It is a piece of a known fruit when it is nearer to that than so many standard deviations."""

CHANCES: Final = 2
"""A fruit whose place is sure is looked for again when nothing else is left, until it was given up so often."""

SCAN_PLACES: Final[tuple[tuple[float, float, float], ...]] = tuple(
    (0.83, y, z) for z in (0.45, 0.68) for y in (-0.6, -0.36, -0.12, 0.12, 0.36, 0.6)
)
"""Where a row is looked at, in the base frame, in [m]: the ripe fruits in reach of validation rows lie from 0.63 to
1.01, from -0.72 to 0.72 and from 0.36 to 0.73."""

SCAN_RANGE: Final = (0.2, 0.7)
"""A view shows such a place when it lies in the picture so far along the optical axis, in [m], and nothing stands
farther in front of it than `SCAN_DEPTH`."""

SCAN_DEPTH: Final = 0.12
"""In [m]: what is nearer to the place belongs to the same cluster of leaves and fruits."""

SURE_VIEWS: Final = 3
"""A fruit that so many views have detected is sure, and listed also if none of them shows it fully."""

SOLID_SHARE: Final = 0.6
"""Centres of two fruits are at least this share of the sum of their radii apart; nearer ones are one fruit."""

Float64 = NDArray[np.float64]
_Pixel = TypeVar("_Pixel", bound=np.generic)


@dataclass(frozen=True, eq=False, kw_only=True)
class SeenView:
    """The view that showed most of a fruit."""

    view: int
    """Its number in the inspection, from 0."""
    sure_fraction: float
    """Lower bound of V_f."""
    fraction: float
    """V_f."""
    error: float
    """Its standard error."""
    T_world_camera: Float64
    """Pose of the optical frame. Shape (4, 4)."""
    picture: NDArray[np.uint8] | None
    """What is round the fruit; None from a camera without colours. Shape (H, W, 3)."""
    mask: BinaryMask
    """Visible pixels of the fruit in that cut-out. Shape (H, W)."""
    shown_fruit: int | None
    """Which fruit of the plant it is, where a simulated camera tells."""


@dataclass(frozen=True, eq=False, kw_only=True)
class InspectedFruit:
    """One fruit of the inspection list."""

    number: int
    """Its track in the map."""
    position_w: Position
    """Centre in the robot's base frame, in [m]. Shape (3,)."""
    position_error_m: float
    """Standard deviation of a coordinate, in [m]."""
    radius_m: float
    """In [m]."""
    is_ripe: bool
    """Whether it is more likely ripe than not."""
    visible_fraction: float
    """Largest V_f of any view."""
    fraction_error: float
    """Its standard error."""
    is_fully_seen: bool
    """Whether the lower bound of V_f is above the threshold, or V_f of a fruit that was given up."""
    approach_w: Position | None
    """Unit vector from the fruit to the camera that saw it fully: a direction in which nothing hides it. None for a
    fruit that no view showed fully. Shape (3,)."""
    best: SeenView | None
    """The view that showed most of it; None if its V_f could never be told."""
    views: int
    """Views that it was detected in."""


@dataclass(frozen=True, eq=False)
class Aim:
    """What the robot looks at next."""

    position_w: Position
    """In the robot's base frame, in [m]. Shape (3,)."""
    track: int | None
    """The fruit; None for a part of the row."""


@dataclass(eq=False)
class Inspection:
    """One robot's way through one row."""

    threshold: float
    """V_f above which a fruit is fully seen."""
    stop_errors: float
    """Standard errors that V_f must be above it."""
    scan_places: Sequence[tuple[float, float, float]] = SCAN_PLACES
    """Parts of the row, in the base frame, in [m]."""
    aim: Aim | None = None
    """What the robot looks at now; None before the first view."""
    is_over: bool = False
    """Whether nothing is left to look at."""
    given_up: dict[int, int] = field(default_factory=dict)
    """How often tracks were given up, by their numbers."""

    def __post_init__(self) -> None:
        self._best: dict[int, SeenView] = {}
        self._glimpsed: list[Position] = []
        self._unscanned = set(range(len(self.scan_places)))
        self._views = self._lost = self._stale = 0
        self._most = 0.0

    def take_in(self, fruits: FruitMap, view: MappedView, is_on_the_way: bool = False) -> list[int]:
        """Takes in a view that the map has taken in.

        Args:
            fruits: The map.
            view: Its last view.
            is_on_the_way: Whether the camera looks at nothing yet, so that not to see the target is no bad sign.

        Returns:
            The ripe tracks that are fully seen by it first.
        """
        before = {number for number in self._best if self.is_full(number)}
        self._follow_merged(fruits)
        frame = view.measurement.frame
        for index, number in enumerate(view.tracks):
            fruit, known = view.measurement.fruits[index], self._best.get(number)
            if number not in fruits.tracks or not fruit.is_depth_measured:
                continue
            single = fruit.visible_fraction
            if not np.isfinite(single) or (known is not None and single < known.fraction - 0.1):
                continue
            seen = fruits.fraction(view.measurement, index, number)
            sure = seen.value - self.stop_errors * seen.error
            if known is None or sure > known.sure_fraction:
                mask = view.measurement.mask(index)
                self._best[number] = SeenView(
                    view=self._views,
                    sure_fraction=sure,
                    fraction=seen.value,
                    error=seen.error,
                    T_world_camera=frame.T_world_camera,
                    picture=None
                    if frame.rgb is None
                    else _cut_out(frame.rgb, fruit.corner, fruit.crop.shape),
                    mask=_cut_out(mask, fruit.corner, fruit.crop.shape),
                    shown_fruit=frame.shown_fruit(mask),
                )
        self._unscanned = {k for k in self._unscanned if not self._shows(frame, k)}
        if not is_on_the_way:
            self._count(view)
        self._views += 1
        return [
            number
            for number in self._best
            if number not in before and self.is_full(number) and fruits.tracks[number].is_ripe
        ]

    def _count(self, view: MappedView) -> None:
        """Counts the views that do not show the target, or no more of it."""
        target = None if self.aim is None else self.aim.track
        self._lost = 0 if target is None or target in view.tracks else self._lost + 1
        shown = 0.0 if target is None or target not in self._best else self._best[target].fraction
        self._stale = 0 if shown > self._most + LEAST_GAIN else self._stale + 1
        self._most = max(self._most, shown)

    def is_full(self, number: int) -> bool:
        """Whether a view has shown a track fully: by the lower bound of V_f, or by V_f if more views did not help."""
        best = self._best.get(number)
        if best is None:
            return False
        return (best.fraction if number in self.given_up else best.sure_fraction) > self.threshold

    def is_done(self, fruits: FruitMap, moves: int, max_moves: int) -> bool:
        """Whether the robot is done with what it looks at: seen, scanned, gone, lost, or not worth another move.

        Args:
            fruits: The map.
            moves: Moves that were made for it.
            max_moves: Moves after which it is given up.
        """
        if self.aim is None:
            return True
        number = self.aim.track
        if number is None:
            # A fruit that turned up is worth more than the rest of the scan.
            is_place = self._is_scan_place(self.aim)
            return moves > 0 or (is_place is not None and is_place not in self._unscanned)
        track = fruits.tracks.get(number)
        if track is None or not track.is_ripe or self.is_full(number) or self._is_known(track, fruits):
            return True
        share = 0.5 if self._most < LITTLE else 1.0
        if moves >= max_moves or self._lost >= share * LOST_AFTER or self._stale >= share * STALE_AFTER:
            self.give_up(number)
            return True
        return False

    def give_up(self, number: int) -> None:
        """Gives a track up, for example because the arm gets no nearer to it; see `CHANCES`."""
        self.given_up[number] = self.given_up.get(number, 0) + 1

    def next(self, fruits: FruitMap, camera_position: Position, lattice: ViewLattice) -> Aim | None:
        """Chooses what to look at next, and keeps it as `aim`.

        Args:
            fruits: The map.
            camera_position: In the base frame, in [m]. Shape (3,).
            lattice: Says what the arm reaches.

        Returns:
            None if nothing is left.
        """
        if self.aim is not None and self.aim.track is None:
            self._unscanned -= {
                k for k, p in enumerate(self.scan_places) if np.allclose(p, self.aim.position_w)
            }
        near = self._open(fruits, lattice)
        sure = [t for t in near if _position_error(t) < SURE_ERROR and t.number not in self.given_up]
        new = [t for t in near if t.number not in self.given_up]
        if sure or (new and not self._unscanned):
            self._turn_to(_nearest(sure or new, camera_position))
        elif self._unscanned:
            places = [np.array(self.scan_places[k]) for k in sorted(self._unscanned)]
            self.aim = Aim(min(places, key=lambda p: float(np.linalg.norm(p - camera_position))), None)
        elif glimpsed := self._glimpses(fruits, lattice):
            track = _nearest(glimpsed, camera_position)
            self._glimpsed.append(track.position_w.copy())
            self.aim = Aim(track.position_w.copy(), None)
        elif near:
            self._turn_to(_nearest(near, camera_position))
        else:
            self.aim, self.is_over = None, True
        return self.aim

    def _turn_to(self, track: Track) -> None:
        self.aim = Aim(track.position_w.copy(), track.number)
        self._lost = self._stale = 0
        self._most = self._best[track.number].fraction if track.number in self._best else 0.0

    def _glimpses(self, fruits: FruitMap, lattice: ViewLattice) -> list[Track]:
        """Ripe fruits in reach whose distance nobody knows, and that are no pieces of known ones."""
        known = [t for t in fruits.tracks.values() if t.is_ripe and _position_error(t) < SURE_ERROR]
        return _in_reach(
            [
                t
                for t in fruits.tracks.values()
                if t.is_ripe
                and t.existence_log_odds > GLIMPSED_EXISTENCE
                and _position_error(t) >= SURE_ERROR
                and not self.is_full(t.number)
                and all(np.linalg.norm(t.position_w - p) >= GLIMPSED_WITHIN for p in self._glimpsed)
                and not any(_explains(other, t) for other in known)
            ],
            lattice,
        )

    def _open(self, fruits: FruitMap, lattice: ViewLattice) -> list[Track]:
        """The fruits in reach that are worth a look."""
        tracks = [
            track
            for track in fruits.tracks.values()
            if self._is_open(track) and not self._is_known(track, fruits)
        ]
        return _in_reach(tracks, lattice)

    def fruits(self, fruits: FruitMap) -> list[InspectedFruit]:
        """The inspection list: every fruit that there more likely is than not, those that were fully seen
        first."""
        listed: list[InspectedFruit] = []
        tracks = [
            t
            for t in fruits.tracks.values()
            if self.is_full(t.number)
            or (t.existence_log_odds > 0.0 and t.views >= SURE_VIEWS and _position_error(t) < LISTED_ERROR)
        ]
        for track in sorted(tracks, key=lambda t: (not self.is_full(t.number), -t.views, t.number)):
            if not any(_are_one(track, fruits.tracks[other.number]) for other in listed):
                listed.append(self._inspected(track))
        return listed

    def _inspected(self, track: Track) -> InspectedFruit:
        best, full = self._best.get(track.number), self.is_full(track.number)
        approach = None
        if best is not None and full:
            away = best.T_world_camera[:3, 3] - track.position_w
            approach = away / np.linalg.norm(away)
        return InspectedFruit(
            number=track.number,
            position_w=track.position_w.copy(),
            position_error_m=_position_error(track),
            radius_m=track.radius_m,
            is_ripe=track.is_ripe,
            visible_fraction=0.0 if best is None else best.fraction,
            fraction_error=1.0 if best is None else best.error,
            is_fully_seen=full,
            approach_w=approach,
            best=best,
            views=track.views,
        )

    def _is_open(self, track: Track) -> bool:
        is_sure, best = _position_error(track) < SURE_ERROR, self._best.get(track.number)
        chances = CHANCES if is_sure and best is not None and best.fraction > LITTLE else 1
        # Three views make the place of a fruit sure; they do not agree about that of a sliver.
        largest = LARGEST_ERROR if track.views < SURE_VIEWS else SURE_ERROR
        return (
            track.is_ripe
            and track.existence_log_odds > 0.0
            and _position_error(track) < largest
            and not self.is_full(track.number)
            and self.given_up.get(track.number, 0) < chances
        )

    def _is_known(self, track: Track, fruits: FruitMap) -> bool:
        """Whether a track is one fruit with a better known one: one that is fully seen, or was detected more often."""
        known = (self.is_full(track.number), track.views, -track.number)
        return any(
            _are_one(track, other) and (self.is_full(other.number), other.views, -other.number) > known
            for other in fruits.tracks.values()
            if other is not track and other.is_ripe and other.existence_log_odds > 0.0
        )

    def _is_scan_place(self, aim: Aim) -> int | None:
        """The index of a place of the scan."""
        return next((k for k, p in enumerate(self.scan_places) if np.allclose(p, aim.position_w)), None)

    def _shows(self, frame: PosedFrame, place: int) -> bool:
        """Whether a view holds a part of the row, not hidden by what stands far in front of it."""
        pose, camera = frame.T_world_camera, frame.intrinsics
        x, y, z = pose[:3, :3].T @ (np.array(self.scan_places[place]) - pose[:3, 3])
        if not SCAN_RANGE[0] < z < SCAN_RANGE[1]:
            return False
        column, row = int(camera.fx * x / z + camera.cx), int(camera.fy * y / z + camera.cy)
        if not (0 <= column < camera.width and 0 <= row < camera.height):
            return False
        depth = float(frame.depth_m[row, column])
        return bool(np.isfinite(depth) and depth > z - SCAN_DEPTH)

    def _follow_merged(self, fruits: FruitMap) -> None:
        """Gives what is known of tracks that others took in to these."""
        kept: dict[int, SeenView] = {}
        for number, seen in self._best.items():
            now = fruits.current(number)
            if now is not None and (now not in kept or seen.sure_fraction > kept[now].sure_fraction):
                kept[now] = seen
        self._best = kept
        given_up: dict[int, int] = {}
        for number, times in self.given_up.items():
            if (now := fruits.current(number)) is not None:
                given_up[now] = max(times, given_up.get(now, 0))
        self.given_up = given_up
        if self.aim is not None and self.aim.track is not None:
            now = fruits.current(self.aim.track)
            if now is not None:
                self.aim = Aim(fruits.tracks[now].position_w.copy(), now)


def _nearest(tracks: Sequence[Track], position: Position) -> Track:
    return min(tracks, key=lambda t: float(np.linalg.norm(t.position_w - position)))


def _in_reach(tracks: Sequence[Track], lattice: ViewLattice) -> list[Track]:
    positions = np.array([track.position_w for track in tracks]).reshape(-1, 3)
    fits = lattice.in_reach(torch.as_tensor(positions, dtype=torch.float32, device=lattice.device))
    return [track for track, fit in zip(tracks, fits.tolist(), strict=True) if fit]


def _explains(known: Track, unsure: Track) -> bool:
    """Whether a fruit whose distance nobody knows may be a piece of a known one."""
    away = known.position_w - unsure.position_w
    spread = unsure.covariance[:3, :3] + known.radius_m**2 / 4.0 * np.eye(3)
    return bool(away @ np.linalg.solve(spread, away) < EXPLAINED**2)


def _are_one(a: Track, b: Track) -> bool:
    """Whether two tracks are too near to each other to be two fruits."""
    return bool(np.linalg.norm(a.position_w - b.position_w) < SOLID_SHARE * (a.radius_m + b.radius_m))


def _position_error(track: Track) -> float:
    """Standard deviation of a coordinate, in [m]."""
    return float(np.sqrt(np.trace(track.covariance[:3, :3]) / 3.0))


def _cut_out(picture: NDArray[_Pixel], corner: tuple[int, int], size: tuple[int, ...]) -> NDArray[_Pixel]:
    """A square about a detection, twice as large as that, within the picture."""
    half = max(size)
    row, column = corner[0] + size[0] // 2, corner[1] + size[1] // 2
    return picture[max(row - half, 0) : row + half, max(column - half, 0) : column + half].copy()
