"""The planners in a small world: real plants, a camera that flies freely in a box in front of them, no robot."""

import math
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from maniskill_tomato.evaluation.view_episode import ViewEpisode
from maniskill_tomato.evaluation.view_rollout import run_view_episode
from maniskill_tomato.planners import moves
from maniskill_tomato.planners.base import Planner
from maniskill_tomato.plants.generator import generate_plant
from maniskill_tomato.plants.organs import Plant
from maniskill_tomato.robot.d435 import color_intrinsics
from maniskill_tomato.robot.look_at import camera_to_viewpoint, look_at_pose, look_frame
from maniskill_tomato.visibility.cast_views import CastViews
from maniskill_tomato.visibility.caster import VisibilityCaster
from maniskill_tomato.visibility.observation import ObservationLayout, ViewpointObserver
from maniskill_tomato.visibility.situation import Situation
from maniskill_tomato.visibility.view_rays import ViewRayCaster

HORIZON = 20
GOOD = 0.8
SEEDS = (3, 5, 8, 13)
"""Plants of the world."""


@dataclass(frozen=True)
class Box:
    """Where the camera may fly, in [m]."""

    low: tuple[float, float, float] = (-0.1, -0.6, 0.3)
    high: tuple[float, float, float] = (0.55, 0.6, 1.5)

    def holds(self, positions: Tensor, target: Tensor | None = None) -> Tensor:
        low, high = positions.new_tensor(self.low), positions.new_tensor(self.high)
        return ((positions >= low) & (positions <= high)).all(dim=-1)


class FreeWorld:
    """A camera flies within a box before plants and sees a tomato; episodes as the general task has them."""

    num_envs = 1
    device = torch.device("cpu")

    def __init__(self, plants: list[Plant], box: Box = Box()) -> None:
        self._plants = plants
        self._box = box
        self._caster = VisibilityCaster(plants=plants[:1], intrinsics=color_intrinsics())
        self._rays = ViewRayCaster(self._caster)
        self._views = CastViews(self._caster)
        self._observer = ViewpointObserver(1, layout=ObservationLayout.without_memory(), max_moves=HORIZON)
        self._T_world_plant = torch.eye(4)
        self._T_world_plant[0, 3] = 0.85
        self.agent = SimpleNamespace(robot=SimpleNamespace(get_qpos=lambda: torch.zeros(1, 7)))
        self.ground_truth = self

    @property
    def unwrapped(self) -> "FreeWorld":
        return self

    @property
    def situation(self) -> Situation:
        situation = self._observer.situation
        candidates = situation.lattice.positions(situation.target_position)
        values = {**vars(situation), "reachable": self._box.holds(candidates)}
        return Situation(**values)

    def visible_fraction(self, T_world_camera: Tensor, env_index: int) -> Tensor:
        return self._views.visible_fraction(
            T_world_camera, self._fruit, self._T_world_plant, env_index=env_index
        )

    def reset(self, *, seed: int, options: Any = None) -> tuple[Tensor, dict[str, Tensor]]:
        rng = np.random.default_rng(seed)
        plant = self._plants[int(rng.integers(len(self._plants)))]
        self._caster.replace_plant(0, plant)
        ripe = [i for i, f in enumerate(plant.fruits) if f.ripeness == "ripe" and 0.4 < f.centre[2] < 1.2]
        while True:
            self._fruit = int(rng.choice(ripe))
            self._target = torch.from_numpy(plant.fruits[self._fruit].centre) + self._T_world_plant[:3, 3]
            position = torch.from_numpy(rng.uniform((0.0, -0.4, 0.5), (0.35, 0.4, 1.2))).float()
            pose = look_at_pose(position, self._target)[None]
            if float(self.visible_fraction(pose, 0)) < 0.3:
                break
        self._position, self._elapsed, self._held = position, 0, False
        self._observer.begin(torch.zeros(1, dtype=torch.int64), self._target[None])
        return self._look()

    def step(self, action: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Tensor]]:
        shift = moves.MAX_MOVE * action[0] / max(float(action[0].norm()), 1.0)
        away = self._position + look_frame(self._position, self._target) @ shift - self._target
        goal = self._target + away * max(1.0, moves.MIN_DISTANCE / float(away.norm()))
        self._held = not bool(self._box.holds(goal))
        self._position = self._position if self._held else goal
        self._elapsed += 1
        observation, info = self._look()
        truncated = torch.tensor([self._elapsed >= HORIZON])
        return observation, info["visible_fraction"], info["success"], truncated, info

    def _look(self) -> tuple[Tensor, dict[str, Tensor]]:
        pose = look_at_pose(self._position, self._target)[None]
        fruit, plant = torch.tensor([self._fruit]), self._T_world_plant[None]
        seen = self._caster.cast(pose, fruit, plant).visible_fraction
        rays = self._rays.cast(pose, fruit, self._target[None], plant)
        viewpoint = camera_to_viewpoint(pose, torch.tensor([[0.0, math.pi / 2, 0.0]]))
        left = torch.tensor([HORIZON - self._elapsed])
        observation = self._observer.observe(viewpoint, pose, rays, seen, left)
        info = {
            "visible_fraction": seen,
            "success": seen > GOOD,
            "reachability": torch.tensor([2 if self._held else 0]),
        }
        return observation, info


@pytest.fixture(scope="module")
def world() -> FreeWorld:
    return FreeWorld([generate_plant("full", seed) for seed in SEEDS])


def anywhere(positions: Tensor, target: Tensor) -> Tensor:
    return Box().holds(positions)


def run(world: FreeWorld, planner: Planner, episodes: range) -> list[ViewEpisode]:
    world_as_env: Any = world
    return [run_view_episode(world_as_env, planner, i) for i in episodes]
