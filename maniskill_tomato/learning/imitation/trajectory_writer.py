"""Demonstrations written in ManiSkill's trajectory format, as `mani_skill.utils.wrappers.record.RecordEpisode` does.

`FOLDER/trajectory.h5` has observations, actions, rewards, flags and states of every episode; `trajectory.json` says how
the environment is made and reset to the start of each. Both are replaced as a whole, so that a crash leaves what was
saved before.
"""

import io
import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from gymnasium.envs.registration import EnvSpec

from maniskill_tomato.errors import InvalidInputError, MissingPackageError
from maniskill_tomato.files import write_atomically, write_json
from maniskill_tomato.learning.imitation.trajectory_arrays import opened_trajectories, read_description
from maniskill_tomato.tasks import TASK_IDS

NAME: Final = "trajectory"
PACKAGE: Final = "maniskill_tomato"

FLAGS: Final = ("success", "fail")
"""What of a step's info is stored."""

StepResult = tuple[Any, Any, Any, Any, Mapping[str, Any]]
"""Observation, reward, termination, truncation and info of a Gymnasium step."""

WHOSE: Final = {"motionplanning": "a policy", "teleoperation": "a person"}
"""Who made the moves, by ManiSkill's word for it."""


@dataclass(frozen=True, kw_only=True)
class Source:
    """Where demonstrations come from."""

    spec: EnvSpec | None
    """Of the task, as `replay_of` says it; None where Gymnasium did not make it."""
    source_type: Literal["motionplanning", "teleoperation"]
    """ManiSkill's word for who made the moves."""
    source_desc: str
    """The same in a sentence."""

    def described(self) -> dict[str, Any]:
        """The head of the description, as JSON gives it back."""
        spec = self.spec
        told = {
            "env_info": None
            if spec is None
            else {
                "env_id": spec.id,
                "env_kwargs": dict(spec.kwargs),
                "max_episode_steps": spec.max_episode_steps,
            },
            "source_type": self.source_type,
            "source_desc": self.source_desc,
        }
        back: dict[str, Any] = json.loads(json.dumps(told))
        return back


class RecordedEpisode:
    """The episode of a single environment while it is made. Arrays are NumPy's; observations and states may be
    dictionaries of them. All have a row for each environment, which is one."""

    def __init__(
        self,
        seed: int,
        control_mode: str,
        observation: Any,
        options: Mapping[str, Any] | None = None,
        state: Mapping[str, Any] | None = None,
    ) -> None:
        """Begins with the first view.

        Args:
            seed: Of the reset.
            control_mode: What an action is.
            observation: Which the reset gave.
            options: Of the reset.
            state: Of the environment, if states are to be stored.
        """
        self.seed = seed
        self.control_mode = control_mode
        self.options = None if options is None else dict(options)
        self.observations = [observation]
        self.states = [] if state is None else [state]
        self.actions: list[Any] = []
        self.steps: list[dict[str, Any]] = []

    def add(self, action: Any, step: StepResult, state: Mapping[str, Any] | None = None) -> None:
        """Takes a move, what the step returned, and the state after it, which are kept as they are."""
        observation, reward, terminated, truncated, info = step
        self.actions.append(np.asarray(action, np.float32).reshape(-1))
        self.observations.append(observation)
        flags = {name: info[name] for name in FLAGS if name in info}
        self.steps.append({"terminated": terminated, "truncated": truncated, **flags, "rewards": reward})
        if state is not None:
            self.states.append(state)

    @property
    def moves(self) -> int:
        """How many were made."""
        return len(self.actions)

    @property
    def is_solved(self) -> bool:
        """Whether the last move was a success."""
        return bool(self.steps) and bool(np.any(self.steps[-1].get("success", False)))

    def arrays(self) -> dict[str, Any]:
        """What is stored of it, by name: nested dictionaries of arrays of shape (T, ...) or (T + 1, ...)."""
        stored = {"obs": _stacked(self.observations), "actions": np.stack(self.actions)}
        for name in self.steps[0]:
            kind = np.float32 if name == "rewards" else np.bool_
            stored[name] = np.array([np.asarray(step[name]).reshape(()) for step in self.steps], kind)
        if self.states:
            stored["env_states"] = _stacked(self.states)
        return stored


