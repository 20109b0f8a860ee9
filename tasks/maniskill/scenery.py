"""What stands around the robot and the plant, for pictures only: floor, walls and light."""

from typing import Any

import sapien
import sapien.render
from mani_skill.envs.scene import ManiSkillScene

FLOOR_COLOUR = (0.30, 0.31, 0.29, 1.0)
"""Base colour of the ground cover."""

WALL_COLOUR = (0.50, 0.56, 0.58, 1.0)
"""Base colour of the glasshouse walls."""


def build(scene: ManiSkillScene) -> None:
    """Adds the floor at z = 0 and walls around, without collision shapes: nothing in the tasks falls."""
    _add_box(scene, "floor", [0.0, 0.0, -0.01], [5.0, 5.0, 0.01], FLOOR_COLOUR)
    for name, x, y in (("wall_front", 5.0, 0.0), ("wall_left", 0.0, 5.0), ("wall_right", 0.0, -5.0)):
        half_size = [0.01 if x else 5.0, 0.01 if y else 5.0, 4.0]
        _add_box(scene, name, [x, y, 4.0], half_size, WALL_COLOUR)


def _add_box(
    scene: ManiSkillScene, name: str, centre: list[float], half_size: list[float], colour: tuple[float, ...]
) -> None:
    builder: Any = scene.create_actor_builder()
    builder.initial_pose = sapien.Pose(centre)
    if scene.can_render():
        material = sapien.render.RenderMaterial(base_color=list(colour), roughness=0.95, specular=0.1)
        builder.add_box_visual(half_size=half_size, material=material)
    builder.build_static(name=name)


def light(scene: ManiSkillScene, *, shadows: bool) -> None:
    """Adds the diffuse light of a glasshouse and a sun."""
    scene.set_ambient_light([0.42, 0.45, 0.46])
    scene.add_directional_light(
        [0.6, 0.45, -1.0], [1.9, 1.85, 1.7], shadow=shadows, shadow_scale=2.0, shadow_map_size=2048
    )
    scene.add_directional_light([0.5, -0.9, -0.5], [0.6, 0.64, 0.7])
