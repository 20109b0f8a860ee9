"""Gym registration of the tomato tasks.

Importing this module is cheap: every spec names its environment by a string, so ManiSkill, SAPIEN and PyTorch
load only when `gymnasium.make` builds one.
"""

from typing import Literal

from gymnasium.envs.registration import WrapperSpec, register, registry

from maniskill_tomato.policies.layout import GENERAL_IDS as GENERAL_IDS

if __name__ != "maniskill_tomato.tasks":
    raise ImportError(
        f"imported as {__name__!r}; import `maniskill_tomato.tasks` instead "
        "(is the repository root on sys.path?)"
    )

MAX_EPISODE_STEPS = 30
"""The thesis's horizon T (Tables 5-1 and 5-2)."""

MAX_GENERAL_STEPS = 20
"""Moves of an episode of the general task."""

MAX_ROW_STEPS = 120
"""Moves of a whole row."""

THESIS_IDS = ("TomatoViewpointGuided-v1", "TomatoViewpointSparse-v1")
"""The thesis's tasks: nine observed numbers, six increments."""

TASK_IDS = (*THESIS_IDS, *GENERAL_IDS)

Scene = Literal["hidden", "thesis"]
"""Plant, pose and camera of the thesis's tasks: a plant that leaves hide from every start, seen by the D435 as it is;
or the scene in which the thesis's numbers hold, seen by the D435 of its Gazebo."""


def _register(env_id: str, entry_point: str, max_episode_steps: int) -> None:
    if env_id in registry:
        return
    register(
        id=env_id,
        entry_point=entry_point,
        max_episode_steps=max_episode_steps,
        disable_env_checker=True,  # ManiSkill batches observations and rewards.
        additional_wrappers=(
            WrapperSpec(
                name="MSTimeLimit",
                entry_point="mani_skill.utils.registration:TimeLimitWrapper",
                kwargs={"max_episode_steps": max_episode_steps},
            ),
        ),
    )


for _env_id, _env_class, _steps in (
    ("TomatoViewpointGuided-v1", "TomatoViewpointGuidedEnv", MAX_EPISODE_STEPS),
    ("TomatoViewpointSparse-v1", "TomatoViewpointSparseEnv", MAX_EPISODE_STEPS),
    ("TomatoViewpoint-v1", "TomatoViewpointGeneralEnv", MAX_GENERAL_STEPS),
    ("TomatoViewpointRow-v1", "TomatoViewpointRowEnv", MAX_ROW_STEPS),
):
    _register(_env_id, f"maniskill_tomato.tasks.maniskill.registered_envs:{_env_class}", _steps)
