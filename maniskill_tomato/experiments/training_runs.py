"""Training runs as their folders tell of them."""

import csv
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.text_files import read_json

REQUIRED_METRICS = ("env_id", "episodes", "seed", "success_rate", "mean_steps")

Float64 = NDArray[np.float64]


@dataclass(frozen=True, eq=False, kw_only=True)
class Run:
    """One training run with its evaluation, if it has one."""

    path: Path
    env_id: str
    seed: int
    config: dict[str, Any]
    """Every option of the run, and `env_options` where the task had any."""
    episodes: dict[str, Float64]
    """The columns of episodes.csv. Shape (episodes,) each."""
    clock: Float64 | None
    """Environment steps and the training time at which they were taken, in [s]; None if it was not logged.
    Shape (points, 2)."""
    metrics: dict[str, Any] | None
    """The content of metrics.json, if the run was evaluated."""

    @property
    def training_steps(self) -> int | None:
        """Environment steps of the run, as far as its files tell."""
        if self.clock is not None:
            return int(self.clock[-1, 0])
        return int(self.episodes["end_step"][-1]) if len(self.episodes["end_step"]) else None

    @property
    def training_seconds(self) -> float | None:
        """Training time, in [s], breaks between interrupted and resumed parts left out."""
        return None if self.clock is None else float(self.clock[-1, 1])


@dataclass(frozen=True, eq=False, kw_only=True)
class Group:
    """The runs of one configuration on one task, which differ in their seeds only."""

    env_id: str
    label: str
    """Short name that tells the configuration from the other ones."""
    runs: Sequence[Run]

    def scores(self, metric: str) -> Float64:
        """A figure of metrics.json for every evaluated run. Shape (evaluated runs,)."""
        return np.array(
            [run.metrics[metric] for run in self.runs if run.metrics is not None], dtype=np.float64
        )


def find_runs(folders: Iterable[Path]) -> list[Path]:
    """The run folders among `folders` and directly below them, in order and without repetition.

    Raises:
        InvalidInputError: One of them neither is a run nor holds one.
    """
    found: dict[Path, Path] = {}
    for folder in folders:
        below = [folder] if (folder / "config.json").is_file() else sorted(folder.glob("*/"))
        runs = [path for path in below if (path / "config.json").is_file()]
        if not runs:
            raise InvalidInputError(
                f"{folder} holds no run (no config.json in it or in a folder of it); give run folders of training"
            )
        found.update((path.resolve(), path) for path in runs)
    return list(found.values())


def load_run(path: Path) -> Run:
    """Reads a run folder: config.json, episodes.csv, the event files, and metrics.json where there is one.

    The evaluation is looked for in the run folder, in its `eval` folder and in a folder beside it with `-eval`
    added to its name.

    Raises:
        InvalidInputError: A file is missing or damaged, or the evaluation is of another task.
    """
    content = _read_json(path / "config.json")
    try:
        config, env_id, seed = dict(content["config"]), str(content["env_id"]), int(content["seed"])
    except (KeyError, TypeError, ValueError) as error:
        raise InvalidInputError(
            f"{path / 'config.json'} does not describe a run ({error!r}); it must hold env_id, seed and config"
        ) from error
    config.pop("wandb_project", None)  # Where a run logs does not make it another one.
    if content.get("env_options"):
        config["env_options"] = content["env_options"]
    metrics = None
    for folder in (path, path / "eval", path.with_name(f"{path.name}-eval")):
        if (folder / "metrics.json").is_file():
            metrics = _read_json(folder / "metrics.json")
            break
    if metrics is not None and not set(REQUIRED_METRICS) <= set(metrics):
        raise InvalidInputError(
            f"the metrics.json of {path} must hold {', '.join(REQUIRED_METRICS)}; evaluate the run again"
        )
    if metrics is not None and metrics.get("env_id") != env_id:
        raise InvalidInputError(
            f"{path} was trained on {env_id} and evaluated on {metrics.get('env_id')}; compare it without that "
            "metrics.json, or evaluate it on its own task"
        )
    return Run(
        path=path,
        env_id=env_id,
        seed=seed,
        config=config,
        episodes=read_columns(path / "episodes.csv"),
        clock=read_clock(path / "tensorboard"),
        metrics=metrics,
    )


def read_clock(folder: Path) -> Float64 | None:
    """When which environment step was taken, from TensorBoard's event files.

    Time counts from the start of a file and goes on where the file before it ended; steps that a resumed run
    took again count from the resumed part.

    Returns:
        Steps and seconds, rising. Shape (points, 2). None if the folder has no such events.
    """
    from tensorboard.backend.event_processing.event_file_loader import EventFileLoader

    clock: list[tuple[float, float]] = []
    for path in sorted(folder.glob("events.out.tfevents.*")):
        events = [(event.step, event.wall_time) for event in EventFileLoader(str(path)).Load()]
        before = clock[-1][1] if clock else 0.0
        part: dict[int, float] = {}
        spent, last = 0.0, events[0][1] if events else 0.0
        for step, time in events:
            spent += max(time - last, 0.0)  # A date that is set back takes no time.
            last = time
            if step > 0:
                part.setdefault(step, before + spent)
        if part:
            clock = [point for point in clock if point[0] < min(part)] + sorted(part.items())
    return np.array(clock, dtype=np.float64) if clock else None


def _read_json(path: Path) -> dict[str, Any]:
    try:
        content = read_json(path)
    except FileNotFoundError as error:
        raise InvalidInputError(f"there is no {path}") from error
    if not isinstance(content, dict):
        raise InvalidInputError(f"{path} must hold a JSON object, got {type(content).__name__}")
    return content


def read_columns(path: Path) -> dict[str, Float64]:
    """The columns of a run's `episodes.csv`; True counts 1 and False 0.

    Raises:
        InvalidInputError: It cannot be read.
    """
    words = {"True": 1.0, "False": 0.0}
    try:
        with path.open(newline="", encoding="utf-8") as file:
            header, *rows = csv.reader(file)
        columns = zip(*rows, strict=True) if rows else [()] * len(header)
        return {
            name: np.array([words[v] if v in words else float(v) for v in column], dtype=np.float64)
            for name, column in zip(header, columns, strict=True)
        }
    except (OSError, ValueError, csv.Error) as error:
        raise InvalidInputError(
            f"{path} cannot be read ({error}); training writes it with every checkpoint"
        ) from error
