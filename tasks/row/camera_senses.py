"""What simulated cameras measure: frames with a D435's faults through the same pipeline as on the robot."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.sensing.observation import ViewpointObserver
from maniskill_tomato.sensing.posed_frame import PosedFrame
from maniskill_tomato.sensing.sensor_noise import SensorNoise
from maniskill_tomato.sensing.simulated_camera import RENDERED, Perception, make_camera
from maniskill_tomato.tasks.row.row_config import CameraConfig
from maniskill_tomato.tasks.row.senses import ExactSenses, Senses, Sight, Vantage
from maniskill_tomato.tasks.world import World
from maniskill_tomato.tasks.world_state import NOISE_SEEDS

NO_FRUIT = -1
"""Stands for a fruit where there is none."""


class CameraSenses:
    """Measures what a camera sees; where the truth is needed only to be told beside it, rays are cast."""

    def __init__(
        self, world: World, perception: Perception, config: CameraConfig, full_visibility: float
    ) -> None:
        """Senses in a world.

        Args:
            world: The plants and arms, with a renderer for those in `RENDERED`.
            perception: Which camera and estimator.
            config: How targets are named.
            full_visibility: V_f above which a fruit is fully visible.
        """
        made = make_camera(
            perception,
            world.scene,
            world.intrinsics,
            self._picture,
            true_association=config.association == "truth",
        )
        assert made is not None
        self._world = world
        self._config = config
        self._full_visibility = full_visibility
        self._camera, self._perception = made
        self._qpos = world.state.qpos

    def begin(self, env_index: int, rng: np.random.RandomState, hidden_below: float) -> None:
        """Draws the seed that the errors of an episode follow from."""
        state = self._world.state
        state.noise_seed[env_index] = int(rng.randint(2**31 - 1)) % NOISE_SEEDS
        state.hidden_below[env_index] = hidden_below

    def begin_targets(self, env_idx: Tensor) -> None:
        """Draws where the targets are said to be, if that is how they are named."""
        state = self._world.state
        for i in env_idx.tolist():
            # Streams of targets and of views differ in the length of their keys.
            key = (int(state.noise_seed[i]), int(state.targets_begun[i]), 0)
            error = np.random.default_rng(key).normal(0.0, self._config.map_noise, 3)
            state.position_error[i] = torch.as_tensor(error).to(state.position_error)
            self._begin_target(i, is_first=int(state.targets_begun[i]) == 0)

    def recall_targets(self, env_idx: Tensor) -> None:
        """Begins with the same positions again; the views follow."""
        for i in env_idx.tolist():
            self._begin_target(i, is_first=int(self._world.state.targets_begun[i]) == 1)

    def _begin_target(self, env_index: int, *, is_first: bool) -> None:
        state, config = self._world.state, self._config
        place = None
        hidden_below = float(state.hidden_below[env_index]) if is_first else 0.0
        if config.target == "map":
            error = state.position_error[env_index]
            place = (self._world.target_position_w[env_index] + error).double().cpu().numpy()
        self._perception.begin(
            env_index,
            place,
            place_error=config.map_noise,
            hidden_below=hidden_below or None,
            chooses=config.target == "any",
            threshold=self._full_visibility,
        )

    def known_target(self) -> Tensor:
        """Where the targets were measured, or are thought to be. Shape (N, 3)."""
        return self._perception.target_position

    def look(self, vantage: Vantage) -> tuple[Sight, Tensor | None]:
        """Takes and measures frames."""
        world = self._world
        T_w_plant = world.planting.T_world_plant
        for i, seed in vantage.seeds(world.state.noise_seed).items():
            self._camera.seed(i, seed)
        self._qpos = vantage.qpos
        frames = self._camera.take(vantage.T_w_camera, T_w_plant, vantage.T_w_links, vantage.mask)
        moved = self._perception.look(frames)
        chosen = torch.full((world.num_envs,), NO_FRUIT, device=world.device)
        for i, frame in enumerate(frames):
            if frame is None:
                continue
            if self._config.target != "map" and not bool(self._perception.is_located[i]):
                moved[i] |= self._name(i, frame)
            chosen[i] = self._shown_fruit(i)
            if self._config.target == "any" and int(chosen[i]) != NO_FRUIT and bool(moved[i]):
                self._judge_by(i, int(chosen[i]))
        target = world.state.target
        seen = world.scene.visibility(vantage.T_w_camera, target, T_w_plant, vantage.T_w_links)
        at = torch.where(chosen == NO_FRUIT, target, chosen)
        of_chosen = seen
        if not torch.equal(at, target):
            of_chosen = world.scene.visibility(vantage.T_w_camera, at, T_w_plant, vantage.T_w_links)
        sight = Sight(
            rays=self._perception.rays(),
            visible_fraction=self._perception.sure_fraction,
            told_fraction=self._perception.visible_fraction,
            true_fraction=seen.visible_fraction,
            tomato_seen=seen.any_visible,
            chosen_fraction=torch.where(chosen == NO_FRUIT, 0.0, of_chosen.visible_fraction),
            chosen_fruit=chosen,
            named=self._perception.is_located,
        )
        return sight, moved.nonzero()[:, 0]

    def _name(self, env_index: int, frame: PosedFrame) -> bool:
        """Names the track that holds most of the target's pixels, if one does; whether it stands elsewhere.

        A detection of which less than half shows the target holds it by accident and is not named, nor is one without a
        depth of its own, which says too little of where it is.
        """
        view = self._perception.last_view(env_index)
        target = int(self._world.state.target[env_index])
        if self._config.target != "track" or view is None or target not in frame.true_numbers:
            return False
        assert frame.true_fruits is not None
        true = frame.true_fruits.masks[frame.true_numbers.index(target)]
        held = {}
        for k, number in enumerate(view.tracks):
            mask = view.measurement.mask(k)
            is_measured = view.measurement.fruits[k].is_depth_measured
            if is_measured and frame.shown_fruit(mask) == target:
                held[number] = int(np.count_nonzero(mask & true))
        if not held:
            return False
        return self._perception.name(env_index, max(held, key=lambda number: held[number]))

    def _shown_fruit(self, env_index: int) -> int:
        """The fruit that the target's detection in the last view shows."""
        view, index = self._perception.last_view(env_index), self._perception.target_fruit(env_index)
        if view is None or index is None:
            return NO_FRUIT
        shown = view.measurement.frame.shown_fruit(view.measurement.mask(index))
        return NO_FRUIT if shown is None else shown

    def _judge_by(self, env_index: int, fruit: int) -> None:
        """Makes a fruit that the robot has chosen the one that its episode is judged by, if it is ripe."""
        if fruit in self._world.planting.ripe_fruits[env_index]:
            self._world.set_target(torch.tensor([env_index], device=self._world.device), [fruit])

    def revise(self, observer: ViewpointObserver, env_idx: Tensor) -> None:
        """Reads the kept measurements again."""
        self._perception.recall(observer, env_idx)

    def _picture(self, env_index: int) -> NDArray[np.uint8]:
        picture = self._world.picture
        if picture is None:
            raise InvalidInputError("this perception needs colours, and the world has no renderer")
        return picture(env_index, self._qpos[env_index])


def make_senses(
    perception: Perception,
    world: World,
    noise: SensorNoise,
    camera: CameraConfig,
    full_visibility: float,
) -> Senses:
    """The senses of a kind of perception; `noise` is for ground truth only, `camera` for the others."""
    if perception == "ground_truth":
        return ExactSenses(world, noise)
    if perception in RENDERED and world.picture is None:
        raise InvalidInputError(
            f"perception={perception!r} renders colours, which a world without a simulator cannot; use "
            "gymnasium.make, or 'occlusion_model'"
        )
    return CameraSenses(world, perception, camera, full_visibility)
