"""Demonstrations of a person: the episodes that somebody solved by hand on the page, and the folder that keeps them."""

from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import gymnasium as gym

from maniskill_tomato.learning.imitation.trajectory_writer import (
    RecordedEpisode,
    Source,
    StepResult,
    TrajectoryWriter,
    replay_of,
)
from maniskill_tomato.sensing.perception_kinds import STATE_MODE
from maniskill_tomato.task_registry import find_task
from maniskill_tomato.view.play_settings import PlaySettings

POLICY_MOVED: Final = "a policy moved the arm"
TARGET_MOVED: Final = "the target was hung elsewhere"
NOT_SOLVED: Final = "it ended without success"


class PersonsDemonstrations:
    """Keeps the episodes that succeed and in which a person made every move, on the plant as it grew.

    Each is on the disk as soon as it ends. It is free of anything that is slow to import, to refuse a folder at once.
    """

    def __init__(self, folder: Path, settings: PlaySettings) -> None:
        """Begins a folder's files, or goes on with them.

        Args:
            folder: Held by the caller; see `folder_lock.only_writer`.
            settings: Of what is demonstrated.

        Raises:
            InvalidInputError: The folder holds other demonstrations, or what cannot be read.
            MissingPackageError: h5py, which comes with ManiSkill, is not installed.
        """
        self._writer = TrajectoryWriter(folder, _source(settings))
        self._episode: RecordedEpisode | None = None
        self._objection = ""

    @property
    def episodes(self) -> int:
        """How many are kept, those of earlier times too."""
        return len(self._writer.episodes)

    @property
    def moves(self) -> int:
        """Of these episodes together."""
        return self._writer.moves

    def check(self, settings: PlaySettings) -> None:
        """Accepts settings whose episodes can stand beside those that are kept.

        Raises:
            InvalidInputError: It is another task, or has other options.
        """
        self._writer.check_source(_source(settings))

    def begin(self, seed: int, control_mode: str, observation: Any) -> None:
        """Begins an episode; one that has not ended is dropped.

        Args:
            seed: Of the reset.
            control_mode: What an action is.
            observation: An array of shape (1, D).
        """
        self._episode = RecordedEpisode(seed, control_mode, observation)
        self._objection = ""

    def object(self, reason: str) -> None:
        """Leaves the present episode out, unless it has ended."""
        if self._episode is not None:
            self._episode, self._objection = None, reason

    def add(self, action: Any, step: StepResult) -> None:
        """Takes a move of the person and what the step returned, as arrays; an episode that succeeds is saved.

        Raises:
            NotWrittenError: It cannot be; it is kept for the next time.
        """
        episode = self._episode
        if episode is None:
            return
        episode.add(action, step)
        _, _, terminated, truncated, _ = step
        if not (bool(terminated[0]) or bool(truncated[0])):
            return
        if not episode.is_solved:
            self.object(NOT_SOLVED)
            return
        self._episode = None
        self._writer.add(episode)
        self._writer.save()

    @property
    def in_words(self) -> str:
        """How many are kept and where, and what becomes of the present one; Markdown."""
        if self._objection:
            present = f"this one does **not** count: {self._objection}"
        elif self._episode is None:
            present = "this one is kept"
        else:
            present = "this one counts if you reach success by your own moves alone"
        return f"**{self.episodes}** demonstrations in `{self._writer.path.parent}`; {present}."


def _source(settings: PlaySettings) -> Source:
    spec = gym.spec(find_task(settings.env_id).env_id)
    options = {"obs_mode": STATE_MODE, "num_envs": 1, **settings.world_options()}
    return Source(
        spec=replay_of(replace(spec, kwargs={**spec.kwargs, **options})),
        source_type="teleoperation",
        source_desc="moves that a person made on the page of `maniskill-tomato play`",
    )
