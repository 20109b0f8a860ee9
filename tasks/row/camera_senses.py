"""What simulated cameras measure: frames with a D435's faults through the same pipeline as on the robot."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.sensing.observation import ViewpointObserver
from maniskill_tomato.sensing.sensor_noise import SensorNoise
from maniskill_tomato.sensing.simulated_camera import (
    COARSE_POSITION,
    RENDERED,
    Perception,
    make_camera,
)
from maniskill_tomato.tasks.row.senses import ExactSenses, Senses, Sight, Vantage
from maniskill_tomato.tasks.world import World
from maniskill_tomato.tasks.world_state import NOISE_SEEDS


class CameraSenses:
    """Measures what a camera sees; where the truth is needed only to be told beside it, rays are cast."""

    def __init__(self, world: World, perception: Perception) -> None:
        """Senses in a world.

        Args:
            world: The plants and arms, with a renderer for those in `RENDERED`.
            perception: Which camera and estimator.
        """
        made = make_camera(perception, world.scene, world.intrinsics, self._picture)
        assert made is not None
        self._world = world
        self._camera, self._perception = made
        self._qpos = world.state.qpos

    def begin(self, env_index: int, rng: np.random.RandomState, hidden_below: float) -> None:
        """Draws the seed that the errors of an episode follow from."""
        state = self._world.state
        state.noise_seed[env_index] = int(rng.randint(2**31 - 1)) % NOISE_SEEDS
        state.hidden_below[env_index] = hidden_below

    def begin_targets(self, env_idx: Tensor) -> None:
        """Draws where the targets are believed to be, which are known from afar only."""
        state = self._world.state
        for i in env_idx.tolist():
            # Streams of targets and of views differ in the length of their keys.
            key = (int(state.noise_seed[i]), int(state.targets_begun[i]), 0)
            error = np.random.default_rng(key).normal(0.0, COARSE_POSITION, 3)
            state.position_error[i] = torch.as_tensor(error).to(state.position_error)
            self._begin_target(i, is_first=int(state.targets_begun[i]) == 0)

    def recall_targets(self, env_idx: Tensor) -> None:
        """Begins with the same positions again; the views follow."""
        for i in env_idx.tolist():
            self._begin_target(i, is_first=int(self._world.state.targets_begun[i]) == 1)

    def _begin_target(self, env_index: int, *, is_first: bool) -> None:
        state = self._world.state
        position = self._world.target_position_w[env_index] + state.position_error[env_index]
        hidden_below = float(state.hidden_below[env_index]) if is_first else 0.0
        self._perception.begin(
            env_index,
            position.double().cpu().numpy(),
            hidden_below=hidden_below or None,
        )

    def known_target(self) -> Tensor:
        """Where the targets were measured, or are thought to be. Shape (N, 3)."""
        return self._perception.target_position

    def look(self, vantage: Vantage) -> tuple[Sight, Tensor | None]:
        """Takes and measures frames."""
        world = self._world
        target, T_w_plant = world.state.target, world.planting.T_world_plant
        for i, seed in vantage.seeds(world.state.noise_seed).items():
            self._camera.seed(i, seed)
        self._qpos = vantage.qpos
        frames = self._camera.take(vantage.T_w_camera, target, T_w_plant, vantage.T_w_links, vantage.mask)
        located = self._perception.look(frames)
        seen = world.scene.visibility(vantage.T_w_camera, target, T_w_plant, vantage.T_w_links)
        fraction = self._perception.visible_fraction
        sight = Sight(
            rays=self._perception.rays(),
            visible_fraction=fraction,
            told_fraction=fraction,
            true_fraction=seen.visible_fraction,
            tomato_seen=seen.any_visible,
        )
        return sight, located.nonzero()[:, 0]

    def revise(self, observer: ViewpointObserver, env_idx: Tensor) -> None:
        """Reads the kept measurements again."""
        self._perception.recall(observer, env_idx)

    def _picture(self, env_index: int) -> NDArray[np.uint8]:
        picture = self._world.picture
        if picture is None:
            raise InvalidInputError("this perception needs colours, and the world has no renderer")
        return picture(env_index, self._qpos[env_index])


def make_senses(perception: Perception, world: World, noise: SensorNoise) -> Senses:
    """The senses of a kind of perception; `noise` is for ground truth only."""
    if perception == "ground_truth":
        return ExactSenses(world, noise)
    if perception in RENDERED and world.picture is None:
        raise InvalidInputError(
            f"perception={perception!r} renders colours, which a world without a simulator cannot; use "
            "gymnasium.make, or 'occlusion_model'"
        )
    return CameraSenses(world, perception)
