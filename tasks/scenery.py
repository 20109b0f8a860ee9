"""What stands around the robot and the plant, for pictures only: floor and light."""

import numpy as np
import sapien
import sapien.render
from mani_skill.envs.scene import ManiSkillScene

FLOOR_COLOUR = (0.62, 0.64, 0.62, 1.0)
"""The pale ground cover of a greenhouse."""


def build(scene: ManiSkillScene) -> None:
    """Adds the floor at z = 0. It has no collision shape: nothing in the tasks falls."""
    builder = scene.create_actor_builder()
    builder.initial_pose = sapien.Pose([0.0, 0.0, -0.01])
    if scene.can_render():
        material = sapien.render.RenderMaterial(
            base_color=np.array(FLOOR_COLOUR), roughness=0.95, specular=0.1
        )
        builder.add_box_visual(half_size=[6.0, 6.0, 0.01], material=material)
    builder.build_static(name="floor")


def light(scene: ManiSkillScene, *, shadows: bool) -> None:
    """Adds the diffuse light of a glasshouse and a sun."""
    scene.set_ambient_light([0.45, 0.47, 0.5])
    scene.add_directional_light(
        [0.6, 0.35, -1.0], [1.7, 1.65, 1.5], shadow=shadows, shadow_scale=2.0, shadow_map_size=2048
    )
    scene.add_directional_light([0.5, -0.7, -0.6], [0.5, 0.52, 0.6])
