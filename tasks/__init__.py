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


class _SingleWrappers(tuple[WrapperSpec, ...]):
    """Wrappers that `gymnasium.make` puts on, as it goes through them, and that count as none.

    `gymnasium.make_vec` counts a specification's wrappers and refuses any, because it would not put them on.
    """

    def __len__(self) -> int:
        return 0


def _register(env_id: str, entry_point: str, vector_entry_point: str, max_episode_steps: int) -> None:
    if env_id in registry:
        return
    register(
        id=env_id,
        entry_point=f"maniskill_tomato.tasks.maniskill.registered_envs:{entry_point}",
        vector_entry_point=f"maniskill_tomato.tasks.registered_vectors:{vector_entry_point}",
        max_episode_steps=max_episode_steps,
        disable_env_checker=True,  # ManiSkill batches observations and rewards.
        additional_wrappers=_SingleWrappers(
            [
                WrapperSpec(
                    name="MSTimeLimit",
                    entry_point="mani_skill.utils.registration:TimeLimitWrapper",
                    kwargs={"max_episode_steps": max_episode_steps},
                )
            ]
        ),
    )


for _env_id, _env_class, _vector, _steps in (
    ("TomatoViewpointGuided-v1", "TomatoViewpointGuidedEnv", "make_guided", MAX_EPISODE_STEPS),
    ("TomatoViewpointSparse-v1", "TomatoViewpointSparseEnv", "make_sparse", MAX_EPISODE_STEPS),
    ("TomatoViewpoint-v1", "TomatoViewpointGeneralEnv", "make_general", MAX_GENERAL_STEPS),
    ("TomatoViewpointRow-v1", "TomatoViewpointRowEnv", "make_row", MAX_ROW_STEPS),
):
    _register(_env_id, _env_class, _vector, _steps)
