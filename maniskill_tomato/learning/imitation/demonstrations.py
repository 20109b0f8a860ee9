"""Demonstrations: a policy's successful episodes in ManiSkill's trajectory format.

`FOLDER/trajectory.h5` and `.json` hold observations, actions, rewards and states of every episode, and how to reset the
environment to its start. ManiSkill's `replay_trajectory` makes other observations of them, images too;
`trajectory_writer.replay_of` says how it makes the task.
"""

import copy
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import torch

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.folder_lock import only_writer
from maniskill_tomato.learning.imitation.trajectory_writer import (
    NAME,
    RecordedEpisode,
    Source,
    TrajectoryWriter,
    replay_of,
)
from maniskill_tomato.policies.adapters import as_state_policy
from maniskill_tomato.policies.protocol import Policy, reseed
from maniskill_tomato.tasks.gymnasium_form import numpy_of


@dataclass(frozen=True, kw_only=True)
class Demonstrations:
    """What was recorded."""

    path: Path
    """The .h5 file; the .json file stands beside it."""
    recorded: int
    """Successful episodes, which are in the file."""
    tried: int
    moves: int
    """Moves of the recorded episodes together."""


def record_demonstrations(
    env: gym.Env[Any, Any],
    policy: Policy,
    episodes: Iterable[int],
    folder: Path,
    reset_options: Callable[[int], dict[str, Any] | None] = lambda episode: None,
) -> Demonstrations:
    """Runs a policy and keeps the episodes that it solves.

    Args:
        env: A single environment; its observations are recorded as they are. It is closed.
        policy: Whose moves to record.
        episodes: Seeds of the resets.
        folder: Of the files; it must not hold demonstrations yet.
        reset_options: Options of each reset.

    Raises:
        InvalidInputError: The folder holds demonstrations.
        MissingPackageError: h5py, which comes with ManiSkill, is not installed.
        CheckpointError: Another process records in the folder, or it cannot be made.
        NotWrittenError: A file cannot be written.
    """
    with only_writer(folder, "records"):
        return _record(env, policy, episodes, folder, reset_options)


def _record(
    env: gym.Env[Any, Any],
    policy: Policy,
    episodes: Iterable[int],
    folder: Path,
    reset_options: Callable[[int], dict[str, Any] | None],
) -> Demonstrations:
    path = folder / f"{NAME}.h5"
    if path.exists():
        raise InvalidInputError(f"{path} exists; choose another folder, or delete it")
    inner: Any = env.unwrapped
    source = Source(
        spec=None if inner.spec is None else replay_of(inner.spec),
        source_type="motionplanning",
        source_desc=f"moves of the policy {policy.name!r} of maniskill-tomato",
    )
    writer = TrajectoryWriter(folder, source)
    acting = as_state_policy(policy, env)
    tried = 0
    try:
        for seed in episodes:
            options = reset_options(seed)
            observations, _ = env.reset(seed=seed, options=options)
            reseed(policy, seed)
            episode = RecordedEpisode(
                seed,
                inner.control_mode,
                copied_arrays(observations),
                options,
                copied_arrays(inner.get_state_dict()),
            )
            done = False
            while not done:
                action = acting.act(observations)
                step = env.step(action)
                observations, _, terminated, truncated, _ = step
                episode.add(copied_arrays(action), copied_arrays(step), copied_arrays(inner.get_state_dict()))
                done = bool(torch.as_tensor(terminated).any()) or bool(torch.as_tensor(truncated).any())
            tried += 1
            if episode.is_solved:
                writer.add(episode)
    finally:
        writer.save()
    env.close()
    return Demonstrations(path=path, recorded=len(writer.episodes), tried=tried, moves=writer.moves)


def copied_arrays(values: Any) -> Any:
    """What an environment or a policy told, as arrays that the next step cannot write to."""
    if isinstance(values, tuple):
        return tuple(map(copied_arrays, values))
    return copy.deepcopy(numpy_of(values))
