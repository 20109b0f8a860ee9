"""Where the plants of the thesis's tasks stand; free of anything that is slow to import."""

import math
from typing import get_args

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.plants.spec import PlantPose
from maniskill_tomato.tasks import THESIS_IDS, Scene

THESIS_POSE = PlantPose(x=0.85, y=0.0, yaw=math.radians(120.0))
"""Where the plants of the scene `thesis` stand. Episodes of the guided task's random actions (Eq. 5-6) take 5.2 steps
there, the thesis's 5.3 (1278 in 240 episodes); `tools/choose_thesis_scene.py` chose it."""

HIDDEN_POSES: dict[str, PlantPose] = dict(
    zip(THESIS_IDS, (PlantPose(x=0.85, y=0.2), PlantPose(x=0.85, y=0.0)), strict=True)
)
"""Where those of the scene `hidden` stand, by task."""


def plant_pose(env_id: str, scene: Scene) -> PlantPose:
    """Where the plant of a task stands in a scene.

    Args:
        env_id: One of `THESIS_IDS`.
        scene: Which.

    Raises:
        InvalidInputError: There is no such scene.
    """
    if scene not in get_args(Scene):
        raise InvalidInputError.choice("scene", scene, get_args(Scene))
    return THESIS_POSE if scene == "thesis" else HIDDEN_POSES[env_id]