class TrajectoryWriter:
    """The two files of one folder, in memory until they are saved."""

    def __init__(self, folder: Path, source: Source) -> None:
        """Begins anew, or goes on with what the folder holds.

        Args:
            folder: Of the files.
            source: Of the episodes, of those that the folder holds too.

        Raises:
            InvalidInputError: What the folder holds cannot be read, or comes from elsewhere.
            MissingPackageError: h5py, which comes with ManiSkill, is not installed.
        """
        try:
            import h5py
        except ImportError as error:
            raise MissingPackageError(
                "demonstrations are written with h5py, which is not installed; it comes with ManiSkill "
                "(`make venv KIND=full`)"
            ) from error

        self.path = folder / f"{NAME}.h5"
        """The .h5 file."""
        self._about = source.described()
        self.episodes: list[dict[str, Any]] = []
        """What the description says of each."""
        is_there = self.path.exists() or self.path.with_suffix(".json").exists()
        if is_there:
            self.episodes = self._described()
        self._buffer = io.BytesIO(self.path.read_bytes() if is_there else b"")
        self._file: Any = h5py.File(self._buffer, "r+" if is_there else "w")
        for name in set(self._file) - {_group(entry) for entry in self.episodes}:
            # A crash between the two files leaves an episode without its description.
            del self._file[name]

    def check_source(self, source: Source) -> None:
        """Accepts episodes of the same source.

        Raises:
            InvalidInputError: They are of another task, or were made with other options or by somebody else.
        """
        self._check_same(source.described())

    @property
    def moves(self) -> int:
        """Of all episodes together."""
        return sum(int(entry["elapsed_steps"]) for entry in self.episodes)

    def add(self, episode: RecordedEpisode) -> None:
        """Takes an episode with a move or more; `save` writes it."""
        stored = episode.arrays()
        number = 1 + max((int(entry["episode_id"]) for entry in self.episodes), default=-1)
        entry: dict[str, Any] = {
            "episode_id": number,
            "episode_seed": episode.seed,
            "control_mode": episode.control_mode,
            "elapsed_steps": episode.moves,
            "reset_kwargs": {"options": episode.options, "seed": episode.seed},
        }
        entry |= {name: bool(stored[name][-1]) for name in FLAGS if name in stored}
        _put(self._file, _group(entry), stored)
        self.episodes.append(entry)

    def save(self) -> None:
        """Replaces both files.

        Raises:
            NotWrittenError: One cannot be written; the episodes are kept for the next time.
        """
        self._file.flush()
        write_atomically(self.path, self._buffer.getvalue())
        write_json(self.path.with_suffix(".json"), {**self._about, "episodes": self.episodes})

    def _described(self) -> list[dict[str, Any]]:
        """The episodes that the folder holds with their descriptions."""
        content = read_description(self.path)
        self._check_same(content)
        with opened_trajectories(self.path) as groups:
            names = set(groups)
        try:
            return [entry for entry in content["episodes"] if _group(entry) in names]
        except (KeyError, TypeError) as error:
            raise InvalidInputError(
                f"{self.path.with_suffix('.json')} describes no episodes; choose another folder"
            ) from error

    def _check_same(self, other: Mapping[str, Any]) -> None:
        """Compares a description with the writer's own."""
        for part in ("source_type", "env_info"):
            if other.get(part) != self._about[part]:
                raise InvalidInputError(
                    f"{self.path.parent} is for demonstrations of one task with the same options, made by the same: "
                    f"{_in_words(self._about)} cannot stand beside {_in_words(other)}; choose another folder"
                )


def replay_of(spec: EnvSpec) -> EnvSpec:
    """How a program that knows Gymnasium and ManiSkill only makes a task of this package again.

    The id names the package, which Gymnasium then imports, and nothing says whether pictures are drawn: the tasks draw
    where the observation mode asks for it.
    """
    kwargs = {name: value for name, value in spec.kwargs.items() if name != "render_backend"}
    return replace(spec, id=f"{PACKAGE}:{spec.id}" if spec.id in TASK_IDS else spec.id, kwargs=kwargs)


def _group(entry: Mapping[str, Any]) -> str:
    """Name of an episode's group."""
    return f"traj_{entry['episode_id']}"


def _put(group: Any, name: str, values: Any) -> None:
    """Stores an array, or nested dictionaries of arrays in their order."""
    if isinstance(values, Mapping):
        inner = group.create_group(name, track_order=True)
        for key, value in values.items():
            _put(inner, key, value)
    else:
        group.create_dataset(name, data=values)


def _stacked(rows: list[Any]) -> Any:
    """Arrays of one environment, one after the other."""
    if isinstance(rows[0], Mapping):
        return {key: _stacked([row[key] for row in rows]) for key in rows[0]}
    return np.concatenate(rows)


def _in_words(description: Mapping[str, Any]) -> str:
    about = description.get("env_info")
    about = about if isinstance(about, Mapping) else {}
    made_by = WHOSE.get(str(description.get("source_type")), "somebody else")
    return f"moves that {made_by} made in {about.get('env_id')} with {json.dumps(about.get('env_kwargs'))}"
