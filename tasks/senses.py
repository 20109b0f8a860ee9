"""What is sensed of the targets: the truth with a sensor's errors, or what a simulated camera measures.

The errors of a view follow from the episode's `noise_seed` and the number of the view, so that no environment changes
another's, and a view that is looked at again is measured the same.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Protocol, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.raycast.view_rays import ViewRays
from maniskill_tomato.robot.d435 import Calibration
from maniskill_tomato.robot.kinematics import link_transforms
from maniskill_tomato.sensing.camera_perception import CameraPerception
from maniskill_tomato.sensing.fruit_map import NO_TRACK
from maniskill_tomato.sensing.inspection import STALE_AFTER
from maniskill_tomato.sensing.inspection_judge import NO_FRUIT
from maniskill_tomato.sensing.observation import ViewpointObserver
from maniskill_tomato.sensing.perception_kinds import MAP_NOISE, RENDERED, Association, Naming, Perception
from maniskill_tomato.sensing.posed_frame import PosedFrame
from maniskill_tomato.sensing.sensor_noise import SensorErrors, SensorNoise
from maniskill_tomato.sensing.simulated_camera import make_camera
from maniskill_tomato.tasks.world import World
from maniskill_tomato.tasks.world_state import MAX_VIEWS, NOISE_SEEDS

VIEWS_A_SEED = 256
"""Views of an episode are fewer than this."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ViewMeasurement:
    """What N environments sense in a view; rows of those that do not look mean nothing."""

    rays: ViewRays
    """The pattern about where the targets are believed to be."""
    visible_fraction: Tensor
    """V_f that success and reward go by. Shape (N,)."""
    told_fraction: Tensor
    """V_f that the policy is told. Shape (N,)."""
    true_fraction: Tensor
    """V_f as it is. Shape (N,)."""
    tomato_seen: Tensor
    """Whether any ripe tomato is in view. Shape (N,), bool."""
    chosen_fraction: Tensor | None = None
    """V_f as it is of the fruit that a camera took for the target, 0 if of none; None without a camera. Shape (N,)."""
    chosen_fruit: Tensor | None = None
    """Which that is, as an index in `Plant.fruits`, -1 for none. Shape (N,)."""
    named: Tensor | None = None
    """Whether the robot knows which track its target is. Shape (N,), bool."""

    def where(self, mask: Tensor, other: "ViewMeasurement") -> "ViewMeasurement":
        """This where `mask` is True, else the other one. Shape (N,), bool."""
        column = mask[:, None]
        mine, others = self.rays, other.rays
        return ViewMeasurement(
            rays=ViewRays(
                torch.where(column[..., None], mine.direction_c, others.direction_c),
                torch.where(column, mine.distance, others.distance),
                torch.where(column, mine.label, others.label),
            ),
            visible_fraction=torch.where(mask, self.visible_fraction, other.visible_fraction),
            told_fraction=torch.where(mask, self.told_fraction, other.told_fraction),
            true_fraction=torch.where(mask, self.true_fraction, other.true_fraction),
            tomato_seen=torch.where(mask, self.tomato_seen, other.tomato_seen),
            chosen_fraction=_where(mask, self.chosen_fraction, other.chosen_fraction),
            chosen_fruit=_where(mask, self.chosen_fruit, other.chosen_fruit),
            named=_where(mask, self.named, other.named),
        )


def _where(mask: Tensor, mine: Tensor | None, others: Tensor | None) -> Tensor | None:
    return None if mine is None or others is None else torch.where(mask, mine, others)


@dataclass(frozen=True, eq=False, kw_only=True)
class ViewPoses:
    """From where environments look."""

    T_w_camera: Tensor
    """Poses of the optical frames. Shape (N, 4, 4)."""
    T_w_links: Tensor
    """Poses of the links. Shape (N, 9, 4, 4)."""
    qpos: Tensor
    """Joint positions, in [rad]. Shape (N, 7)."""
    look: Tensor
    """Number of the view in its episode, from 0. Shape (N,)."""
    mask: Tensor | None = None
    """Which environments look; all if None. Shape (N,), bool."""

    def seeds(self, noise_seed: Tensor) -> dict[int, int]:
        """What the errors of this view follow from, for each environment that looks, by its index.

        Args:
            noise_seed: Of the episodes. Shape (N,).
        """
        seeds = (noise_seed * VIEWS_A_SEED + self.look % VIEWS_A_SEED).tolist()
        looks = [True] * len(seeds) if self.mask is None else self.mask.tolist()
        return {i: int(seed) for i, (seed, looked) in enumerate(zip(seeds, looks, strict=True)) if looked}


