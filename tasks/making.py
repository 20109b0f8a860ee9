"""The tasks as configurations of a world."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, get_args

import torch

from maniskill_tomato.errors import InvalidInputError, did_you_mean
from maniskill_tomato.plants.episode_list import Episode, listed_plant
from maniskill_tomato.plants.spec import PlantPose, PlantSpec
from maniskill_tomato.robot.d435 import Calibration, CameraIntrinsics, color_intrinsics
from maniskill_tomato.robot.viewpoint_move import OutsideWorkspace
from maniskill_tomato.sensing.observation import ObservationLayout
from maniskill_tomato.sensing.perception_kinds import RENDERED, Perception
from maniskill_tomato.sensing.sensor_noise import SensorNoise
from maniskill_tomato.task_registry import TASK_IDS, Task, find_task
from maniskill_tomato.tasks import Scene
from maniskill_tomato.tasks.arm_moves import ArmMoves, Control
from maniskill_tomato.tasks.own_rules import OwnRules
from maniskill_tomato.tasks.row.episode_selection import EpisodeChoice
from maniskill_tomato.tasks.row.row_config import GeneralTaskConfig
from maniskill_tomato.tasks.row.search_game import SearchGame
from maniskill_tomato.tasks.row.target_sequence import Transits
from maniskill_tomato.tasks.senses import CameraConfig
from maniskill_tomato.tasks.thesis.thesis_config import ViewpointTaskConfig, thesis_task
from maniskill_tomato.tasks.thesis.thesis_game import ThesisGame
from maniskill_tomato.tasks.world import Game, Pictures, TaskConfig, World

IMAGE_SIZE = (160, 120)
"""Width and height of the wrist camera's picture unless somebody says otherwise, in [px]."""


@dataclass(frozen=True, kw_only=True)
class WorldOptions:
    """Options of all tasks."""

    plant: PlantSpec | Mapping[str, object] | str | None = None
    """A preset's name, a mapping of `PlantSpec` fields, or one with `mesh` and `MeshRules` fields; the task's own if
    None."""
    plant_pose: PlantPose | Sequence[float] | None = None
    """`(x, y, yaw)` of the stem in the world frame, in [m, m, rad]; the task's own if None."""
    plant_pose_noise: Sequence[float] | None = None
    """Half ranges of a uniform addition to it at every reset, in [m, m, rad]; the task's own if None."""
    rays_per_side: int = 16
    """A visible fraction is counted with this number of rays squared."""
    perception: Perception = "ground_truth"
    """Where V_f, the target's position and what is seen come from."""
    association: str | None = None
    """Who says which track a camera's detection belongs to, one of `Association`; `map` if None."""


@dataclass(frozen=True, kw_only=True)
class ThesisOptions(WorldOptions):
    """Options of the thesis's tasks."""

    scene: Scene = "hidden"
    """Plant, pose and camera: `hidden` from every start, or the `thesis`'s, in which its numbers hold."""
    task: ViewpointTaskConfig
    """Which, in the scene."""
    other_targets: int = 0
    """How many other ripe fruits are judged at every step as if each were the target."""


@dataclass(frozen=True, kw_only=True)
class SearchOptions(WorldOptions):
    """Options of the general tasks."""

    task: GeneralTaskConfig = GeneralTaskConfig()
    """Starts, thresholds and rewards."""
    episodes: str | Sequence[Episode] | None = None
    """Name of a fixed list, a `.json` file of one, or `Episode` objects."""
    layout: ObservationLayout | Sequence[str] | None = None
    """What the observation holds, or the names of its parts."""
    start_visibility: Sequence[float] | None = None
    """Range of V_f of the first view; the task's own if None."""
    contact_penalty: float | None = None
    """What a move with plant contact costs; the task's own if None."""
    sensor_noise: SensorNoise | Mapping[str, float] | None = None
    """What camera and segmenter get wrong about exact labels."""
    target: str | None = None
    """How the target is named to a robot that sees through a camera, one of `Naming`; `track` if None."""
    map_noise: float | None = None
    """With `target="map"`: standard deviation of each coordinate of the place that is given, in [m]; 0.03 if None."""


@dataclass(frozen=True, kw_only=True)
class RowOptions(SearchOptions):
    """Options of the row."""

    transits: Transits = "both"
    """When an arm goes by its ready posture."""

    def __post_init__(self) -> None:
        if self.episodes is not None:
            raise InvalidInputError("TomatoViewpointRow-v1 has no episode lists; choose plants with plant=")
        check_choice("transits", self.transits, get_args(Transits))


