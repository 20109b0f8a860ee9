"""What stands in a ManiSkill scene beside the robot: floor, walls and light for pictures, and the plants of a world."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import sapien
import sapien.render
import torch
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils.structs.actor import Actor
from mani_skill.utils.structs.pose import Pose
from torch import Tensor

from maniskill_tomato.plants.organs import SemanticClass
from maniskill_tomato.rendering import glasshouse
from maniskill_tomato.rendering.plant_actors import build_plant_actors
from maniskill_tomato.tasks.plant_batch import PlantBatch

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
    """Adds the diffuse light of a bare room and a sun."""
    scene.set_ambient_light([0.42, 0.45, 0.46])
    scene.add_directional_light(
        [0.6, 0.45, -1.0], [1.9, 1.85, 1.7], shadow=shadows, shadow_scale=2.0, shadow_map_size=2048
    )
    scene.add_directional_light([0.5, -0.9, -0.5], [0.6, 0.64, 0.7])


@contextmanager
def writing_only_to(scene: ManiSkillScene, env_idx: Tensor | None) -> Iterator[None]:
    """Within it, setters of actors and articulations write to these environments alone.

    Args:
        scene: The scene.
        env_idx: Indices of environments, None for all. Shape (b,).
    """
    before = scene._reset_mask
    mask = torch.ones_like(before)
    if env_idx is not None:
        mask = torch.zeros_like(before)
        mask[env_idx] = True
    scene._reset_mask = mask
    try:
        yield
    finally:
        scene._reset_mask = before


class GlasshouseScene:
    """The glasshouse round one environment's plants."""

    def __init__(self, scene: ManiSkillScene, plant_batch: PlantBatch) -> None:
        """Builds it; the plants must be in the scene already, so that their segmentation ids stay what they are.

        Args:
            scene: A scene of one environment that renders.
            plant_batch: The plants.
        """
        self._scene = scene.sub_scenes[0]
        self._house = glasshouse.Glasshouse(self._scene)
        self._plant_batch = plant_batch
        self._feet = glasshouse.stem_feet(plant_batch.plants[0])

    def light(self) -> None:
        """Lights the scene as on a bright day."""
        glasshouse.light(self._scene)

    def follow(self) -> None:
        """Moves it to where the plants stand."""
        T = self._plant_batch.T_world_plant[0].double().cpu().numpy()
        feet_w = self._feet @ T[:3, :3].T + T[:3, 3]
        self._house.place(float(feet_w[:, 0].mean()), feet_w)


class PlantScene:
    """One kinematic actor for every organ of the plants, where pictures are made; the numbers of both otherwise.

    Without actors another plant takes an environment's place at once. The segmentation ids are the same either way.
    Leaves and stems as one actor each were tried: the scene of a row was built in 19 ms instead of 24, a step and a
    picture took as long as before, and leaves lost their ids.
    """

    def __init__(self, scene: ManiSkillScene, plant_batch: PlantBatch, *, with_actors: bool) -> None:
        """Adds the organs of the plants that are shown to the scene.

        Args:
            scene: The scene, before it is set up; robot and scenery must be in it already.
            plant_batch: The world's plants; environments with equal seeds share actors' meshes.
            with_actors: Whether to add actors.
        """
        self._scene = scene
        self._plant_batch = plant_batch
        # Entities are numbered in the order in which they come into a scene.
        self.first_organ_id = [1 + max(int(e.per_scene_id) for e in s.entities) for s in scene.sub_scenes]
        """Segmentation id of each environment's first organ."""
        self._shown = torch.full_like(plant_batch.T_world_plant[:, 0, 0], torch.nan)[:, None].repeat(1, 3)
        self._actors = self._add_actors() if with_actors else []

    def _add_actors(self) -> list[tuple[list[int], list[Actor]]]:
        pose = sapien.Pose()
        everywhere = list(range(len(self._plant_batch.plants)))
        groups = [([i], f"plant_{i}/") for i in everywhere]
        if len(set(self._plant_batch.seeds)) == 1:
            groups = [(everywhere, "plant/")]
        added = []
        for env_indices, prefix in groups:
            plant = self._plant_batch.plants[env_indices[0]]
            actors = build_plant_actors(
                self._scene, plant, scene_idxs=env_indices, pose=pose, name_prefix=prefix
            )
            for actor in actors:
                # The plant's pose is task state; thirteen numbers for each organ would only repeat it.
                self._scene.remove_from_state_dict_registry(actor)
            added.append((env_indices, actors))
        return added

    def follow(self) -> None:
        """Moves the actors to where the plants stand."""
        position_w, yaw = self._plant_batch.position_w, self._plant_batch.yaw
        pose = torch.cat([position_w[:, :2], yaw[:, None]], dim=-1)
        if not self._actors or torch.equal(pose, self._shown):
            return
        self._shown = pose.clone()
        half = 0.5 * yaw
        zero = torch.zeros_like(half)
        quat_wxyz = torch.stack([half.cos(), zero, zero, half.sin()], dim=-1)
        with writing_only_to(self._scene, None):
            for env_indices, actors in self._actors:
                placed = Pose.create_from_pq(position_w[env_indices], quat_wxyz[env_indices])
                for actor in actors:
                    actor.set_pose(placed)

    def semantic_classes(self, env_index: int) -> dict[int, SemanticClass]:
        """The semantic class of every organ of an environment's plant, by segmentation id."""
        first = self.first_organ_id[env_index]
        organs = self._plant_batch.plants[env_index].organs
        return {first + k: organ.semantic_class for k, organ in enumerate(organs)}
