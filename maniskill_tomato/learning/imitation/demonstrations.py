"""Demonstrations: a policy's successful episodes in ManiSkill's trajectory format.

`FOLDER/trajectory.h5` and `.json`, as `mani_skill.utils.wrappers.record.RecordEpisode` writes them: observations,
actions, rewards and states of every episode, and how to reset the environment to its start. ManiSkill's
`replay_trajectory` makes other observations of them, images too; `replay_of` says how it makes the task.
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import torch
from gymnasium.envs.registration import EnvSpec

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.folder_lock import only_writer
from maniskill_tomato.policies.adapters import as_state_policy
from maniskill_tomato.policies.protocol import Policy, reseed
from maniskill_tomato.tasks import TASK_IDS

NAME = "trajectory"
PACKAGE = "maniskill_tomato"


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
    with _described_for_replays(env):
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


def replay_of(spec: EnvSpec) -> EnvSpec:
    """How a program that knows Gymnasium and ManiSkill only makes a task of this package again.

    The id names the package, which Gymnasium then imports, and nothing says whether pictures are drawn: the tasks draw
    where the observation mode asks for it.
    """
    kwargs = {name: value for name, value in spec.kwargs.items() if name != "render_backend"}
    return replace(spec, id=f"{PACKAGE}:{spec.id}" if spec.id in TASK_IDS else spec.id, kwargs=kwargs)


@contextmanager
def _described_for_replays(env: gym.Env[Any, Any]) -> Iterator[None]:
    """Within it, whoever asks the environment what it is gets `replay_of` that."""
    inner = env.unwrapped
    spec = inner.spec
    inner.spec = None if spec is None else replay_of(spec)
    try:
        yield
    finally:
        inner.spec = spec