_KINDS: Mapping[str, type[ThesisOptions] | type[SearchOptions]] = dict(
    zip(TASK_IDS, (ThesisOptions, ThesisOptions, SearchOptions, RowOptions), strict=True)
)


def make_options(env_id: str, **options: Any) -> ThesisOptions | SearchOptions:
    """The options of a task, checked for their names.

    Raises:
        InvalidInputError: The id or an option's name is unknown.
    """
    task = find_task(env_id)
    kind = _KINDS[task.base]
    known = option_names(env_id)
    for name in options:
        if name not in known:
            raise InvalidInputError.choice(f"an option of {env_id}", name, sorted(known))
    given_task = options.get("task")
    fields_changed, options_changed = _split_settings(task)
    options = {**options_changed, **options}
    if kind is ThesisOptions:
        scene = options.get("scene", "hidden")
        if "scene" in options and given_task is not None:
            raise InvalidInputError(
                f"scene={scene!r} chooses the task's configuration; leave out scene= or task="
            )
        if given_task is None:
            options["task"] = thesis_task(task.base, scene)
    elif given_task is None:
        options["task"] = GeneralTaskConfig()
    if task.env_id not in TASK_IDS:
        config = options["task"]
        if given_task is None:
            config = replace(config, **_changes(config, fields_changed))
        options["task"] = replace(config, own=_own_rules(task))
    return kind(**options)


def _split_settings(task: Task) -> tuple[dict[str, Any], dict[str, Any]]:
    """The settings of a task that are fields of its base's configuration, and those that are options of the base.

    Raises:
        InvalidInputError: One is neither.
    """
    kind = ViewpointTaskConfig if _KINDS[task.base] is ThesisOptions else GeneralTaskConfig
    names = {field.name for field in fields(kind)} - {"own"}
    known = option_names(task.env_id) - {"task"}
    for name in task.settings:
        if name not in names | known:
            raise InvalidInputError(
                f"the settings of {task.env_id} have {name!r}, which is no field of {kind.__name__} and no option of "
                f"{task.base}{did_you_mean(name, names | known)}; they take {', '.join(sorted(names | known))}"
            )
    changed = {name: value for name, value in task.settings.items() if name in names}
    if task.base == TASK_IDS[2]:
        changed.setdefault("max_moves", task.max_episode_steps)
    return changed, {name: value for name, value in task.settings.items() if name not in names}


def _changes(config: TaskConfig, changed: Mapping[str, Any]) -> dict[str, Any]:
    """Fields of a configuration, the plant and its pose as what they change about the base's."""
    changes = dict(changed)
    if "plant" in changes:
        changes["plant"] = PlantSpec.parse(changes["plant"], config.plant)
    if "plant_pose" in changes:
        changes["plant_pose"] = PlantPose.parse(changes["plant_pose"], config.plant_pose)
    return changes


def _own_rules(task: Task) -> OwnRules:
    return OwnRules(
        env_id=task.env_id,
        reward=task.reward,
        largest_reward=task.largest_reward,
        starts=task.starts,
        success=task.success,
    )


def option_names(env_id: str) -> frozenset[str]:
    """Names of the options of a task that a world takes."""
    return frozenset(field.name for field in fields(_KINDS[find_task(env_id).base]))


def check_other_tasks(env_id: str, names: Iterable[str]) -> None:
    """Refuses options that only other tasks take.

    Args:
        env_id: The task.
        names: Of options that it does not take.

    Raises:
        InvalidInputError: One of them is another task's.
    """
    for name in names:
        takers = [other for other in TASK_IDS if name in option_names(other)]
        if takers and find_task(env_id).base not in takers:
            raise InvalidInputError(
                f"{env_id} has no {name}=, which is an option of {' and '.join(takers)}; "
                f"it takes {', '.join(sorted(option_names(env_id)))}"
            )


def default_control(env_id: str) -> Control:
    """What an action of a task is unless somebody says otherwise."""
    return "viewpoint" if _KINDS[find_task(env_id).base] is ThesisOptions else "look_at"


def wrist_intrinsics(
    width: int = IMAGE_SIZE[0], height: int = IMAGE_SIZE[1], calibration: Calibration = "nominal"
) -> CameraIntrinsics:
    """The wrist's colour camera at a size in [px]."""
    fov_y = color_intrinsics(width, height, calibration).fov_y
    return CameraIntrinsics.from_fov(width=width, height=height, fov_y=fov_y)


