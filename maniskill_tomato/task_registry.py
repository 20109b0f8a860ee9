"""Tasks by ID: the four of this package, and those that others make of them."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.extension_points import ExtensionPoint, is_import_path

MAX_EPISODE_STEPS: Final = 30
"""The thesis's horizon T (Tables 5-1 and 5-2)."""

MAX_GENERAL_STEPS: Final = 20
"""Moves of an episode of the general task."""

MAX_ROW_STEPS: Final = 120
"""Moves of a whole row."""

THESIS_IDS: Final = ("TomatoViewpointGuided-v1", "TomatoViewpointSparse-v1")
"""The thesis's tasks: nine observed numbers, six increments."""

GENERAL_IDS: Final = ("TomatoViewpoint-v1", "TomatoViewpointRow-v1")
"""The tasks on plants never seen before; their policies may decide from a `Belief`."""

TASK_IDS: Final = (*THESIS_IDS, *GENERAL_IDS)
"""The tasks of this package."""


@dataclass(frozen=True, kw_only=True)
class Task:
    """A task under an ID: one of this package's, or what `tasks.register_task` made of one."""

    env_id: str
    """What `gymnasium.make` calls it."""
    base: str
    """The task of this package that it is a form of, one of `TASK_IDS`."""
    max_episode_steps: int
    """Moves after which an episode is cut off."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Fields of the base's configuration, and options of the base, that differ."""
    reward: Callable[..., Any] | None = None
    """Gives the reward of a move in place of the base's; see `tasks.own_rules.RewardFunction`."""
    largest_reward: float = 1.0
    """The largest that `reward` gives for one move."""
    starts: Callable[..., Any] | None = None
    """Draws start poses in place of the base's ranges; see `tasks.own_rules.StartFunction`."""
    success: Callable[..., Any] | None = None
    """Says which episodes are a success in place of the base's threshold; see `tasks.own_rules.SuccessRule`."""


GUIDED: Final = Task(env_id=THESIS_IDS[0], base=THESIS_IDS[0], max_episode_steps=MAX_EPISODE_STEPS)
SPARSE: Final = Task(env_id=THESIS_IDS[1], base=THESIS_IDS[1], max_episode_steps=MAX_EPISODE_STEPS)
GENERAL: Final = Task(env_id=GENERAL_IDS[0], base=GENERAL_IDS[0], max_episode_steps=MAX_GENERAL_STEPS)
ROW: Final = Task(env_id=GENERAL_IDS[1], base=GENERAL_IDS[1], max_episode_steps=MAX_ROW_STEPS)

TASKS: Final = ExtensionPoint(
    "task",
    "maniskill_tomato.tasks",
    {
        task.env_id: f"{__name__}:{name}"
        for name, task in (("GUIDED", GUIDED), ("SPARSE", SPARSE), ("GENERAL", GENERAL), ("ROW", ROW))
    },
)
"""What another package adds is what `tasks.register_task` returned, or a callable that returns it."""

ELSEWHERE: Final = "A task of another package is known where that package is installed."

_registered: dict[str, Task] = {task.env_id: task for task in (GUIDED, SPARSE, GENERAL, ROW)}
_of_path: dict[str, Task] = {}


def check_id(env_id: str) -> None:
    """Accepts the ID of a task of somebody's own.

    Raises:
        InvalidInputError: It is one of this package's.
    """
    if env_id in TASK_IDS:
        raise InvalidInputError(f"{env_id} is a task of this package; give yours another ID")


def keep_task(task: Task) -> None:
    """Makes a task known to this process by its ID.

    Raises:
        InvalidInputError: The ID is one of this package's.
    """
    check_id(task.env_id)
    _registered[task.env_id] = task


def find_task(name: str) -> Task:
    """The task of a name; its package is imported if that has not happened.

    Args:
        name: The ID of a task of this package, of an installed one or of this process, or `package.module:attribute`.
            An ID of this package may also have the form in which Gymnasium imports it, `maniskill_tomato:ID`.

    Raises:
        InvalidInputError: There is no such task, or it cannot be imported.
    """
    name = _plain_id(name)
    if name in _registered:
        return _registered[name]
    if name in _of_path:
        return _of_path[name]
    check_task_name(name)
    made = TASKS.load(name)
    task = made() if callable(made) else made
    if not isinstance(task, Task):
        raise InvalidInputError(
            f"the task {name!r} must be what register_task returned, or a callable that returns it; "
            f"got {type(task).__name__}"
        )
    if is_import_path(name):
        _of_path[name] = task
    elif task.env_id != name:
        raise InvalidInputError(
            f"the entry point {name!r} names the task {task.env_id!r}; give the entry point the name of the ID"
        )
    return task


def _plain_id(name: str) -> str:
    """An ID of this package without the package that Gymnasium imports; other names as they are."""
    plain = name.removeprefix("maniskill_tomato:")
    return plain if plain in TASK_IDS else name


def check_task_name(name: str, what: str = "the task") -> None:
    """Accepts the name of a task, which is not imported.

    Args:
        name: As for `find_task`.
        what: What it is called in the message.

    Raises:
        InvalidInputError: There is no such task.
    """
    if _plain_id(name) in _registered or is_import_path(name):
        return
    known = task_ids()
    if name not in known:
        error = InvalidInputError.choice(what, name, (*known, "package.module:attribute"))
        stop = " " if str(error).endswith("?") else ". "
        raise InvalidInputError(f"{error}{stop}{ELSEWHERE}")


def task_ids() -> tuple[str, ...]:
    """All IDs: this package's, those of installed packages, and those registered in this process."""
    return tuple(dict.fromkeys((*TASKS.names(), *_registered)))


def known_task(name: str) -> Task | None:
    """The task of a name, which may stand in a file; None for a task that is not known here.

    `package.module:attribute` is known once `find_task` was asked for it (`ExtensionPoint.may_load_recorded`).
    """
    if _plain_id(name) not in _registered and not TASKS.may_load_recorded(name):
        return None
    try:
        return find_task(name)
    except InvalidInputError:
        return None


def check_recorded_task(name: str, source: object) -> None:
    """Accepts the task that a file names.

    Args:
        name: The task.
        source: The file or folder, for the message.

    Raises:
        InvalidInputError: There is no such task, or it is a module's that nobody else has named.
    """
    check_task_name(name)
    if known_task(name) is None:
        TASKS.check_recorded(name, source, "name the task in the command where it takes one")
        find_task(name)


def base_of(name: str | None) -> str | None:
    """The task of this package that a task is a form of; None for a task that is not known here, as `known_task`."""
    task = None if name is None else known_task(name)
    return None if task is None else task.base


def lasting_name(name: str) -> str:
    """The name under which a task is found in another process too: its ID where an entry point has it, else `name`.

    Raises:
        InvalidInputError: There is no such task.
    """
    env_id = find_task(name).env_id
    return env_id if env_id in TASKS.names() else name


def is_same_task(name: str, other: str) -> bool:
    """Whether two names are of one task; those that are not known here are of one task if they are equal."""
    if name == other:
        return True
    one, another = known_task(name), known_task(other)
    return one is not None and another is not None and one.env_id == another.env_id
