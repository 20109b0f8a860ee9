"""Runs compared: grouped by configuration over seeds, with interquartile means and bootstrap intervals."""

import csv
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.experiments.statistics import interquartile_band, interquartile_mean
from maniskill_tomato.learning.rl.presets import PRESETS, TrainConfig, modernise

CURVE_POINTS = 120
CURVE_WINDOW = 0.05
"""Share of the axis that a training curve averages over."""

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


@dataclass(frozen=True, eq=False, kw_only=True)
class Curve:
    """A figure over the course of training: interquartile mean over runs, with its band."""

    at: Float64
    """Environment steps or seconds. Shape (points,)."""
    mean: Float64
    """Shape (points,)."""
    low: Float64
    """Equal to the mean for a single run. Shape (points,)."""
    high: Float64
    """Shape (points,)."""


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
        episodes=_read_episodes(path / "episodes.csv"),
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
        for step, time in events:
            if step > 0:
                part.setdefault(step, before + time - events[0][1])
        if part:
            clock = [point for point in clock if point[0] < min(part)] + sorted(part.items())
    return np.array(clock, dtype=np.float64) if clock else None


def group_runs(runs: Sequence[Run]) -> list[Group]:
    """The runs by task and configuration, in the order of their first appearance within a task.

    Raises:
        InvalidInputError: Two runs have the same task, configuration and seed.
    """
    found: dict[tuple[str, str], list[Run]] = {}
    for run in runs:
        same = found.setdefault((run.env_id, json.dumps(run.config, sort_keys=True)), [])
        for other in same:
            if other.seed == run.seed:
                raise InvalidInputError(
                    f"{other.path} and {run.path} have the same task, configuration and seed; give one of them"
                )
        same.append(run)
    configs = [members[0].config for members in found.values()]
    groups = [
        Group(
            env_id=env_id,
            label=_label(members[0].config, configs),
            runs=sorted(members, key=lambda run: run.seed),
        )
        for (env_id, _), members in found.items()
    ]
    return sorted(groups, key=lambda group: group.env_id)


def training_curve(group: Group, column: str, wall_time: bool) -> Curve | None:
    """A column of episodes.csv over the course of training, averaged over a window and then over the runs.

    Each point is the mean of the episodes that ended within the last twentieth of the axis before it; the axis
    ends where the shortest run of the group does. The band is the pointwise 95 % interval.

    Args:
        group: The runs.
        column: The column, for instance `success`.
        wall_time: Over training time in [s] instead of environment steps.

    Returns:
        None if a run has no finished episode or, for `wall_time`, no clock.
    """
    series: list[tuple[Float64, Float64]] = []
    for run in group.runs:
        at = run.episodes["end_step"]
        if len(at) == 0 or (wall_time and run.clock is None):
            return None
        if wall_time and run.clock is not None:
            at = np.interp(at, run.clock[:, 0], run.clock[:, 1])
        series.append((at, run.episodes[column]))
    end = min(float(at[-1]) for at, _ in series)
    grid = np.linspace(end / CURVE_POINTS, end, CURVE_POINTS)
    smooth = np.stack([trailing_mean(at, values, grid, CURVE_WINDOW * end) for at, values in series])
    known = np.isfinite(smooth).all(axis=0)
    smooth, grid = smooth[:, known], grid[known]
    mean = interquartile_mean(smooth, axis=0)
    low, high = interquartile_band(smooth)
    return Curve(at=grid, mean=mean, low=low, high=high)


def trailing_mean(at: Float64, values: Float64, grid: Float64, window: float) -> Float64:
    """Mean of the values whose place is in (g - window, g] for every g of `grid`; NaN where there is none.

    Args:
        at: Places of the values, rising. Shape (N,).
        values: Shape (N,).
        grid: Shape (G,).
        window: Width of the window, in units of `at`.

    Returns:
        Shape (G,).
    """
    sums = np.concatenate(([0.0], np.cumsum(values)))
    first = np.searchsorted(at, grid - window, side="right")
    after = np.searchsorted(at, grid, side="right")
    counts = after - first
    means: Float64 = np.where(counts > 0, (sums[after] - sums[first]) / np.maximum(counts, 1), np.nan)
    return means


def _label(config: dict[str, Any], others: Sequence[dict[str, Any]]) -> str:
    """The algorithm or nearest preset, and what differs from that preset or between runs of the algorithm."""
    algorithm = config.get("algorithm")
    options = {k: v for k, v in config.items() if k not in ("algorithm", "env_options")}
    shown: dict[str, Any] = {}
    if algorithm is None:
        algorithm, shown = _nearest_preset(options)
    else:
        same = [other for other in others if other.get("algorithm") == algorithm]
        shown = {k: v for k, v in options.items() if any(other.get(k) != v for other in same)}
    parts = [str(algorithm), *(f"{name} {_short(value)}" for name, value in shown.items())]
    if "env_options" in config:
        parts.append(json.dumps(config["env_options"], sort_keys=True))
    return ", ".join(parts)


def _nearest_preset(options: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    """The preset that shares most options, and the options that it does not share."""
    defaults = TrainConfig(total_timesteps=1).to_dict()
    complete = {**defaults, "total_timesteps": None, **modernise(options)}
    differences: dict[str, dict[str, Any]] = {}
    for name, preset in PRESETS.items():
        values = preset.to_dict()
        differences[name] = {k: v for k, v in complete.items() if k not in values or values[k] != v}
    nearest = min(differences, key=lambda name: len(differences[name]))
    return nearest, differences[nearest]


def _short(value: object) -> str:
    if isinstance(value, float):
        return f"{value:g}"
    return "x".join(_short(v) for v in value) if isinstance(value, list) else str(value)


def _read_json(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InvalidInputError(f"{path} cannot be read as JSON: {error}") from error
    if not isinstance(content, dict):
        raise InvalidInputError(f"{path} must hold a JSON object, got {type(content).__name__}")
    return content


def _read_episodes(path: Path) -> dict[str, Float64]:
    """The columns of episodes.csv; True counts 1 and False 0."""
    words = {"True": 1.0, "False": 0.0}
    try:
        with path.open(newline="", encoding="utf-8") as file:
            header, *rows = csv.reader(file)
        columns = zip(*rows, strict=True) if rows else [()] * len(header)
        return {
            name: np.array([words[v] if v in words else float(v) for v in column], dtype=np.float64)
            for name, column in zip(header, columns, strict=True)
        }
    except (OSError, ValueError) as error:
        raise InvalidInputError(
            f"{path} cannot be read ({error}); training writes it with every checkpoint"
        ) from error