def new_view(world: World, mask: Tensor | None) -> ViewPoses:
    """Counts and remembers a view from where arms stand now.

    Args:
        world: The arms.
        mask: Which environments look; all if None. Shape (N,), bool.
    """
    state = world.state
    rows = torch.arange(world.num_envs, device=world.device) if mask is None else mask.nonzero()[:, 0]
    state.views[rows, state.view_count[rows].clamp_max(MAX_VIEWS - 1)] = state.qpos[rows]
    view = ViewPoses(
        T_w_camera=world.T_w_camera,
        T_w_links=world.T_w_links,
        qpos=state.qpos,
        look=state.looks.clone(),
        mask=mask,
    )
    state.view_count[rows] += 1
    state.looks[rows] += 1
    return view


def remembered_views(world: World, env_idx: Tensor) -> Iterator[ViewPoses]:
    """The views of the present targets of some environments again, the first ones first. Shape (b,)."""
    state = world.state
    count = state.view_count.clamp_max(MAX_VIEWS)
    chosen = torch.zeros(world.num_envs, dtype=torch.bool, device=world.device)
    chosen[env_idx] = True
    for k in range(int(count[env_idx].max())):
        qpos = state.views[:, k]
        T_w_links = link_transforms(qpos)
        yield ViewPoses(
            T_w_camera=world.camera_poses(T_w_links),
            T_w_links=T_w_links,
            qpos=qpos,
            look=state.looks - state.view_count + k,
            mask=chosen & (k < count),
        )


def camera_info(measured: ViewMeasurement, full_visibility: float) -> dict[str, Tensor]:
    """What the infos of a task tell of a camera's view beside V_f: the truth, and which fruit was taken for the target.

    Args:
        measured: By a camera.
        full_visibility: V_f above which a fruit is fully visible.
    """
    assert measured.chosen_fraction is not None and measured.chosen_fruit is not None
    assert measured.named is not None
    return {
        "true_visible_fraction": measured.true_fraction.clone(),
        "true_success": measured.true_fraction > full_visibility,
        "told_visible_fraction": measured.told_fraction.clone(),
        "chosen_visible_fraction": measured.chosen_fraction.clone(),
        "chosen_fruit": measured.chosen_fruit.clone(),
        "target_named": measured.named.clone(),
    }


class Senses(Protocol):
    """What the environments of a world sense."""

    def begin(self, env_index: int, rng: np.random.RandomState, hidden_below: float) -> None:
        """Draws what the errors of an episode follow from; `hidden_below` as in `WorldState`."""
        ...

    def begin_targets(self, env_idx: Tensor) -> None:
        """Begins with other targets, of which nothing was seen yet. Shape (b,)."""
        ...

    def recall_targets(self, env_idx: Tensor) -> None:
        """The same for targets that were begun before, from the state of the world."""
        ...

    def known_target(self) -> Tensor:
        """Where the targets are believed to be, world frame, in [m]. Shape (N, 3)."""
        ...

    def look(self, view: ViewPoses) -> tuple[ViewMeasurement, Tensor | None]:
        """Looks; the second is which environments have located their target just now. Shape (b,)."""
        ...

    def revise(self, observer: ViewpointObserver, env_idx: Tensor) -> None:
        """Makes an observer take the earlier views of some environments in again, about where their targets are known
        to be now, all but the present view. Shape (b,)."""
        ...


