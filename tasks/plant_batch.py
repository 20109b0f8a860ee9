"""The plants of N environments: grown, shown, placed, and asked for their fruits."""

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from maniskill_tomato.plants.growers import PlantGrowers, grow
from maniskill_tomato.plants.organs import Plant
from maniskill_tomato.plants.spec import PlantSpec
from maniskill_tomato.tasks.world_state import WorldState


class PlantBatch:
    """One plant for every environment; its seed and pose are columns of the world's state."""

    def __init__(self, spec: PlantSpec, state: WorldState) -> None:
        """Shows the same plant everywhere: that of the spec's seed, or the first of its split.

        Args:
            spec: Which plants.
            state: Of the world; its plants' seeds and poses are written here alone.
        """
        self.spec = spec
        self._state = state
        n, device = len(state.plant_seed), state.plant_pose.device
        self._device = device
        self._every = torch.arange(n, device=device)
        self.T_world_plant = torch.eye(4, device=device).repeat(n, 1, 1)
        """Plant frames in the world frame. Shape (N, 4, 4)."""
        self.plants: list[Plant] = []
        """The plant of each environment."""
        self.ripe_fruits: list[list[int]] = []
        """Indices of the ripe fruits of each environment's plant."""
        self.growers: PlantGrowers | None = None
        """Who grows plants ahead, if anybody does."""
        self._fruit_centre_p = torch.zeros(n, 1, 3, device=device)
        self._fruit_organ = torch.zeros(n, 1, dtype=torch.int64, device=device)
        seed = spec.first_seed
        self.plants, self.ripe_fruits = [grow(spec, seed)] * n, [[]] * n
        self.show(dict.fromkeys(range(n), seed))

    @property
    def seeds(self) -> list[int]:
        """The seed of each environment's plant."""
        return [int(seed) for seed in self._state.plant_seed.tolist()]

    @property
    def position_w(self) -> Tensor:
        """Stem base in the world frame, in [m]. Shape (N, 3)."""
        return pad(self._state.plant_pose[:, :2], (0, 1))

    @property
    def yaw(self) -> Tensor:
        """Rotation about the vertical, in [rad]. Shape (N,)."""
        return self._state.plant_pose[:, 2]

    def show(self, seeds: Mapping[int, int]) -> dict[int, Plant]:
        """Gives environments the plants of seeds, by the environment's index, and returns the plants."""
        if self.growers is None:
            shown = {env_index: grow(self.spec, seed) for env_index, seed in seeds.items()}
        else:
            shown = self.growers.plants(seeds)
        self.put(shown)
        rows = torch.tensor(list(shown), dtype=torch.int64, device=self._device)
        self._state.plant_seed[rows] = torch.tensor(list(seeds.values()), device=self._device)
        return shown

    def put(self, shown: Mapping[int, Plant]) -> None:
        """Gives environments plants that are not those of their seeds, by the environment's index."""
        fruits = max((len(plant.fruits) for plant in shown.values()), default=0)
        missing = max(fruits - self._fruit_centre_p.shape[1], 0)
        self._fruit_centre_p = pad(self._fruit_centre_p, (0, 0, 0, missing))
        self._fruit_organ = pad(self._fruit_organ, (0, missing))
        centres = np.zeros((len(shown), self._fruit_centre_p.shape[1], 3), np.float32)
        organs = np.zeros(centres.shape[:2], np.int64)
        for k, (env_index, plant) in enumerate(shown.items()):
            self.plants[env_index] = plant
            self.ripe_fruits[env_index] = [j for j, f in enumerate(plant.fruits) if f.ripeness == "ripe"]
            for j, fruit in enumerate(plant.fruits):
                centres[k, j], organs[k, j] = fruit.centre, fruit.organ_index
        rows = torch.tensor(list(shown), dtype=torch.int64, device=self._device)
        self._fruit_centre_p[rows] = torch.as_tensor(centres, device=self._device)
        self._fruit_organ[rows] = torch.as_tensor(organs, device=self._device)

    def place(self, env_idx: Tensor, pose: Tensor) -> None:
        """Puts the plants of some environments somewhere else.

        Args:
            env_idx: Which environments. Shape (b,).
            pose: Stem's x, y [m] and yaw [rad], world frame. Shape (b, 3).
        """
        self._state.plant_pose[env_idx] = pose
        c, s = pose[:, 2].cos(), pose[:, 2].sin()
        T = torch.eye(4, device=self._device).repeat(len(pose), 1, 1)
        T[:, 0, 0], T[:, 0, 1], T[:, 1, 0], T[:, 1, 1] = c, -s, s, c
        T[:, :2, 3] = pose[:, :2]
        self.T_world_plant[env_idx] = T

    def fruit_position_w(self, fruit: Tensor) -> Tensor:
        """Centre of one fruit per environment in the world frame, in [m].

        Args:
            fruit: Index in `Plant.fruits`. Shape (N,).

        Returns:
            Shape (N, 3).
        """
        centre_p = self._fruit_centre_p[self._every, fruit]
        rotation, translation = self.T_world_plant[:, :3, :3], self.T_world_plant[:, :3, 3]
        return (rotation @ centre_p[..., None])[..., 0] + translation

    def fruit_positions_w(self, env_index: int, fruits: list[int]) -> Tensor:
        """Centres of several fruits of one environment in the world frame, in [m]. Shape (len(fruits), 3)."""
        T = self.T_world_plant[env_index]
        centres = self._fruit_centre_p[
            env_index, torch.tensor(fruits, dtype=torch.int64, device=self._device)
        ]
        return centres @ T[:3, :3].T + T[:3, 3]

    def fruit_organ(self, fruit: Tensor) -> Tensor:
        """Index in `Plant.organs` of one fruit per environment. Shape (N,) to (N,)."""
        return self._fruit_organ[self._every, fruit]
