"""What a file or folder holds that a viewer can show; free of anything that is slow to import."""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from maniskill_tomato.errors import InvalidInputError

RECORDING: Final = "run.mcap"
"""What `deploy run` and `deploy inspect` write into their folder."""

EPISODES: Final = "results/*/about.json"
"""What `benchmark` and `eval` write into theirs; see `experiments.stored_episodes`."""


@dataclass(frozen=True, kw_only=True)
class RunFile:
    """The recording of a run on an arm or its twin."""

    path: Path


@dataclass(frozen=True, kw_only=True)
class EpisodeFolder:
    """Stored episodes of one or more policies."""

    folder: Path


def find_record(path: Path) -> RunFile | EpisodeFolder:
    """What a path holds; a report or another file of a folder stands for its folder.

    Raises:
        InvalidInputError: It is not there, or holds nothing that can be shown.
    """
    if not path.exists():
        raise InvalidInputError(f"--record: there is no file or folder {path}")
    if path.suffix.lower() == ".mcap":
        return RunFile(path=path)
    folder = path if path.is_dir() else path.parent
    if (folder / RECORDING).is_file():
        return RunFile(path=folder / RECORDING)
    # The evaluation of a training stands inside its folder.
    for place in (folder, folder / "eval"):
        if any(place.glob(EPISODES)):
            return EpisodeFolder(folder=place)
    if any(folder.glob("results/*/*.jsonl")) or (folder / "trajectories.npz").is_file():
        raise InvalidInputError(
            f"{path} was written by a version that did not say on which plants its episodes ran; give its command "
            "again with the same --out (a benchmark runs no episode twice)"
        )
    raise InvalidInputError(
        f"{path} holds no record; --record takes the folder of `benchmark`, `eval`, `deploy run` or `deploy inspect`, "
        f"or a {RECORDING}"
    )
