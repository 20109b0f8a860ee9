"""What several commands take, and what they do with it."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, get_args

import tyro

from maniskill_tomato.errors import InvalidInputError, did_you_mean
from maniskill_tomato.extension_points import is_import_path
from maniskill_tomato.plants.seed_splits import SEED_SPLITS
from maniskill_tomato.sensing.perception_kinds import RENDERED, Naming, Perception
from maniskill_tomato.task_registry import TASK_IDS, THESIS_IDS, base_of
from maniskill_tomato.tasks import Scene
from maniskill_tomato.text_files import parse_json

TASK_HELP: Final = (
    f"The task: {', '.join(TASK_IDS)}, one of another package (`maniskill-tomato list tasks`), or "
    "package.module:attribute."
)

EnvId = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="ENV_ID", help=TASK_HELP)]


@dataclass(frozen=True, kw_only=True)
class PlantOptions:
    """Another plant than the task's own."""

    scene: Scene | None = None
    """Of the thesis's tasks, plant, pose and camera: hidden from every start, or the thesis's."""
    plant: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Preset of the plant: one_tomato, three_tomatoes, full, varied or other_kind; or a generator of another package
    (`maniskill-tomato list plants`), or package.module:callable."""
    mesh: Path | None = None
    """Plants from a mesh file, or from a folder of them with a new one in every episode, in place of grown ones
    (docs/plants.md)."""
    plant_seed: str | None = None
    """Its seed, or train, validation or held_out for a new plant of that split in every episode; with --mesh also
    all."""
    plant_pool: int | None = None
    """With a split, draw only from this number of its plants; plants seen before need not grow again."""
    plant_pose: tuple[float, float, float] | None = None
    """Where it stands: x [m], y [m], yaw [rad]."""
    plant_pose_noise: tuple[float, float, float] | None = None
    """Half ranges of a uniform addition to that in every episode: x [m], y [m], yaw [rad]."""

    def __post_init__(self) -> None:
        if self.plant is not None:
            _check_plant(self.plant)
        splits = tuple(SEED_SPLITS) if self.mesh is None else (*SEED_SPLITS, "all")
        if self.plant_seed is not None and not self.plant_seed.isdigit() and self.plant_seed not in splits:
            raise InvalidInputError(
                f"plant_seed must be a number or one of {', '.join(splits)}; got {self.plant_seed!r}"
                f"{did_you_mean(self.plant_seed, splits)}"
            )
        if self.mesh is not None and self.plant is not None:
            raise InvalidInputError("--mesh goes without --plant: its plants are read, not grown")
        if self.plant_pool is not None and self.plant_pool < 1:
            raise InvalidInputError(f"plant_pool must be 1 or more, got {self.plant_pool}")

    def env_options(self) -> dict[str, Any]:
        """The options for `gymnasium.make`.

        Raises:
            InvalidInputError: There is no such mesh.
        """
        if self.mesh is not None and not self.mesh.exists():
            raise InvalidInputError(f"--mesh: there is no file or folder {self.mesh}")
        plant: dict[str, Any] = {}
        if self.plant is not None:
            from maniskill_tomato.plants.kinds import PLANT_NAMES

            plant["preset" if self.plant in PLANT_NAMES else "generator"] = self.plant
        if self.mesh is not None:
            plant["mesh"] = str(self.mesh.absolute())
        if self.plant_seed is not None:
            plant["seed"] = int(self.plant_seed) if self.plant_seed.isdigit() else self.plant_seed
        if self.plant_pool is not None:
            plant["pool"] = self.plant_pool
        options: dict[str, Any] = {} if self.scene is None else {"scene": self.scene}
        if plant:
            options["plant"] = plant
        if self.plant_pose is not None:
            options["plant_pose"] = self.plant_pose
        if self.plant_pose_noise is not None:
            options["plant_pose_noise"] = self.plant_pose_noise
        return options


def _check_plant(name: str) -> None:
    from maniskill_tomato.plants.kinds import PLANT_NAMES

    if name in PLANT_NAMES:
        return
    from maniskill_tomato.plants.plant_generators import PLANT_GENERATORS

    if not PLANT_GENERATORS.has(name):
        raise InvalidInputError.choice(
            "--plant", name, (*PLANT_NAMES, *PLANT_GENERATORS.names(), "package.module:callable")
        )
    if is_import_path(name):
        PLANT_GENERATORS.load(name)


def camera_options(
    env_id: str, perception: str, target: str | None, map_noise: float | None
) -> dict[str, Any]:
    """The options of camera perception for `gymnasium.make`; none for ground truth.

    Raises:
        InvalidInputError: One is not allowed.
    """
    for flag, value, allowed in (
        ("--perception", perception, get_args(Perception)),
        ("--target", target, get_args(Naming)),
    ):
        if value is not None and value not in allowed:
            raise InvalidInputError.choice(flag, value, allowed)
    named = {"target": target, "map_noise": map_noise}
    options: dict[str, Any] = {name: value for name, value in named.items() if value is not None}
    if perception == "ground_truth":
        if options:
            raise InvalidInputError(
                "--target and --map-noise are for a robot that sees through a camera; give --perception as well"
            )
        return {}
    if options and base_of(env_id) in THESIS_IDS:
        raise InvalidInputError(
            "--target and --map-noise are for TomatoViewpoint-v1; in the thesis's tasks a robot with a camera "
            "chooses its target itself"
        )
    if perception in RENDERED:
        options["render_backend"] = "auto"
    return {"perception": perception, **options}


def merge_options(base: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """The task options `base` with `changes` put over them, one by one within tables such as `plant`.

    A plant that `base` only names becomes a table, and what another one is taken from replaces that.
    """
    from maniskill_tomato.plants.kinds import PLANT_NAMES

    merged, sources = dict(base), ("preset", "generator", "mesh")
    if isinstance(plant := merged.get("plant"), str):
        merged["plant"] = {"preset" if plant in PLANT_NAMES else "generator": plant}
    for name, value in changes.items():
        old = merged.get(name)
        if isinstance(old, dict) and isinstance(value, dict):
            if name == "plant" and any(source in value for source in sources):
                old = {key: kept for key, kept in old.items() if key not in sources}
            value = {**old, **value}
        merged[name] = value
    return merged


def parse_env_options(options: Mapping[str, str]) -> dict[str, Any]:
    """Options of a task from the command line: each value as JSON where it is some, else as the text itself."""
    parsed: dict[str, Any] = {}
    for name, text in options.items():
        try:
            parsed[name] = parse_json(text)
        except InvalidInputError:
            parsed[name] = text
    return parsed


def say(line: str) -> None:
    """Prints a line of progress at once, also into a pipe."""
    print(line, flush=True)


def tell_policy(train: Callable[[Callable[[str], None]], Path]) -> None:
    """Trains and says where the policy is and how long it took.

    Args:
        train: Given whom to tell a line, it returns the policy's file.
    """
    start = time.perf_counter()
    path = train(say)
    print(f"policy {path} after {time.perf_counter() - start:.0f} s")
