"""Demonstrations read from a trajectory file of ManiSkill, as `demonstrations.record_demonstrations` writes them."""

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.learning.imitation.trajectory_arrays import (
    opened_trajectories,
    read_description,
    stored_array,
)
from maniskill_tomato.task_registry import is_same_task

LARGEST_OBSERVATIONS: Final = 1_000_000_000
"""Of all episodes of a file together, unpacked, in [bytes]."""


@dataclass(frozen=True, eq=False, kw_only=True)
class DemonstratedMoves:
    """The N moves of demonstrations and the views that they led to; rewards are not read."""

    observations: Tensor
    """Observations before each move. Shape (N, D), float32."""
    actions: Tensor
    """As the task takes them. Shape (N, A), float32."""
    views: Tensor
    """Observations after each move. Shape (N, D), float32."""
    terminations: Tensor
    """1.0 where the episode ended for good with that view. Shape (N,)."""
    episodes: int
    """From which they are."""

    @property
    def digest(self) -> str:
        """Tells these demonstrations from others."""
        parts = self.observations, self.actions, self.views, self.terminations
        return hashlib.sha256(b"".join(part.numpy().tobytes() for part in parts)).hexdigest()


def read_demonstrations(path: Path, env_id: str) -> DemonstratedMoves:
    """Reads every episode of a file.

    Args:
        path: The `.h5` file; its description, `.json`, stands beside it.
        env_id: The task that they must be of.

    Raises:
        InvalidInputError: A file is missing or damaged, is of another task, or holds no move, observations that are no
            state vectors, or actions that are no vectors.
        MissingPackageError: h5py, which comes with ManiSkill, is not installed.
    """
    _check_task(path, env_id)
    episodes = _episodes(path)
    if not episodes:
        raise InvalidInputError(
            f"{path} holds no episode; record some with `maniskill-tomato demonstrations {env_id}`"
        )
    for name, rows in (
        ("observations", [observations for observations, _, _ in episodes]),
        ("actions", [actions for _, actions, _ in episodes]),
    ):
        if len({part.shape[1] for part in rows}) != 1 or not all(np.isfinite(part).all() for part in rows):
            raise InvalidInputError(f"{path} holds {name} of several lengths, or that are not finite")
    return DemonstratedMoves(
        observations=torch.from_numpy(np.concatenate([seen[:-1] for seen, _, _ in episodes])),
        actions=torch.from_numpy(np.concatenate([actions for _, actions, _ in episodes])),
        views=torch.from_numpy(np.concatenate([seen[1:] for seen, _, _ in episodes])),
        terminations=torch.from_numpy(np.concatenate([ended for _, _, ended in episodes])),
        episodes=len(episodes),
    )


def _check_task(path: Path, env_id: str) -> None:
    """Refuses a file that is not there, or of another task."""
    about = read_description(path).get("env_info")
    recorded = about.get("env_id") if isinstance(about, dict) else None
    if not is_same_task(str(recorded), env_id):
        raise InvalidInputError(
            f"{path} holds demonstrations of {recorded}, not of {env_id}; record some with "
            f"`maniskill-tomato demonstrations {env_id}`"
        )


_Episode = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]
"""Observations of shape (T + 1, D), actions of shape (T, A) and terminations of shape (T,)."""


def _episodes(path: Path) -> list[_Episode]:
    """Every episode with a move, in their order."""
    room = LARGEST_OBSERVATIONS

    def array(episode: Any, name: str) -> NDArray[np.float32]:
        nonlocal room
        stored = stored_array(path, episode, name)
        if stored is None:
            raise InvalidInputError(
                f"{path}: {episode.name} must hold {name} as an array; record with obs_mode 'state' and one arm"
            )
        room -= stored.nbytes
        if room < 0:
            raise InvalidInputError(f"{path} unpacks to more than {LARGEST_OBSERVATIONS} bytes")
        return np.asarray(stored[()], np.float32)

    episodes = []
    with opened_trajectories(path) as groups:
        for name, group in groups.items():
            observations, actions, ended = (array(group, part) for part in ("obs", "actions", "terminated"))
            moves = len(observations) - 1
            if (
                observations.ndim != 2
                or actions.ndim != 2
                or len(actions) != moves
                or ended.shape != (moves,)
            ):
                raise InvalidInputError(
                    f"{path}: {name} must have observations of shape (T + 1, D), actions of shape (T, A) and "
                    f"terminations of shape (T,), got {observations.shape}, {actions.shape} and {ended.shape}"
                )
            if moves:
                episodes.append((observations, actions, ended))
    return episodes
