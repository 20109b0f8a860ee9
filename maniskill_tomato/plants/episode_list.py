"""Fixed lists of episodes: which plant, where it stands, which target, where the camera starts, and who solves it."""

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, fields
from functools import cache
from pathlib import Path
from typing import Any

from maniskill_tomato.assets import asset_path
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.files import write_atomically
from maniskill_tomato.plants.plant_generators import check_recorded_plant
from maniskill_tomato.text_files import read_json

EPISODE_LISTS = ("validation", "held_out")
"""The lists in the package, named like the split of seeds that their plants come from."""


@dataclass(frozen=True, kw_only=True)
class Episode:
    """One episode of the general task."""

    plant_seed: int
    """The middle plant, which also draws its neighbours."""
    leaf_density: float
    """Of the middle plant, for sorting: it follows from the seed."""
    plant_pose: tuple[float, float, float]
    """x, y of the stem and yaw, world frame, in [m, m, rad]."""
    target: int
    """Index of the fruit in `Plant.fruits`."""
    camera_position: tuple[float, float, float]
    """Where the camera starts, world frame, in [m]; it looks at the target."""
    start_visibility: float
    """V_f of the first view."""
    oracle_moves: int | None = None
    """Fewest moves that the oracle needs within the task's limit; None if it finds no way, or was not asked."""
    certified: bool = False
    """Whether the oracle was asked."""

    def __post_init__(self) -> None:
        # Lists of JSON become what the annotations say.
        object.__setattr__(self, "plant_pose", tuple(float(v) for v in self.plant_pose))
        object.__setattr__(self, "camera_position", tuple(float(v) for v in self.camera_position))
        if len(self.plant_pose) != 3 or len(self.camera_position) != 3:
            raise InvalidInputError("plant_pose and camera_position must be three numbers each")
        if self.oracle_moves is not None and not self.certified:
            raise InvalidInputError("an episode with oracle_moves must be certified")


def episode_path(name: str) -> Path:
    """The file of a list of `EPISODE_LISTS`, or the one that the name itself is the path of.

    Raises:
        InvalidInputError: There is no such list.
    """
    if name.endswith(".json") and Path(name).is_file():
        return Path(name)
    if name not in EPISODE_LISTS:
        raise InvalidInputError.choice("episodes", name, (*EPISODE_LISTS, "a .json file of such a list"))
    return Path(asset_path(f"episodes/{name}.json"))


@cache
def load_episodes(name: str) -> tuple[Episode, ...]:
    """A list of the package, or of a file.

    Args:
        name: One of `EPISODE_LISTS`, or the path of a `.json` file.

    Raises:
        InvalidInputError: There is no such list.
    """
    return read_episodes(episode_path(name))


def listed_plant(name: str) -> dict[str, Any] | None:
    """The option `plant` of the plants that a list was drawn on; None for the task's own.

    Args:
        name: As for `load_episodes`.

    Raises:
        InvalidInputError: There is no such list, or it names plants in another form, or a module of
                plants that only it names.
    """
    path = episode_path(name)
    content = read_json(path)
    plant = content.get("plant") if isinstance(content, dict) else None
    if plant is not None and not isinstance(plant, dict):
        raise InvalidInputError(f"`plant` of {path} must be a table as the task option is, got {plant!r}")
    check_recorded_plant(plant, path, "")
    return plant


def read_episodes(path: Path) -> tuple[Episode, ...]:
    """The episodes of a file that `write_episodes` wrote.

    Raises:
        InvalidInputError: The file is of another form.
    """
    try:
        rows = read_json(path)["episodes"]
        known = {field.name for field in fields(Episode)}
        if not rows or any(set(row) - known for row in rows):
            raise KeyError
        return tuple(Episode(**row) for row in rows)
    except (KeyError, TypeError, ValueError) as error:
        raise InvalidInputError(
            f"{path} is no list of episodes; it must hold {{'episodes': [...]}} with the fields of Episode"
        ) from error


def write_episodes(path: Path, episodes: Iterable[Episode], plant: Mapping[str, Any] | None = None) -> None:
    """Writes a list, one episode a line.

    Args:
        path: The file.
        episodes: In order.
        plant: The option `plant` of the plants that they were drawn on, where these are not the task's own.
    """
    lines = ",\n".join(json.dumps(asdict(episode)) for episode in episodes)
    on = "" if plant is None else f'"plant": {json.dumps(dict(plant))},\n'
    write_atomically(path, f'{{{on}"episodes": [\n{lines}\n]}}\n'.encode())