@dataclass(frozen=True, kw_only=True)
class TaskSetup:
    """A task with checked options, from which worlds are built."""

    make_game: Callable[[World], Game]
    """Makes the task's rules over a world."""
    plant: PlantSpec
    """The plants."""
    plant_pose: PlantPose
    """Where they stand."""
    plant_pose_noise: tuple[float, ...]
    """Half ranges of a uniform addition to it at every reset, in [m, m, rad]."""
    rays_per_side: int
    """A visible fraction is counted with this number of rays squared."""
    needs_pictures: bool = False
    """Whether a world needs a renderer."""
    follows_list: bool = False
    """Whether episodes come from a fixed list."""
    calibration: Calibration = "nominal"
    """Which numbers describe the wrist's colour camera unless somebody says otherwise."""
    neighbour_poses: bool = True
    """As for `ArmMoves`, like the next."""
    outside_workspace: OutsideWorkspace = "stay"

    def build(
        self,
        num_envs: int,
        device: str | torch.device,
        *,
        control: Control,
        intrinsics: CameraIntrinsics,
        pictures: Pictures | None = None,
    ) -> World:
        """A world; see `make_world`."""
        moves = ArmMoves(
            control,
            device,
            neighbour_poses=self.neighbour_poses,
            outside_workspace=self.outside_workspace,
        )
        return World(
            self.make_game,
            moves=moves,
            plant=self.plant,
            plant_pose=self.plant_pose,
            plant_pose_noise=self.plant_pose_noise,
            intrinsics=intrinsics,
            rays_per_side=self.rays_per_side,
            num_envs=num_envs,
            device=device,
            pictures=pictures,
        )


def make_world(
    env_id: str,
    num_envs: int = 1,
    device: str | torch.device = "cpu",
    *,
    control: Control | None = None,
    intrinsics: CameraIntrinsics | None = None,
    pictures: Pictures | None = None,
    growers: int = 0,
    **options: Any,
) -> World:
    """N environments of a task without a simulator.

    Args:
        env_id: The task; see `find_task`.
        num_envs: N.
        device: Where all tensors live.
        control: What an action is; the task's own if None.
        intrinsics: Of the wrist's camera; the task's at `IMAGE_SIZE` if None.
        pictures: A renderer, for perception that needs colours.
        growers: Processes that grow the plants of coming resets ahead; see `World.grow_ahead`.
        options: `ThesisOptions`, `SearchOptions` or `RowOptions`.

    Raises:
        InvalidInputError: An option cannot be used.
    """
    setup = make_setup(env_id, **options)
    check_integer("growers", growers, 0)
    if growers and not setup.plant.changes:
        raise InvalidInputError(
            f"growers={growers} have nothing to grow, because every episode has the plant of seed {setup.plant.seed}; "
            "leave them out, or draw plants with plant={'seed': 'train'}"
        )
    world = setup.build(
        num_envs,
        device,
        control=control or default_control(env_id),
        intrinsics=intrinsics or wrist_intrinsics(calibration=setup.calibration),
        pictures=pictures,
    )
    if growers:
        world.grow_ahead(growers)
    return world


def make_setup(env_id: str, **options: Any) -> TaskSetup:
    """A task with its options checked.

    Raises:
        InvalidInputError: The id or an option cannot be used.
    """
    checked = make_options(env_id, **options)
    check_integer("rays_per_side", checked.rays_per_side, 4, 256)
    return _thesis_setup(checked) if isinstance(checked, ThesisOptions) else _search_setup(checked)


def _thesis_setup(options: ThesisOptions) -> TaskSetup:
    task, others = options.task, options.other_targets
    check_integer("other_targets", others, 0)
    check_choice("perception", options.perception, get_args(Perception))
    camera = _camera_config(options)
    if others and options.perception != "ground_truth":
        raise InvalidInputError(
            "other_targets judges other fruits by the truth, which a robot with a camera does not know; leave it out "
            "with perception="
        )
    return TaskSetup(
        make_game=lambda world: ThesisGame(world, task, others, options.perception, camera),
        needs_pictures=options.perception in RENDERED,
        calibration=task.calibration,
        neighbour_poses=task.neighbour_poses,
        outside_workspace="home" if task.outside_workspace == "home" else "stay",
        **_standing(options, task, options.plant, (0.0, 0.0, 0.0)),
    )


