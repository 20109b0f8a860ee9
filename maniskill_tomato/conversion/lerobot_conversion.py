"""Recordings and demonstrations as a data set for LeRobot."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from maniskill_tomato import __version__
from maniskill_tomato.conversion.episodes import EpisodeSource, Feature, check_fps, check_task
from maniskill_tomato.conversion.lerobot_dataset import LeRobotWriter
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.files import whole_folder, write_json
from maniskill_tomato.run_facts import command_text

ORIGIN = "origin.json"
"""Where the episodes are from; LeRobot does not read it."""

ENDINGS = (".mcap", ".h5")


@dataclass(frozen=True, kw_only=True)
class Converted:
    """What was written."""

    episodes: int
    frames: int
    features: tuple[str, ...]
    """Names of those that the sources hold."""


def check_sources(sources: Sequence[Path]) -> None:
    """Accepts files that can be converted together.

    Raises:
        InvalidInputError: There is none, one is missing, or they are not of one kind.
    """
    if not sources:
        raise InvalidInputError(
            "name one recording (run.mcap) or more, or one file of demonstrations (trajectory.h5) or more"
        )
    for path in sources:
        if path.suffix not in ENDINGS:
            raise InvalidInputError(
                f"{path} must end in {' or '.join(ENDINGS)}: a recording of `deploy run`, or demonstrations"
            )
        if not path.is_file():
            raise InvalidInputError(f"there is no file {path}")
    if len({path.suffix for path in sources}) > 1:
        raise InvalidInputError("recordings and demonstrations hold different things; convert them apart")


def convert_to_lerobot(
    sources: Sequence[Path],
    out: Path,
    *,
    fps: int = 1,
    task: str | None = None,
    depth: bool = True,
    on_episode: Callable[[], object] = lambda: None,
) -> Converted:
    """Writes LeRobotDataset v3.0; the folder appears when it is complete, or not at all.

    Args:
        sources: Files of one kind, in the order of the episodes.
        out: The new folder.
        fps: Frames a second by which frames get time stamps. A frame is a look, and looks have no fixed rate; a run's
            feature `seconds` holds when each was.
        task: What was to be done, in words; None for what each file says.
        depth: Whether to write images of depth, which not every policy of LeRobot takes.
        on_episode: Called after each.

    Raises:
        InvalidInputError: A file, an option or the folder cannot be used.
        MissingPackageError: pyarrow is not installed, or what reads the files.
        RecordingError: A recording cannot be read.
        NotWrittenError: The folder cannot be written.
    """
    check_sources(sources)
    check_fps(fps)
    check_task(task)
    first = _read(sources[0], task)
    features = {name: one for name, one in first.features.items() if depth or not one.is_depth}
    frames = episodes = 0
    origin: list[dict[str, Any]] = []
    with whole_folder(out) as folder:
        writer = LeRobotWriter(folder, features, fps, first.robot)
        with closing(writer):
            for number, path in enumerate(sources):
                source = first if number == 0 else _read(path, task)
                _check_alike(first, source, sources[0], path)
                for episode in source.episodes:
                    frames += writer.add(episode)
                    origin.append({"episode_index": episodes, "source": episode.source})
                    episodes += 1
                    on_episode()
            writer.finish()
        made_by = {"maniskill_tomato": __version__, "command": command_text()}
        write_json(folder / "meta" / ORIGIN, {**made_by, "episodes": origin})
    return Converted(episodes=episodes, frames=frames, features=tuple(features))


def _read(path: Path, task: str | None) -> EpisodeSource:
    if path.suffix == ".mcap":
        from maniskill_tomato.conversion.recorded_runs import read_run

        return read_run(path, task)
    from maniskill_tomato.conversion.demonstration_episodes import read_demonstrations

    return read_demonstrations(path, task)


def _check_alike(first: EpisodeSource, other: EpisodeSource, first_path: Path, path: Path) -> None:
    if first.robot != other.robot:
        raise InvalidInputError(
            f"{path} is of the robot {other.robot!r}, {first_path} of {first.robot!r}; convert them apart"
        )
    for name in sorted(first.features.keys() | other.features.keys()):
        one, two = first.features.get(name), other.features.get(name)
        if one != two:
            raise InvalidInputError(
                f"{path} and {first_path} cannot be one data set, because {name} is {_told(two)} there and "
                f"{_told(one)} here; convert them apart"
            )


def _told(feature: Feature | None) -> str:
    if feature is None:
        return "missing"
    info: Mapping[str, Any] = feature.info
    return f"{feature.dtype} of shape {feature.shape}" + (f" with {dict(info)}" if info else "")
