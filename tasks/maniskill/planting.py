"""The plants of an environment: grown, put into the scene, moved, and asked for fruits and segmentation
ids."""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import sapien
import torch
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils.structs.actor import Actor
from mani_skill.utils.structs.pose import Pose
from torch import Tensor
from torch.nn.functional import pad

from maniskill_tomato.plants.organs import Plant, SemanticClass
from maniskill_tomato.plants.spec import PlantSpec
from maniskill_tomato.rendering.plant_actors import build_plant_actors
from maniskill_tomato.tasks.maniskill import scene_mask

GROWN_PLANTS = 128
"""How many plants are kept, of 1 MB or less each (a row: 3 MB), for environments that show them again."""


@lru_cache(maxsize=GROWN_PLANTS)
def grow(choice: PlantSpec, seed: int) -> Plant:
    """The plant of a choice and seed; the last few are kept, as environments often share them."""
    return choice.grow(seed)


class Planting:
    """One plant for every environment of a scene.

    Where nothing is rendered, plants can do without actors: they are then numbers only, and another one takes an
    environment's place at once (`replace`), while actors are made anew with their scene. The segmentation ids are
    the same either way.
    """

    def __init__(
        self,
        scene: ManiSkillScene,
        choice: PlantSpec,
        seeds: Sequence[int],
        device: torch.device,
        *,
        with_actors: bool = True,
    ) -> None:
        """Grows the plants and adds their organs to the scene as kinematic actors.

        Args:
            scene: The scene, before it is set up; robot and scenery must be in it already.
            choice: Which plants.
            seeds: The seed of each environment's plant; environments with equal seeds share actors' meshes.
            device: Where tensors live.
            with_actors: Whether to add actors.
        """
        self.plants = [grow(choice, seed) for seed in seeds]
        self.seeds = list(seeds)
        self._choice = choice
        self._scene = scene
        self._device = device
        num_envs = len(self.plants)
        self.position_w = torch.zeros(num_envs, 3, device=device)
        """Stem base in the world frame, in [m]. Shape (num_envs, 3)."""
        self.yaw = torch.zeros(num_envs, device=device)
        """Rotation about the vertical, in [rad]. Shape (num_envs,)."""
        self.T_world_plant = torch.eye(4, device=device).repeat(num_envs, 1, 1)
        """Plant frame in the world frame. Shape (num_envs, 4, 4)."""
        max_fruits = max(len(plant.fruits) for plant in self.plants)
        self._fruit_centre_p = torch.zeros(num_envs, max_fruits, 3, device=device)
        self.fruit_segmentation_id = torch.zeros(num_envs, max_fruits, dtype=torch.int32, device=device)
        """Segmentation id of every fruit, by index in `Plant.fruits`. Shape (num_envs, max_fruits), int32."""
        self.ripe_fruits: list[list[int]] = [[] for _ in seeds]
        """Indices of the ripe fruits of each environment's plant."""
        # Entities are numbered in the order in which they come into a scene.
        self._first_id = [1 + max(int(e.per_scene_id) for e in s.entities) for s in scene.sub_scenes]
        self._actors = self._add_actors() if with_actors else []
        for i in range(num_envs):
            self._enter(i)

    def _add_actors(self) -> list[tuple[list[int], list[Actor]]]:
        pose = sapien.Pose()
        everywhere = list(range(len(self.plants)))
        if len(set(self.seeds)) == 1:
            groups = [(everywhere, "plant/")]
        else:
            groups = [([i], f"plant_{i}/") for i in everywhere]
        added = []
        for env_indices, prefix in groups:
            plant = self.plants[env_indices[0]]
            actors = build_plant_actors(
                self._scene, plant, scene_idxs=env_indices, pose=pose, name_prefix=prefix
            )
            for actor in actors:
                # The plant's pose is task state; thirteen numbers for each organ would only repeat it.
                self._scene.remove_from_state_dict_registry(actor)
            added.append((env_indices, actors))
        return added

    def _enter(self, env_index: int) -> None:
        """Fills the tables with an environment's plant."""
        plant, first = self.plants[env_index], self._first_id[env_index]
        missing = len(plant.fruits) - self._fruit_centre_p.shape[1]
        if missing > 0:
            self._fruit_centre_p = pad(self._fruit_centre_p, (0, 0, 0, missing))
            self.fruit_segmentation_id = pad(self.fruit_segmentation_id, (0, missing))
        for j, fruit in enumerate(plant.fruits):
            self._fruit_centre_p[env_index, j] = torch.as_tensor(fruit.centre)
            self.fruit_segmentation_id[env_index, j] = first + fruit.organ_index
        self.ripe_fruits[env_index] = [j for j, f in enumerate(plant.fruits) if f.ripeness == "ripe"]

    def replace(self, env_index: int, seed: int) -> Plant:
        """Gives an environment another plant of the same choice; only without actors.

        Args:
            env_index: Which environment.
            seed: The new plant's seed.

        Returns:
            The new plant.
        """
        self.seeds[env_index] = seed
        self.plants[env_index] = grow(self._choice, seed)
        self._enter(env_index)
        return self.plants[env_index]

    def place(self, env_idx: Tensor, x: Tensor, y: Tensor, yaw: Tensor) -> None:
        """Puts the plants of some environments somewhere else.

        Args:
            env_idx: Which environments. Shape (b,).
            x: Stem base in the world frame, in [m]. Shape (b,).
            y: Likewise. Shape (b,).
            yaw: Rotation about the vertical, in [rad]. Shape (b,).
        """
        position = torch.stack([x, y, torch.zeros_like(x)], dim=-1)
        same = torch.equal(self.position_w[env_idx], position) and torch.equal(self.yaw[env_idx], yaw)
        if same:
            return
        self.position_w[env_idx] = position
        self.yaw[env_idx] = yaw
        c, s = yaw.cos(), yaw.sin()
        T = torch.eye(4, device=self._device).repeat(len(env_idx), 1, 1)
        T[:, 0, 0], T[:, 0, 1], T[:, 1, 0], T[:, 1, 1] = c, -s, s, c
        T[:, :3, 3] = position
        self.T_world_plant[env_idx] = T
        half = 0.5 * self.yaw
        quat_wxyz = torch.stack([half.cos(), 0.0 * half, 0.0 * half, half.sin()], dim=-1)
        with scene_mask.only(self._scene, None):
            for env_indices, actors in self._actors:
                pose = Pose.create_from_pq(self.position_w[env_indices], quat_wxyz[env_indices])
                for actor in actors:
                    actor.set_pose(pose)

    def fruit_position_w(self, fruit: Tensor) -> Tensor:
        """Centre of one fruit per environment in the world frame, in [m].

        Args:
            fruit: Index in `Plant.fruits`. Shape (num_envs,).

        Returns:
            Shape (num_envs, 3).
        """
        rows = torch.arange(len(self.plants), device=self._device)
        centre_p = self._fruit_centre_p[rows, fruit]
        rotation, translation = self.T_world_plant[:, :3, :3], self.T_world_plant[:, :3, 3]
        return (rotation @ centre_p[..., None])[..., 0] + translation

    def semantic_classes(self, env_index: int) -> dict[int, SemanticClass]:
        """The semantic class of every organ of an environment's plant, by segmentation id."""
        first = self._first_id[env_index]
        return {first + k: organ.semantic_class for k, organ in enumerate(self.plants[env_index].organs)}


def ripe_fruit_at_random(planting: Planting, env_index: int, rng: np.random.RandomState) -> int:
    """A ripe fruit of an environment's plant, each with the same probability."""
    ripe = planting.ripe_fruits[env_index]
    return int(ripe[rng.randint(len(ripe))])