class ExactSenses:
    """The truth, with the errors of a `SensorNoise`."""

    def __init__(self, world: World, noise: SensorNoise) -> None:
        """Senses in a world.

        Args:
            world: The plants and arms.
            noise: How much is wrong.
        """
        self._world = world
        self._noise = noise
        self._errors = SensorErrors(noise, world.device)

    def begin(self, env_index: int, rng: np.random.RandomState, hidden_below: float) -> None:
        """Draws the target's believed position and the seed of the rays' errors, where there are any."""
        state = self._world.state
        if self._noise.target_position:
            error = rng.normal(0.0, self._noise.target_position, 3)
            state.position_error[env_index] = torch.as_tensor(error).to(state.position_error)
        if self._errors.are_in_rays:
            state.noise_seed[env_index] = int(rng.randint(2**31 - 1)) % NOISE_SEEDS

    def begin_targets(self, env_idx: Tensor) -> None:
        """Nothing: the error of a target's position lasts for an episode."""

    def recall_targets(self, env_idx: Tensor) -> None:
        """Nothing."""

    def known_target(self) -> Tensor:
        """Where the targets are, with the episode's error. Shape (N, 3)."""
        position = self._world.target_position_w
        return position + self._world.state.position_error if self._noise.target_position else position

    def look(self, view: ViewPoses) -> tuple[ViewMeasurement, Tensor | None]:
        """Casts rays."""
        world = self._world
        target, T_w_plant = world.state.target, world.plant_batch.T_world_plant
        seen = world.scene.visibility(view.T_w_camera, target, T_w_plant, view.T_w_links, view.mask)
        rays = world.scene.view_rays(
            view.T_w_camera, target, self.known_target(), T_w_plant, view.T_w_links, view.mask
        )
        if self._errors.are_in_rays:
            rays = self._errors.rays(rays, view.seeds(world.state.noise_seed))
        fraction = seen.visible_fraction
        return ViewMeasurement(
            rays=rays,
            visible_fraction=fraction,
            told_fraction=self._errors.visible_fraction(fraction),
            true_fraction=fraction,
            tomato_seen=seen.any_visible,
        ), None

    def revise(self, observer: ViewpointObserver, env_idx: Tensor) -> None:
        """Nothing: where a target is believed to be does not change."""


LARGEST_MAP_NOISE = 0.5
"""In [m]."""


@dataclass(frozen=True, kw_only=True)
class CameraConfig:
    """How a robot that sees through a camera is told its target."""

    target: Naming = "track"
    """See `Naming`."""
    map_noise: float = MAP_NOISE
    """With `map`: standard deviation of each coordinate of the place that is given, in [m]."""
    association: Association = "map"
    """Who says which track a detection belongs to; `truth` to tell what identity costs."""
    calibration: Calibration = "nominal"
    """Of the colour camera where its images are cast, not rendered."""

    def __post_init__(self) -> None:
        for name, value, allowed in (
            ("target", self.target, get_args(Naming)),
            ("association", self.association, get_args(Association)),
        ):
            if value not in allowed:
                raise InvalidInputError.choice(name, value, allowed)
        if not 0.0 <= self.map_noise <= LARGEST_MAP_NOISE:
            raise InvalidInputError(
                f"map_noise must be from 0 to {LARGEST_MAP_NOISE} m; got {self.map_noise!r}"
            )


