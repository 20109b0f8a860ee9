"""Demonstrations in ManiSkill's trajectory format as episodes: one frame for each move, with the view before it."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.conversion.episodes import (
    FLAG,
    Episode,
    EpisodeSource,
    Feature,
    Frame,
    color,
    depth,
    flag,
)
from maniskill_tomato.conversion.recorded_runs import MOVE_NAMES, ONE_FRUIT, WHOLE_ROW
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.learning.imitation.trajectory_arrays import (
    opened_trajectories,
    read_description,
    stored_array,
)
from maniskill_tomato.policies.layout import ACTION_NAMES, OBSERVATION_NAMES
from maniskill_tomato.robot.iiwa14 import JOINT_NAMES
from maniskill_tomato.task_registry import GENERAL_IDS, base_of

ROBOT: Final = "iiwa14_d435"
"""ManiSkill's name of the robot of this package's tasks."""

ACTIONS: Final = {"pd_viewpoint": ACTION_NAMES, "pd_look_at": MOVE_NAMES}
"""What an action holds, by control mode."""

LARGEST_FRAME: Final = 256 * 2**20
"""Of one array of one frame, in [bytes]."""

MOST_MOVES: Final = 1_000_000
"""Of an episode."""


@dataclass(frozen=True, kw_only=True)
class _Part:
    """One feature and where it is stored."""

    place: str
    """In the group of an episode."""
    feature: Feature


def read_demonstrations(path: Path, task: str | None = None) -> EpisodeSource:
    """A trajectory file as episodes; those without a move are left out.

    Observations may be state vectors or dictionaries with images, as `replay_trajectory -o rgb+depth` makes them of a
    recorded file. Of images, colours and depth are taken.

    Args:
        path: The `.h5` file; its description, `.json`, stands beside it.
        task: What was to be done, in words; None for what the file says.

    Raises:
        InvalidInputError: A file is missing or damaged, or holds no move.
        MissingPackageError: h5py, which comes with ManiSkill, is not installed.
    """
    about = _about(path)
    with opened_trajectories(path) as groups:
        moving = [group for group in groups.values() if _moves(path, group)]
        if not moving:
            raise InvalidInputError(
                f"{path} holds no episode with a move; `maniskill-tomato demonstrations` records some"
            )
        parts = _parts(path, moving[0], _action_names(about))
    env_id = str(about.get("env_id", ""))
    words = task or (WHOLE_ROW if base_of(env_id) == GENERAL_IDS[1] else ONE_FRUIT)
    options = about.get("env_kwargs")
    robot = options.get("robot_uids") if isinstance(options, dict) else None
    return EpisodeSource(
        features={name: part.feature for name, part in parts.items()} | {"next.done": flag()},
        robot=robot if isinstance(robot, str) else ROBOT,
        episodes=_episodes(path, parts, words),
    )


def _action_names(about: Mapping[str, Any]) -> tuple[str, ...] | None:
    """Of what an action holds; None where that is not known."""
    return ACTIONS.get(str(about.get("control_mode", "")))


def _about(path: Path) -> dict[str, Any]:
    """What the description says of the task, and the control mode of the first episode."""
    content = read_description(path)
    about, episodes = content.get("env_info"), content.get("episodes")
    first = episodes[0] if isinstance(episodes, list) and episodes else None
    mode = first.get("control_mode") if isinstance(first, dict) else None
    return {**(about if isinstance(about, dict) else {}), "control_mode": mode}


def _moves(path: Path, group: Any) -> int:
    actions = stored_array(path, group, "actions")
    if actions is None or actions.ndim != 2 or actions.shape[0] > MOST_MOVES:
        raise InvalidInputError(f"{path}: {group.name} must hold actions of shape (T, A)")
    return int(actions.shape[0])


def _parts(path: Path, group: Any, action_names: tuple[str, ...] | None) -> dict[str, _Part]:
    """What an episode holds that can be converted, by the names of features."""
    import h5py

    found: dict[str, _Part] = {}

    def take(name: str, place: str, names: tuple[str, ...] | None = None) -> None:
        stored = stored_array(path, group, place)
        if stored is None or stored.ndim not in (1, 2):
            raise InvalidInputError(f"{path}: {group.name} must hold {place} as numbers for each step")
        if stored.dtype.kind not in "fiub":
            raise InvalidInputError(f"{path}: {group.name}/{place} must hold numbers, not {stored.dtype}")
        size = 1 if stored.ndim == 1 else stored.shape[1]
        if stored.ndim == 2 and (names is None or len(names) != size):
            names = tuple(f"{name.rpartition('.')[2]}_{k}" for k in range(size))
        found[name] = _Part(place=place, feature=Feature(dtype="float32", shape=(size,), names=names))

    observation = group.get("obs") if "obs" in group else None
    if isinstance(observation, h5py.Group):
        take("observation.state", "obs/agent/qpos", tuple(f"{name}.pos" for name in JOINT_NAMES))
        for name in _members(observation, "extra"):
            take(f"observation.{name}", f"obs/extra/{name}")
        for camera in _members(observation, "sensor_data"):
            found |= _images(path, group, camera)
    else:
        take("observation.state", "obs", OBSERVATION_NAMES)
    take("action", "actions", action_names)
    if stored_array(path, group, "rewards") is not None:
        found["next.reward"] = _Part(place="rewards", feature=Feature(dtype="float32", shape=FLAG))
    if stored_array(path, group, "success") is not None:
        found["next.success"] = _Part(place="success", feature=flag())
    return found


def _members(group: Any, name: str) -> list[str]:
    import h5py

    is_own = name in group and isinstance(group.get(name, getlink=True), h5py.HardLink)
    inner = group[name] if is_own else None
    return sorted(inner) if isinstance(inner, h5py.Group) else []


def _images(path: Path, group: Any, camera: str) -> dict[str, _Part]:
    """The colours and the depth of a camera."""
    found = {}
    for kind, channels, name in (("rgb", 3, camera), ("depth", 1, f"{camera}_depth")):
        place = f"obs/sensor_data/{camera}/{kind}"
        stored = stored_array(path, group, place)
        if stored is None:
            continue
        if stored.ndim != 4 or stored.shape[3] != channels or stored.dtype.kind not in "iu":
            raise InvalidInputError(
                f"{path}: {group.name}/{place} must be whole numbers of shape (T, H, W, {channels}), got "
                f"{stored.dtype} of shape {stored.shape}"
            )
        make = color if kind == "rgb" else depth
        height, width = stored.shape[1:3]
        found[f"observation.images.{name}"] = _Part(place=place, feature=make(height, width))
    return found


def _episodes(path: Path, parts: Mapping[str, _Part], task: str) -> Iterator[Episode]:
    with opened_trajectories(path) as groups:
        for name, group in groups.items():
            if _moves(path, group):
                yield Episode(task=task, frames=_frames(path, group, parts), source=f"{path}, {name}")


def _frames(path: Path, group: Any, parts: Mapping[str, _Part]) -> Iterator[Frame]:
    moves = _moves(path, group)
    arrays = {name: _stored(path, group, part, moves) for name, part in parts.items()}
    for step in range(moves):
        frame = {
            name: _converted(arrays[name][step], part.feature, f"{path}: {group.name}/{part.place}")
            for name, part in parts.items()
        }
        yield frame | {"next.done": np.array([step == moves - 1])}


def _stored(path: Path, group: Any, part: _Part, moves: int) -> Any:
    stored = stored_array(path, group, part.place)
    if stored is None or len(stored) < moves:
        raise InvalidInputError(f"{path}: {group.name} must hold {part.place} for each of its {moves} moves")
    if stored.nbytes // len(stored) > LARGEST_FRAME:
        raise InvalidInputError(
            f"{path}: a step of {group.name}/{part.place} is larger than {LARGEST_FRAME} bytes"
        )
    return stored


def _converted(value: Any, feature: Feature, where: str) -> NDArray[Any]:
    array = np.asarray(value)
    if feature.dtype == "image":
        largest = np.iinfo(feature.array_dtype).max
        if array.size and not 0 <= array.min() <= array.max() <= largest:
            raise InvalidInputError(f"{where} must hold values from 0 to {largest}")
        return array.astype(feature.array_dtype)
    return array.astype(feature.array_dtype).reshape(-1)
