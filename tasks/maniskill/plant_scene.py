"""The plants of a world as actors of a ManiSkill scene, for pictures."""

import sapien
import torch
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils.structs.actor import Actor
from mani_skill.utils.structs.pose import Pose

from maniskill_tomato.plants.organs import SemanticClass
from maniskill_tomato.rendering.plant_actors import build_plant_actors
from maniskill_tomato.tasks.maniskill import scene_mask
from maniskill_tomato.tasks.planting import Planting


class PlantScene:
    """One kinematic actor for every organ of the plants, where pictures are made; the numbers of both otherwise.

    Without actors another plant takes an environment's place at once. The segmentation ids are the same either way.
    """

    def __init__(self, scene: ManiSkillScene, planting: Planting, *, with_actors: bool) -> None:
        """Adds the organs of the plants that are shown to the scene.

        Args:
            scene: The scene, before it is set up; robot and scenery must be in it already.
            planting: The world's plants; environments with equal seeds share actors' meshes.
            with_actors: Whether to add actors.
        """
        self._scene = scene
        self._planting = planting
        # Entities are numbered in the order in which they come into a scene.
        self.first_organ_id = [1 + max(int(e.per_scene_id) for e in s.entities) for s in scene.sub_scenes]
        """Segmentation id of each environment's first organ."""
        self._shown = torch.full_like(planting.T_world_plant[:, 0, 0], torch.nan)[:, None].repeat(1, 3)
        self._actors = self._add_actors() if with_actors else []

    def _add_actors(self) -> list[tuple[list[int], list[Actor]]]:
        pose = sapien.Pose()
        everywhere = list(range(len(self._planting.plants)))
        groups = [([i], f"plant_{i}/") for i in everywhere]
        if len(set(self._planting.seeds)) == 1:
            groups = [(everywhere, "plant/")]
        added = []
        for env_indices, prefix in groups:
            plant = self._planting.plants[env_indices[0]]
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
        position_w, yaw = self._planting.position_w, self._planting.yaw
        pose = torch.cat([position_w[:, :2], yaw[:, None]], dim=-1)
        if not self._actors or torch.equal(pose, self._shown):
            return
        self._shown = pose.clone()
        half = 0.5 * yaw
        zero = torch.zeros_like(half)
        quat_wxyz = torch.stack([half.cos(), zero, zero, half.sin()], dim=-1)
        with scene_mask.only(self._scene, None):
            for env_indices, actors in self._actors:
                placed = Pose.create_from_pq(position_w[env_indices], quat_wxyz[env_indices])
                for actor in actors:
                    actor.set_pose(placed)

    def semantic_classes(self, env_index: int) -> dict[int, SemanticClass]:
        """The semantic class of every organ of an environment's plant, by segmentation id."""
        first = self.first_organ_id[env_index]
        organs = self._planting.plants[env_index].organs
        return {first + k: organ.semantic_class for k, organ in enumerate(organs)}
