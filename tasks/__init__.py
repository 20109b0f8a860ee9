"""Gym registration of the tomato tasks.

Importing this module is cheap: every spec names its environment by a string, so ManiSkill, SAPIEN and PyTorch
load only when `gymnasium.make` builds one.
"""

from typing import Literal

from maniskill_tomato.task_registry import GENERAL_IDS as GENERAL_IDS
from maniskill_tomato.task_registry import MAX_EPISODE_STEPS as MAX_EPISODE_STEPS
from maniskill_tomato.task_registry import MAX_GENERAL_STEPS as MAX_GENERAL_STEPS
from maniskill_tomato.task_registry import MAX_ROW_STEPS as MAX_ROW_STEPS
from maniskill_tomato.task_registry import TASK_IDS as TASK_IDS
from maniskill_tomato.task_registry import THESIS_IDS as THESIS_IDS
from maniskill_tomato.tasks.registration import register_known_tasks
from maniskill_tomato.tasks.registration import register_task as register_task

if __name__ != "maniskill_tomato.tasks":
    raise ImportError(
        f"imported as {__name__!r}; import `maniskill_tomato.tasks` instead "
        "(is the repository root on sys.path?)"
    )

Scene = Literal["hidden", "thesis"]
"""Plant, pose and camera of the thesis's tasks: a plant that leaves hide from every start, seen by the D435 as it is;
or the scene in which the thesis's numbers hold, seen by the D435 of its Gazebo."""

register_known_tasks()