class CameraSenses:
    """Measures what a camera sees; where the truth is needed only to be told beside it, rays are cast."""

    def __init__(
        self,
        world: World,
        perception: Perception,
        config: CameraConfig,
        full_visibility: float,
        keeps_target: bool = False,
    ) -> None:
        """Senses in a world.

        Args:
            world: The plants and arms, with a renderer for those in `RENDERED`.
            perception: Which camera and estimator.
            config: How targets are named.
            full_visibility: V_f above which a fruit is fully visible.
            keeps_target: Whether a robot that chose its target never gives it up for another.
        """
        made = make_camera(
            perception,
            world.scene,
            world.intrinsics,
            self._picture,
            true_association=config.association == "truth",
            calibration=config.calibration,
        )
        assert made is not None
        self._world = world
        self._config = config
        self._full_visibility = full_visibility
        self._patience = None if keeps_target else STALE_AFTER
        self._camera, self._perception = made
        self._qpos = world.state.qpos
        self._pictures: NDArray[np.uint8] | None = None

    def begin(self, env_index: int, rng: np.random.RandomState, hidden_below: float) -> None:
        """Draws the seed that the errors of an episode follow from."""
        state = self._world.state
        state.noise_seed[env_index] = int(rng.randint(2**31 - 1)) % NOISE_SEEDS
        state.hidden_below[env_index] = hidden_below

    def begin_targets(self, env_idx: Tensor) -> None:
        """Draws where the targets are said to be, if that is how they are named."""
        state = self._world.state
        for i in env_idx.tolist():
            # Streams of targets and of views differ in the length of their keys.
            key = (int(state.noise_seed[i]), int(state.targets_begun[i]), 0)
            error = np.random.default_rng(key).normal(0.0, self._config.map_noise, 3)
            state.position_error[i] = torch.as_tensor(error).to(state.position_error)
            self._begin_target(i, is_first=int(state.targets_begun[i]) == 0)

    def recall_targets(self, env_idx: Tensor) -> None:
        """Begins with the same positions again; the views follow."""
        for i in env_idx.tolist():
            self._begin_target(i, is_first=int(self._world.state.targets_begun[i]) == 1)

    def _begin_target(self, env_index: int, *, is_first: bool) -> None:
        state, config = self._world.state, self._config
        place = None
        hidden_below = float(state.hidden_below[env_index]) if is_first else 0.0
        if config.target == "map":
            error = state.position_error[env_index]
            place = (self._world.target_position_w[env_index] + error).double().cpu().numpy()
        self._perception.begin(
            env_index,
            place,
            place_error=config.map_noise,
            hidden_below=hidden_below or None,
            chooses=config.target == "any",
            patience=self._patience,
            threshold=self._full_visibility,
        )

    @property
    def perception(self) -> CameraPerception:
        """What the camera has measured."""
        return self._perception

    def known_target(self) -> Tensor:
        """Where the targets were measured, or are thought to be. Shape (N, 3)."""
        return self._perception.target_position

    def look(self, view: ViewPoses) -> tuple[ViewMeasurement, Tensor | None]:
        """Takes and measures frames."""
        moved = self._take(view, view.mask)
        chosen = self._chosen(view.mask)
        for i in view.seeds(self._world.state.noise_seed):
            last = self._perception.last_view(i)
            if self._config.target != "map" and not bool(self._perception.is_located[i]) and last is not None:
                moved[i] |= self._name(i, last.measurement.frame)
                chosen[i] = self._shown_fruit(i)
            if self._config.target == "any" and int(chosen[i]) != NO_FRUIT and bool(moved[i]):
                self._judge_by(i, int(chosen[i]))
        return self._measured(view, chosen), moved.nonzero()[:, 0]

    def _take(self, view: ViewPoses, mask: Tensor | None) -> Tensor:
        """Takes frames of some environments into their maps; which targets turned out to be elsewhere.

        Args:
            view: From where.
            mask: Which environments look; all if None. Shape (N,), bool.

        Returns:
            Shape (N,), bool.
        """
        world = self._world
        for i, seed in replace(view, mask=mask).seeds(world.state.noise_seed).items():
            self._camera.seed(i, seed)
        self._qpos, self._pictures = view.qpos, None
        frames = self._camera.take(view.T_w_camera, world.plant_batch.T_world_plant, view.T_w_links, mask)
        return self._perception.look(frames)

    def _chosen(self, mask: Tensor | None) -> Tensor:
        """The fruits that the targets' detections show, of the environments that have looked. Shape (N,)."""
        n, device = self._world.num_envs, self._world.device
        looked = range(n) if mask is None else mask.nonzero()[:, 0].tolist()
        chosen = torch.full((n,), NO_FRUIT, device=device)
        for i in looked:
            chosen[i] = self._shown_fruit(i)
        return chosen

    def _measured(self, view: ViewPoses, chosen: Tensor) -> ViewMeasurement:
        """What was sensed, with the truth about the targets and about the fruits that were taken for them."""
        world = self._world
        target, T_w_plant = world.state.target, world.plant_batch.T_world_plant
        seen = world.scene.visibility(view.T_w_camera, target, T_w_plant, view.T_w_links, view.mask)
        at = torch.where(chosen == NO_FRUIT, target, chosen)
        of_chosen = seen
        if not torch.equal(at, target):
            of_chosen = world.scene.visibility(view.T_w_camera, at, T_w_plant, view.T_w_links, view.mask)
        return ViewMeasurement(
            rays=self._perception.rays(),
            visible_fraction=self._perception.sure_fraction,
            told_fraction=self._perception.visible_fraction,
            true_fraction=seen.visible_fraction,
            tomato_seen=seen.any_visible,
            chosen_fraction=torch.where(chosen == NO_FRUIT, 0.0, of_chosen.visible_fraction),
            chosen_fruit=chosen,
            named=self._perception.is_located,
        )

    def _name(self, env_index: int, frame: PosedFrame) -> bool:
        """Names the track that holds most of the target's pixels, if one does; whether it stands elsewhere.

        A detection of which less than half shows the target holds it by accident and is not named, nor is one without a
        depth of its own, which says too little of where it is. A second picture from one place makes no tracks, so what
        it alone shows has none to name.
        """
        last = self._perception.last_view(env_index)
        target = int(self._world.state.target[env_index])
        if self._config.target != "track" or last is None or target not in frame.true_numbers:
            return False
        assert frame.true_fruits is not None
        true = frame.true_fruits.masks[frame.true_numbers.index(target)]
        held = {}
        for k, number in enumerate(last.tracks):
            mask = last.measurement.mask(k)
            is_measured = last.measurement.fruits[k].is_depth_measured
            if number != NO_TRACK and is_measured and frame.shown_fruit(mask) == target:
                held[k] = int(np.count_nonzero(mask & true))
        return bool(held) and self._perception.point(env_index, max(held, key=lambda k: held[k]))

    def _shown_fruit(self, env_index: int) -> int:
        """The fruit that the target's detection in the last view shows."""
        last, index = self._perception.last_view(env_index), self._perception.target_fruit(env_index)
        if last is None or index is None:
            return NO_FRUIT
        shown = last.measurement.frame.shown_fruit(last.measurement.mask(index))
        return NO_FRUIT if shown is None else shown

    def _judge_by(self, env_index: int, fruit: int) -> None:
        """Makes a fruit that the robot has chosen the one that its episode is judged by, if it is ripe."""
        if fruit in self._world.plant_batch.ripe_fruits[env_index]:
            self._world.set_target(torch.tensor([env_index], device=self._world.device), [fruit])

    @property
    def ripe_detected(self) -> Tensor:
        """Whether the last views show a fruit that is believed to be ripe. Shape (N,), bool."""
        shown = [False] * self._world.num_envs
        for i in range(len(shown)):
            last, fruits = self._perception.last_view(i), self._perception.map(i)
            if last is not None:
                tracks = (fruits.tracks.get(number) for number in last.tracks)
                shown[i] = any(track is not None and track.is_ripe for track in tracks)
        return torch.tensor(shown, device=self._world.device)

    def revise(self, observer: ViewpointObserver, env_idx: Tensor) -> None:
        """Reads the kept measurements again."""
        self._perception.recall(observer, env_idx)

    def _picture(self, env_index: int) -> NDArray[np.uint8]:
        if self._pictures is None:
            if self._world.pictures is None:
                raise InvalidInputError("this perception needs colours, and the world has no renderer")
            self._pictures = self._world.pictures(self._qpos)
        picture: NDArray[np.uint8] = self._pictures[env_index]
        return picture


def check_pictures(perception: Perception, world: World) -> None:
    """Checks that a world has the pictures that a kind of perception needs.

    Raises:
        InvalidInputError: It has none.
    """
    if perception in RENDERED and world.pictures is None:
        raise InvalidInputError(
            f"perception={perception!r} renders colours, which a world without a simulator cannot; use "
            "gymnasium.make, or 'occlusion_model'"
        )
