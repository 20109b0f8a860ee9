"""Gym registration: this package's tasks, those of installed packages by name alone, and `register_task`."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from gymnasium.envs.registration import WrapperSpec, register, registry
from gymnasium.error import Error as GymnasiumError

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.task_registry import TASK_IDS, TASKS, Task, check_id, find_task, keep_task

if TYPE_CHECKING:
    from maniskill_tomato.tasks.own_rules import RewardFunction, StartFunction, SuccessRule

OWN_MAKERS = (
    ("TomatoViewpointGuidedEnv", "make_guided"),
    ("TomatoViewpointSparseEnv", "make_sparse"),
    ("TomatoViewpointGeneralEnv", "make_general"),
    ("TomatoViewpointRowEnv", "make_row"),
)
"""What makes the tasks of `TASK_IDS`, one environment and many at once."""


class _SingleWrappers(tuple[WrapperSpec, ...]):
    """Wrappers that `gymnasium.make` puts on, as it goes through them, and that count as none.

    `gymnasium.make_vec` counts a specification's wrappers and refuses any, because it would not put them on.
    """

    def __len__(self) -> int:
        return 0


def register_task(
    env_id: str,
    base: str,
    *,
    settings: Mapping[str, Any] | None = None,
    reward: "RewardFunction | None" = None,
    largest_reward: float = 1.0,
    starts: "StartFunction | None" = None,
    success: "SuccessRule | None" = None,
    max_episode_steps: int | None = None,
) -> Task:
    """Makes a task of your own out of one of this package's, under an ID of its own.

    `gymnasium.make` and `make_vec` take the ID at once, and every command does where an entry point of the group
    `maniskill_tomato.tasks` has it, or `package.module:attribute` names what this returns.

    Args:
        env_id: The ID, such as `MyTask-v1`. A second call with it replaces the first.
        base: Whose arm, plants, observation and actions it has: one of `TASK_IDS`.
        settings: What differs: fields of `ViewpointTaskConfig` or `GeneralTaskConfig`, and options of the base such as
            `plant` and `perception`. Whoever makes the environment may give other options.
        reward: The reward of a move, in place of the base's.
        largest_reward: The largest that it gives for one move, which `reward_mode="normalized_dense"` divides by.
        starts: Draws start poses, in place of the base's ranges.
        success: What is a success, in place of V_f above `full_visibility`; a row keeps its own.
        max_episode_steps: Moves after which an episode is cut off; the base's if None.

    Raises:
        InvalidInputError: There is no such base, a rule is no function, a number is not allowed, or the ID is
            one of this package's or none that Gymnasium takes.
    """
    if base not in TASK_IDS:
        raise InvalidInputError.choice("base", base, TASK_IDS)
    for name, rule in (("reward", reward), ("starts", starts), ("success", success)):
        if rule is not None and not callable(rule):
            raise InvalidInputError(f"{name} must be a function; got {rule!r}")
    if success is not None and base == TASK_IDS[3]:
        raise InvalidInputError(
            f"a form of {base} has the row's success, all targets seen; leave out success= and set full_visibility"
        )
    steps = find_task(base).max_episode_steps if max_episode_steps is None else max_episode_steps
    if isinstance(steps, bool) or not isinstance(steps, int) or steps < 1:
        raise InvalidInputError(f"max_episode_steps must be an integer of 1 or more; got {steps!r}")
    if not largest_reward > 0.0:
        raise InvalidInputError(f"largest_reward must be above 0; got {largest_reward!r}")
    task = Task(
        env_id=env_id,
        base=base,
        max_episode_steps=steps,
        settings=dict(settings or {}),
        reward=reward,
        largest_reward=largest_reward,
        starts=starts,
        success=success,
    )
    check_id(env_id)
    before = registry.pop(env_id, None)
    try:
        _register_other(env_id, steps)
    except GymnasiumError as error:
        if before is not None:
            registry[env_id] = before
        raise InvalidInputError(f"Gymnasium cannot register {env_id}: {error} Choose another ID") from error
    keep_task(task)
    return task


def register_known_tasks() -> None:
    """Registers the tasks of this package, and by name alone those of others, whose packages are not imported."""
    for env_id, (single, vector) in zip(TASK_IDS, OWN_MAKERS, strict=True):
        if env_id not in registry:
            _register_own(env_id, single, vector)
    for env_id in TASKS.names():
        if env_id not in registry:
            _register_other(env_id, None)


def _register_own(env_id: str, single: str, vector: str) -> None:
    steps = find_task(env_id).max_episode_steps
    limit = WrapperSpec(
        name="MSTimeLimit",
        entry_point="mani_skill.utils.registration:TimeLimitWrapper",
        kwargs={"max_episode_steps": steps},
    )
    register(
        id=env_id,
        entry_point=f"maniskill_tomato.tasks.maniskill.registered_envs:{single}",
        vector_entry_point=f"maniskill_tomato.tasks.registered_vectors:{vector}",
        max_episode_steps=steps,
        disable_env_checker=True,  # ManiSkill batches observations and rewards.
        additional_wrappers=_SingleWrappers([limit]),
    )


def _register_other(env_id: str, max_episode_steps: int | None) -> None:
    limit = WrapperSpec(
        name="MSTimeLimit",
        entry_point="maniskill_tomato.tasks.maniskill.other_tasks:limit_time",
        kwargs={"env_id": env_id},
    )
    register(
        id=env_id,
        entry_point="maniskill_tomato.tasks.maniskill.other_tasks:make_task_env",
        vector_entry_point="maniskill_tomato.tasks.vector_env:make_vector_env",
        max_episode_steps=max_episode_steps,
        disable_env_checker=True,
        kwargs={"env_id": env_id},
        additional_wrappers=_SingleWrappers([limit]),
    )
