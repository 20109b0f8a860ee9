"""From the frames of N cameras to what is known of their targets: V_f, position, rays about it.

Simulated worlds and the robot use the same class; what differs is who takes the frames. Every environment has a
`FruitMap`, and its target is one of the map's tracks.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
import torch
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.raycast.view_rays import RAYS_PER_SIDE, RayLabel, ViewRays
from maniskill_tomato.segmentation.masks import BinaryMask
from maniskill_tomato.sensing.axis_search import AxisSearch
from maniskill_tomato.sensing.fruit_detector import FruitDetector
from maniskill_tomato.sensing.fruit_map import Fraction, FruitMap, MapConfig, MappedView, Track
from maniskill_tomato.sensing.image_layout import ImageLayout
from maniskill_tomato.sensing.image_observation import measured_images
from maniskill_tomato.sensing.inspection import LEAST_GAIN
from maniskill_tomato.sensing.measurement import Measurement, Position
from maniskill_tomato.sensing.observation import ViewpointObserver
from maniskill_tomato.sensing.occlusion_memory import CELL_SIZE
from maniskill_tomato.sensing.perception_kinds import MAP_NOISE
from maniskill_tomato.sensing.pointed_fruit import PointedFruit, identified
from maniskill_tomato.sensing.posed_frame import PosedFrame

RECENTRE: Final = CELL_SIZE / 4
"""Memory and rays are centred anew when the target turns out to be farther than this from their centre, in [m]."""

SAME_POSE: Final = 1e-3
"""Entries of the camera's pose (in [m] for its place) differ by less than this in views from the same place."""

MEASURED_MARGIN: Final = 0.15
"""How much more of a fruit must be measured than of a hidden target can be seen, to rule it out: three times the mean
error of V_f."""

UNSEEN_SHARE: Final = 0.3
"""Share of the places about a target's that no view has shown: how likely it is none of the tracks."""

SURE_SCORE: Final = 0.5
"""A fruit with a lower score is not chosen as a new target."""

_NO_RAYS = ViewRays(
    torch.tensor([0.0, 0.0, 1.0]).expand(1, RAYS_PER_SIDE**2, 3),
    torch.zeros(1, RAYS_PER_SIDE**2),
    torch.full((1, RAYS_PER_SIDE**2), int(RayLabel.OUTSIDE), dtype=torch.int8),
)


@dataclass(eq=False)
class _Search:
    """One environment: its map, which of the tracks is the target, and where it looks."""

    map: FruitMap
    place: Position | None = None
    """Where the target is said to be, world frame, in [m]; None if nobody says. Shape (3,)."""
    place_error: float = MAP_NOISE
    """Standard deviation of its coordinates, in [m]."""
    hidden_below: float | None = None
    chooses: bool = False
    """Whether any ripe fruit that is not fully seen yet will do."""
    patience: int | None = None
    """Views in a row that show no more of such a fruit before another is chosen; None for no other."""
    stale: int = 0
    """How many these are."""
    most: float = 0.0
    """Largest V_f of the present target in any view."""
    threshold: float = 1.0
    """A fruit with a larger V_f is fully seen."""
    target: int | None = None
    pointed: list[PointedFruit] = field(default_factory=list)
    """Where somebody pointed at it."""
    ruled_out: frozenset[int] = frozenset()
    """Tracks that cannot be the target, or were given up."""
    looks_at: Position | None = None
    """Where the robot looks without a target, world frame, in [m]. Shape (3,)."""
    centre: Position | None = None
    """About which memory and rays stand, world frame, in [m]. Shape (3,)."""
    axis: AxisSearch | None = None
    """Where a target is looked for that no view has shown; None before the first view."""
    views: list[MappedView] | None = None
    fraction: Fraction = Fraction.nothing()

    @property
    def track(self) -> Track | None:
        """The target's."""
        return None if self.target is None else self.map.tracks.get(self.target)


