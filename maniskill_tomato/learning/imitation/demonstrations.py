"""Demonstrations: a policy's successful episodes in ManiSkill's trajectory format.

`FOLDER/trajectory.h5` and `.json`, as `mani_skill.utils.wrappers.record.RecordEpisode` writes them: observations,
actions, rewards and states of every episode, and how to reset the environment to its start.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import torch

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.folder_lock import only_writer
from maniskill_tomato.policies.adapters import as_state_policy
from maniskill_tomato.policies.protocol import Policy, reseed

NAME = "trajectory"


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
        CheckpointError: Another process records in the folder, or it cannot be made.
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
    from mani_skill.utils.wrappers.record import RecordEpisode

    path = folder / f"{NAME}.h5"
    if path.exists():
        raise InvalidInputError(f"{path} exists; choose another folder, or delete it")
    task: Any = env
    recorder = RecordEpisode(
        task,
        output_dir=str(folder),
        save_video=False,
        save_on_reset=False,
        trajectory_name=NAME,
        source_type="motionplanning",
        source_desc=f"moves of the policy {policy.name!r} of maniskill-tomato",
    )
    acting = as_state_policy(policy, env)
    recorded = tried = moves = 0
    for episode in episodes:
        options = reset_options(episode)
        observations, _ = recorder.reset(seed=episode, options=options)
        reseed(policy, episode)
        done, success, steps = False, False, 0
        while not done:
            observations, _, terminated, truncated, info = recorder.step(acting.act(observations))
            steps += 1
            done = bool(torch.as_tensor(terminated).any()) or bool(torch.as_tensor(truncated).any())
            success = bool(torch.as_tensor(info["success"]).any())
        recorder.flush_trajectory(save=success)
        tried += 1
        recorded += int(success)
        moves += steps if success else 0
    recorder.close()
    return Demonstrations(path=path, recorded=recorded, tried=tried, moves=moves)
