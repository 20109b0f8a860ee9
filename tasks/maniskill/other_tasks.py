"""The tasks that others registered as ManiSkill environments."""

from functools import cache
from typing import Any

import gymnasium as gym
from mani_skill.utils.registration import REGISTERED_ENVS, TimeLimitWrapper, register

from maniskill_tomato.task_registry import TASK_IDS, Task, find_task
from maniskill_tomato.tasks.maniskill import registered_envs
from maniskill_tomato.tasks.maniskill.shell import TomatoEnv
from maniskill_tomato.tasks.registration import OWN_MAKERS

_BASES: dict[str, type[TomatoEnv]] = {
    env_id: getattr(registered_envs, single) for env_id, (single, _) in zip(TASK_IDS, OWN_MAKERS, strict=True)
}


def make_task_env(env_id: str, **options: Any) -> TomatoEnv:
    """One environment of a task, or several on a GPU; what `gymnasium.make` makes.

    Args:
        env_id: Its ID.
        options: Of the task and of ManiSkill.

    Raises:
        InvalidInputError: The task's package cannot be imported, or an option cannot be used.
    """
    return _class_of(find_task(env_id))(**options)


def limit_time(env: gym.Env[Any, Any], env_id: str) -> gym.Env[Any, Any]:
    """Cuts episodes off as ManiSkill does, after the task's moves or as many as `gymnasium.make` was given."""
    steps = find_task(env_id).max_episode_steps
    if isinstance(env, gym.wrappers.TimeLimit):
        steps, env = env._max_episode_steps, env.env
    limited: gym.Env[Any, Any] = TimeLimitWrapper(env, steps)
    return limited


def _class_of(task: Task) -> type[TomatoEnv]:
    made = _make_class(task.env_id, task.base)
    REGISTERED_ENVS.pop(task.env_id, None)  # It warns of what it knows.
    register(task.env_id, made, max_episode_steps=task.max_episode_steps)
    return made


@cache
def _make_class(env_id: str, base: str) -> type[TomatoEnv]:
    parent = _BASES[base]
    return type(parent.__name__, (parent,), {"env_id": env_id, "__doc__": f"{env_id}, a form of {base}."})