def _search_setup(options: SearchOptions) -> TaskSetup:
    check_choice("perception", options.perception, get_args(Perception))
    noise = SensorNoise.parse(options.sensor_noise)
    if options.perception != "ground_truth" and noise != SensorNoise():
        raise InvalidInputError(
            "sensor_noise disturbs ground truth; leave it out with perception='occlusion_model', "
            "whose depth has noise of its own"
        )
    camera = _camera_config(options)
    task = options.task
    if options.start_visibility is not None:
        low, high = _finite_numbers("start_visibility", options.start_visibility, 2)
        task = replace(task, start_visibility=(low, high))
    if options.contact_penalty is not None:
        task = replace(task, contact_penalty=float(options.contact_penalty))
    episodes = EpisodeChoice(options.episodes)
    chosen = options.plant
    if chosen is None and isinstance(options.episodes, str):
        chosen = listed_plant(options.episodes)
    plant = PlantSpec.parse(chosen, task.plant)
    if episodes.episodes is not None:
        plant = plant.of_any_seed(episodes.split)
    layout = options.layout
    if layout is not None and not isinstance(layout, ObservationLayout):
        layout = ObservationLayout(parts=tuple(layout))  # type: ignore[arg-type]
    shape = layout or ObservationLayout()
    transits = options.transits if isinstance(options, RowOptions) else None
    return TaskSetup(
        make_game=lambda world: SearchGame(
            world,
            task,
            episodes=episodes,
            layout=shape,
            noise=noise,
            perception=options.perception,
            camera=camera,
            transits=transits,
        ),
        needs_pictures=options.perception in RENDERED,
        follows_list=episodes.episodes is not None,
        **_standing(options, task, plant, task.plant_pose_noise),
    )


def _camera_config(options: WorldOptions) -> CameraConfig:
    """How targets are named; in a row and in the thesis's tasks the robot chooses them."""
    given: dict[str, Any] = {
        name: value
        for name in ("target", "map_noise", "association")
        if (value := getattr(options, name, None)) is not None
    }
    if given and options.perception == "ground_truth":
        raise InvalidInputError(
            f"{next(iter(given))} is for a robot that sees through a camera; choose perception= as well"
        )
    if isinstance(options, RowOptions) and (named := [n for n in ("target", "map_noise") if n in given]):
        raise InvalidInputError(
            f"{named[0]} is for TomatoViewpoint-v1; in a row a robot with a camera chooses its targets itself"
        )
    if isinstance(options, ThesisOptions):
        given |= {"target": "any", "calibration": options.task.calibration}
    config = CameraConfig(**given)
    if "map_noise" in given and config.target != "map":
        raise InvalidInputError(f"map_noise goes with target='map'; got target={config.target!r}")
    return config


def _standing(
    options: WorldOptions,
    task: TaskConfig,
    plant: PlantSpec | Mapping[str, object] | str | None,
    noise: Sequence[float],
) -> dict[str, Any]:
    """Which plants stand where, and how their fruits are judged."""
    given = options.plant_pose_noise
    half_ranges = _finite_numbers("plant_pose_noise", noise if given is None else given, 3)
    if min(half_ranges) < 0.0:
        raise InvalidInputError(f"plant_pose_noise must be 3 finite numbers of 0 or more; got {given!r}")
    return {
        "plant": PlantSpec.parse(plant, task.plant),
        "plant_pose": PlantPose.parse(options.plant_pose, task.plant_pose),
        "plant_pose_noise": half_ranges,
        "rays_per_side": options.rays_per_side,
    }


def check_choice(name: str, value: str | None, allowed: Iterable[str]) -> None:
    """Accepts None and the `allowed` values of the option `name`.

    Raises:
        InvalidInputError: It is another; the message names those that are allowed.
    """
    if value is not None and value not in tuple(allowed):
        raise InvalidInputError.choice(name, value, allowed)


def check_integer(name: str, value: object, least: int, most: float = math.inf) -> None:
    """Accepts an integer of the option `name` in a range, ends included.

    Raises:
        InvalidInputError: It is none, or outside.
    """
    if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
        allowed = f"of {least} or more" if most == math.inf else f"from {least} to {most}"
        raise InvalidInputError(f"{name} must be an integer {allowed}; got {value!r}")


def _finite_numbers(name: str, values: Sequence[float], size: int) -> tuple[float, ...]:
    try:
        numbers = tuple(float(v) for v in values)
    except (TypeError, ValueError):
        numbers = ()
    if len(numbers) != size or not all(math.isfinite(v) for v in numbers):
        raise InvalidInputError(f"{name} must be {size} finite numbers; got {values!r}")
    return numbers
