"""Arrays of a trajectory file of ManiSkill, which may be a stranger's: nothing is read that lies in another file."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from maniskill_tomato.errors import InvalidInputError, MissingPackageError
from maniskill_tomato.text_files import read_json


@contextmanager
def opened_trajectories(path: Path) -> Iterator[dict[str, Any]]:
    """Opens a file.

    Args:
        path: The `.h5` file.

    Yields:
        The h5py group of every episode by its name, in the order in which they were recorded.

    Raises:
        InvalidInputError: The file is missing, damaged, or refers to another one.
        MissingPackageError: h5py, which comes with ManiSkill, is not installed.
    """
    try:
        import h5py
    except ImportError as error:
        raise MissingPackageError(
            f"{path} is read with h5py, which is not installed; it comes with ManiSkill (`make venv KIND=full`)"
        ) from error

    try:
        with h5py.File(path, "r") as opened:
            file: Any = opened
            names = [name for name in file if name.startswith("traj_")]
            # traj_2 comes before traj_10.
            names.sort(key=lambda name: (len(name), name))
            for name in names:
                if not isinstance(file.get(name, getlink=True), h5py.HardLink):
                    raise InvalidInputError(f"{path}: {name} must lie in the file itself")
            yield {name: file[name] for name in names}
    except InvalidInputError:
        raise
    except (OSError, RuntimeError, ValueError, KeyError, TypeError, AttributeError, MemoryError) as error:
        raise InvalidInputError(f"{path} cannot be read as demonstrations: {error}") from error


def stored_array(path: Path, episode: Any, name: str) -> Any | None:
    """An array of an episode as h5py has it, not read yet; None if there is none of this name.

    Args:
        path: The file, for messages.
        episode: Group of the episode.
        name: Of the array, with slashes between the groups on the way to it.

    Raises:
        InvalidInputError: It lies in another file, which could be any file of this machine.
    """
    import h5py

    found: Any = episode
    for part in name.split("/"):
        if not isinstance(found, h5py.Group) or part not in found:
            return None
        if not isinstance(found.get(part, getlink=True), h5py.HardLink):
            raise InvalidInputError(f"{path}: {episode.name}/{name} must lie in the file itself")
        found = found[part]
    if not isinstance(found, h5py.Dataset):
        return None
    if found.is_virtual or found.external:
        raise InvalidInputError(f"{path}: {episode.name}/{name} must lie in the file itself")
    return found


def read_description(path: Path) -> dict[str, Any]:
    """What the .json file beside demonstrations says; empty where it holds something else than names and values.

    Raises:
        InvalidInputError: One of the two files is not there, or the description is no JSON.
    """
    description = path.with_suffix(".json")
    for file in (path, description):
        if not file.is_file():
            raise InvalidInputError(
                f"there is no file {file}; demonstrations are a .h5 file and a .json file of the same name"
            )
    content = read_json(description)
    return content if isinstance(content, dict) else {}