class CameraPerception:
    """Measures the frames of N environments and follows one target in each."""

    def __init__(
        self,
        num_envs: int,
        detector: FruitDetector,
        *,
        config: MapConfig | None = None,
        true_association: bool = False,
        device: str | torch.device = "cpu",
    ) -> None:
        """Begins with empty maps.

        Args:
            num_envs: Number of environments N.
            detector: Finds and measures fruits.
            config: Of the maps; measured defaults if None.
            true_association: Whether the frames tell which fruit a detection shows, so that none is mistaken.
            device: Where tensors live.
        """
        self.num_envs = num_envs
        self.detector = detector
        """Finds and measures fruits."""
        self.config = config or MapConfig()
        """Of the maps."""
        self._true_association = true_association
        self._device = torch.device(device)
        self._searches = [_Search(self._new_map()) for _ in range(num_envs)]

    def begin(
        self,
        env_index: int,
        place_w: Position | None = None,
        *,
        place_error: float = MAP_NOISE,
        hidden_below: float | None = None,
        chooses: bool = False,
        patience: int | None = None,
        threshold: float = 1.0,
    ) -> None:
        """Forgets an environment's fruits and begins with a new target.

        Args:
            env_index: Which environment's.
            place_w: Where the target is said to be, world frame, in [m]; None if `point` or `chooses` tells it.
                Shape (3,).
            place_error: Standard deviation of its coordinates, in [m].
            hidden_below: The first view shows less of the target than this V_f; None if that is not known.
            chooses: Whether any ripe fruit that is not fully seen yet becomes the target.
            patience: Views in a row that show no more of such a target before another is chosen, if the last of them
                shows one; None to keep it.
            threshold: V_f above which it is fully seen.
        """
        self._searches[env_index] = _Search(
            self._new_map(),
            place=None if place_w is None else np.array(place_w, dtype=np.float64),
            place_error=place_error,
            hidden_below=hidden_below,
            chooses=chooses,
            patience=patience,
            threshold=threshold,
            centre=None if place_w is None else np.array(place_w, dtype=np.float64),
        )

    def point(self, env_index: int, fruit: int) -> bool:
        """Makes a fruit of the last view the target, as somebody does who points at it in the picture.

        Its pixels are kept: when the map knows better which track fills them, that one is the target.

        Args:
            env_index: Which environment.
            fruit: Index in the fruits of the last view. It has a track and a depth of its own.

        Returns:
            Whether memory and rays must be centred anew, with `recall`.

        Raises:
            InvalidInputError: There is no view yet.
        """
        search = self._searches[env_index]
        if not search.views:
            raise InvalidInputError("there is no fruit to point at before the first view")
        view = search.views[-1]
        search.pointed.append(PointedFruit.of(view, fruit))
        search.target = identified(search.pointed, search.map, view.tracks[fruit])
        return self._aim(search)

    def turn_to(self, env_index: int, number: int | None, place_w: Position) -> bool:
        """Makes a track the target, or looks at a place without one.

        Args:
            env_index: Which environment.
            number: The track; None for none.
            place_w: The place, world frame, in [m]. Shape (3,).

        Returns:
            Whether memory and rays must be centred anew, with `recall`.
        """
        search = self._searches[env_index]
        search.target, search.looks_at = number, np.array(place_w, dtype=np.float64)
        return self._aim(search)

    def choose(self, env_index: int, threshold: float) -> bool:
        """Makes the largest ripe, sure fruit of the last view the target, if its V_f there is not above a threshold.

        Returns:
            Whether memory and rays must be centred anew, with `recall`.
        """
        search = self._searches[env_index]
        if search.views:
            search.target = self._choice(search, search.views[-1], threshold)
        return self._aim(search)

    def look(self, frames: Sequence[PosedFrame | None]) -> Tensor:
        """Measures new frames and finds the targets in them.

        Args:
            frames: One for each environment, None for those that do not look.

        Returns:
            The environments whose target turned out to be elsewhere: what they have seen before should be taken in
            again, about the new position, with `recall`. Shape (N,), bool.

        Raises:
            InvalidInputError: The number of frames is wrong, or one lacks what segmentation needs.
        """
        if len(frames) != self.num_envs:
            raise InvalidInputError(
                f"frames must be {self.num_envs}, one for each environment; got {len(frames)}"
            )
        moved = [
            frame is not None and self.add(k, self.detector.measure(frame, self._searches[k].map.crop))
            for k, frame in enumerate(frames)
        ]
        return torch.tensor(moved, device=self._device)

    def add(self, env_index: int, measurement: Measurement) -> bool:
        """Takes in a view that was measured already; whether its target turned out to be elsewhere."""
        search = self._searches[env_index]
        identities = None
        if self._true_association:
            shown = measurement.frame.shown_fruit
            identities = [shown(measurement.mask(k)) for k in range(len(measurement.fruits))]
        pose, last = measurement.frame.T_world_camera, search.views[-1] if search.views else None
        first = not search.views
        if search.axis is None:
            search.axis = AxisSearch(pose, self.config)
        if last is not None and np.allclose(
            pose, last.measurement.frame.T_world_camera, rtol=0.0, atol=SAME_POSE
        ):
            view = search.map.again(measurement, last)
        else:
            view = search.map.update(measurement, identities)
            if search.target is None and search.place is None and search.looks_at is None:
                search.axis.miss(view.measurement)
        search.views = [*(_slimmed(earlier) for earlier in search.views or []), view]
        if search.target is not None:
            search.target = search.map.current(search.target)
        if search.pointed:
            search.target = identified(search.pointed, search.map, search.target)
        if search.place is not None:
            self._find(search, view, first)
        elif search.chooses:
            self._choose_anew(search, view)
        return self._aim(search)

    def views(self, env_index: int) -> Sequence[Measurement]:
        """All views of an environment so far, in order."""
        return [view.measurement for view in self._searches[env_index].views or []]

    def map(self, env_index: int) -> FruitMap:
        """An environment's fruits."""
        return self._searches[env_index].map

    def last_view(self, env_index: int) -> MappedView | None:
        """The last view with the tracks of its detections; None before the first."""
        views = self._searches[env_index].views
        return views[-1] if views else None

    def target(self, env_index: int) -> Track | None:
        """The target's track; None while it is not known which it is."""
        return self._searches[env_index].track

    def target_fruit(self, env_index: int) -> int | None:
        """Index of the target among the fruits of the last view; None if it does not show it."""
        view = self.last_view(env_index)
        return None if view is None else view.detection(self._searches[env_index].target)

    def mask(self, env_index: int) -> BinaryMask:
        """Visible pixels of the target in the last view. Shape (H, W).

        Raises:
            InvalidInputError: There is no view yet.
        """
        view = self.last_view(env_index)
        if view is None:
            raise InvalidInputError("there is no mask before the first view")
        return view.measurement.mask(self.target_fruit(env_index))

    def position_w(self, env_index: int) -> Position:
        """About which an environment's memory and rays stand, world frame, in [m]: where the target is believed to be,
        or where the robot looks for it. Shape (3,), float64."""
        centre = self._searches[env_index].centre
        return np.zeros(3) if centre is None else centre

    @property
    def is_located(self) -> Tensor:
        """Whether a track is the target. Shape (N,), bool."""
        return torch.tensor([search.track is not None for search in self._searches], device=self._device)

    @property
    def target_position(self) -> Tensor:
        """Where targets are believed to be, world frame, in [m]. Shape (N, 3), float32."""
        positions = np.stack([self.position_w(k) for k in range(self.num_envs)])
        return torch.as_tensor(positions, dtype=torch.float32, device=self._device)

    @property
    def visible_fraction(self) -> Tensor:
        """V_f of the targets in the last views, 0 for one that is not seen. Shape (N,), float32."""
        return self._fractions([search.fraction.value for search in self._searches])

    @property
    def sure_fraction(self) -> Tensor:
        """Lower bound of V_f: `visible_fraction` less `fraction_margin`, and at least 0. Shape (N,), float32."""
        return self._fractions(
            [max(s.fraction.value - self.config.stop_errors * s.fraction.error, 0.0) for s in self._searches]
        )

    @property
    def fraction_margin(self) -> Tensor:
        """How far off `visible_fraction` may be: `MapConfig.stop_errors` standard errors. Shape (N,), float32."""
        return self._fractions([self.config.stop_errors * s.fraction.error for s in self._searches])

    def rays(self) -> ViewRays:
        """The pattern about the believed positions, read from the last views; OUTSIDE where there is none yet."""
        return self._rays([self.last_view(k) for k in range(self.num_envs)])

    def images(self, layout: ImageLayout) -> dict[str, Tensor]:
        """The last views as images, with the roles that segmenter and map give their pixels.

        Args:
            layout: What is wanted.

        Returns:
            By kind, each of shape (N, H, W, C).

        Raises:
            InvalidInputError: Colours are wanted of a camera that has none.
        """
        views = [self.last_view(k) for k in range(self.num_envs)]
        images = measured_images(
            [None if view is None else view.measurement for view in views],
            [self.target_fruit(k) for k in range(self.num_envs)],
            layout,
        )
        return {kind: image.to(self._device) for kind, image in images.items()}

    def recall(self, observer: ViewpointObserver, env_idx: Tensor) -> None:
        """Begins the memory of some environments anew about where their targets are believed to be now, and takes in
        what was seen before the last view.

        Args:
            observer: Whose memory.
            env_idx: Which environments. Shape (b,).
        """
        observer.begin(env_idx, self.target_position[env_idx])
        rows = [int(i) for i in env_idx]
        earlier = {i: (self._searches[i].views or [])[:-1] for i in rows}
        poses = torch.eye(4, device=self._device).repeat(self.num_envs, 1, 1)
        for k in range(max((len(views) for views in earlier.values()), default=0)):
            seen: list[MappedView | None] = [None] * self.num_envs
            for i, views in earlier.items():
                if k < len(views):
                    seen[i] = views[k]
                    poses[i] = torch.as_tensor(views[k].measurement.frame.T_world_camera).to(poses)
            mask = torch.tensor([view is not None for view in seen], device=self._device)
            fractions = self._fractions([self._fraction_in(i, view) for i, view in enumerate(seen)])
            observer.memory.integrate(poses, self._rays(seen), mask, visible_fraction=fractions)

    # ------------------------------------------------------------------ target

    def _find(self, search: _Search, view: MappedView, first: bool) -> None:
        """The target by the place where it is said to be; another track takes over when it is more likely."""
        if first and search.hidden_below is not None:
            limit = search.hidden_below + MEASURED_MARGIN
            search.ruled_out = frozenset(
                number
                for fruit, number in zip(view.measurement.fruits, view.tracks, strict=True)
                if fruit.visible_fraction > limit
            )
        assert search.place is not None
        weights = {}
        for number, track in search.map.tracks.items():
            ruled_out = any(search.map.current(other) == number for other in search.ruled_out)
            if not track.is_ripe or ruled_out or not self._is_apart(search, track):
                continue
            spread = track.covariance[:3, :3] + search.place_error**2 * np.eye(3)
            off = track.position_w - search.place
            distance = float(off @ np.linalg.solve(spread, off))
            weights[number] = float(
                np.exp(-0.5 * distance) / np.sqrt(np.linalg.det(2.0 * np.pi * spread)) * track.existence
            )
        unseen = UNSEEN_SHARE * self.config.fruit_density
        best = max(weights, key=lambda number: weights[number], default=None)
        if best is not None and weights[best] > 0.5 * (sum(weights.values()) + unseen):
            search.target = best
        elif search.target is not None and best is not None and weights[best] <= unseen:
            search.target = None

    @staticmethod
    def _is_apart(search: _Search, track: Track) -> bool:
        """Whether its place tells a track from a fruit beside it; a view without depth gives a direction only."""
        largest = float(np.linalg.eigvalsh(track.covariance[:3, :3])[-1])
        return largest < search.map.crop.radius_m**2

    def _choose_anew(self, search: _Search, view: MappedView) -> None:
        """Chooses a target where there is none, or where views have long shown no more of it."""
        if search.target is not None:
            index = view.detection(search.target)
            fraction = search.map.fraction(view.measurement, index, search.target).value
            search.stale = 0 if fraction > search.most + LEAST_GAIN else search.stale + 1
            search.most = max(search.most, fraction)
            if search.patience is None or search.stale < search.patience:
                return
        before, ruled_out = search.target, search.ruled_out
        if before is not None:
            search.ruled_out = ruled_out | {before}
        chosen = self._choice(search, view, search.threshold)
        if chosen is None and before is not None:
            search.ruled_out = ruled_out
            return
        search.target, search.stale, search.most = chosen, 0, 0.0

    def _choice(self, search: _Search, view: MappedView, threshold: float) -> int | None:
        """The largest ripe, sure fruit of the picture that is not fully visible in it and was not given up."""
        best, pixels = None, 0
        given_up = {search.map.current(number) for number in search.ruled_out}
        for index, (fruit, number) in enumerate(zip(view.measurement.fruits, view.tracks, strict=True)):
            track = search.map.tracks.get(number)
            if track is None or not track.is_ripe or fruit.score < SURE_SCORE or not fruit.is_depth_measured:
                continue
            seen = search.map.fraction(view.measurement, index, number)
            if seen.value <= threshold and fruit.pixels > pixels and number not in given_up:
                best, pixels = number, fruit.pixels
        return best

    def _aim(self, search: _Search) -> bool:
        """Works out V_f and where to look; whether that is elsewhere."""
        view = search.views[-1] if search.views else None
        track = search.track
        if track is not None:
            towards = track.position_w
        elif search.place is not None:
            towards = search.place
        elif search.looks_at is not None:
            towards = search.looks_at
        else:
            towards = (
                np.zeros(3)
                if search.axis is None
                else search.axis.place(search.map.tracks.values(), search.map.crop.radius_m)
            )
        if view is not None:
            index = view.detection(search.target)
            search.fraction = search.map.fraction(view.measurement, index, search.target)
        if search.centre is not None and np.linalg.norm(towards - search.centre) <= RECENTRE:
            return False
        # Whole millimetres: the errors of rounding of a fit do not shift the memory's voxels.
        search.centre = np.round(1000.0 * np.asarray(towards, dtype=np.float64)) / 1000.0
        return view is not None

    def _new_map(self) -> FruitMap:
        return FruitMap(self.config, self.detector.divide)

    def _fractions(self, values: Sequence[float]) -> Tensor:
        return torch.tensor(values, dtype=torch.float32, device=self._device)

    def _target_in(self, env_index: int, view: MappedView) -> int | None:
        """Index of an environment's target among the fruits of any of its views; None if that does not show it."""
        search = self._searches[env_index]
        names = [search.map.current(n) for n in view.tracks]
        return names.index(search.target) if search.target is not None and search.target in names else None

    def _fraction_in(self, env_index: int, view: MappedView | None) -> float:
        """V_f of an environment's target in one of its views."""
        if view is None:
            return 0.0
        search = self._searches[env_index]
        index = self._target_in(env_index, view)
        return search.map.fraction(view.measurement, index, search.target).value

    def _rays(self, seen: Sequence[MappedView | None]) -> ViewRays:
        parts = []
        for k, view in enumerate(seen):
            if view is None:
                parts.append(_NO_RAYS)
                continue
            parts.append(view.measurement.rays(self.position_w(k), self._target_in(k, view)))
        return ViewRays(
            torch.cat([part.direction_c for part in parts]).to(self._device),
            torch.cat([part.distance for part in parts]).to(self._device),
            torch.cat([part.label for part in parts]).to(self._device),
        )


def _slimmed(view: MappedView) -> MappedView:
    """An earlier view without what only the last one is asked for, its colours and the truth: a row has a hundred."""
    frame = view.measurement.frame
    if frame.rgb is None and frame.true_fruits is None and frame.told_fruits is None:
        return view
    frame = replace(frame, rgb=None, true_fruits=None, told_fruits=None, true_numbers=())
    return replace(view, measurement=replace(view.measurement, frame=frame))
