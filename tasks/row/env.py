"""The general viewpoint task: a tomato on a plant never seen before, hidden at the start, and a memory to look with."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, get_args

import numpy as np
import torch
from mani_skill.utils.registration import register
from numpy.typing import NDArray
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.plants.episode_list import Episode
from maniskill_tomato.plants.row import Row, leaf_density_of
from maniskill_tomato.plants.spec import PlantSpec
from maniskill_tomato.raycast.visibility import Visibility
from maniskill_tomato.robot.kinematics import link_transforms
from maniskill_tomato.robot.look_at import camera_to_viewpoint
from maniskill_tomato.sensing.belief import Belief
from maniskill_tomato.sensing.observation import ObservationLayout, ViewpointObserver
from maniskill_tomato.sensing.sensor_noise import SensorErrors, SensorNoise
from maniskill_tomato.sensing.simulated_camera import RENDERED, RENDERED_SIZE, Perception, make_camera
from maniskill_tomato.sensing.true_views import TrueViews
from maniskill_tomato.tasks import MAX_GENERAL_STEPS, options
from maniskill_tomato.tasks.maniskill.tomato_env import TomatoEnv
from maniskill_tomato.tasks.row.config import GeneralTaskConfig
from maniskill_tomato.tasks.row.episode_selection import EpisodeChoice
from maniskill_tomato.tasks.row.ground_truth import GroundTruth
from maniskill_tomato.tasks.row.hidden_starts import HardStarts, Start
from maniskill_tomato.tasks.row.rewards import view_gain_reward

MAX_VIEWS = 64
"""Views of a target that are remembered; as many as the memory counts."""

MAX_PLANT_DRAWS = 1000
"""Plants drawn under a limit of leaf density before there is held to be none."""

START_RPY = (0.0, torch.pi / 2, 0.0)
"""The angles that those of a first view are near to, in [rad]: along +x, upright."""


class TomatoViewpointGeneralEnv(TomatoEnv):
    """**Task Description:**
    A ripe tomato of a plant between its neighbours in the row is hidden from the first view. Move the camera to where
    it is fully visible, in 20 moves or fewer.

    **Randomizations:**
    - A new plant at every reset out of a split of seeds, its leaf density, its neighbours and its pose.
    - The target is a ripe fruit of the middle plant.
    - The camera starts uniformly in a box before the plant and looks at the target, redrawn until the arm reaches the
      pose, touches nothing, and V_f is below 0.3.

    **Success Conditions:**
    - V_f of the target is above 0.8.

    **Options** beside those of the thesis's tasks:

    - `episodes`: `"validation"`, `"held_out"`, a `.json` file of such a list, or `Episode` objects, takes the episodes
      of a fixed list, `reset(seed=i)` its i-th (modulo its length).
    - `layout`: an `ObservationLayout`, or the parts' names, says what the observation holds.
    - `start_visibility`: range of V_f of the first view.
    - `contact_penalty`: what a move with plant contact costs.
    - `sensor_noise`: a `SensorNoise` or a mapping of its fields, what camera and segmenter get wrong. A saved state
      keeps no errors: taken back, the views are measured anew.
    - `perception`: `"ground_truth"`, or a `Perception` with which V_f, success, reward, the target's position and the
      rays' labels come from a camera image with noisy depth; the info then also has `true_visible_fraction` and
      `true_success`. Those in `simulated_camera.RENDERED` need a renderer, and `segmenter` the extra `perception`.
    - `privileged`: whether the observation ends with the truth about the views around (`sensing.true_views`), for
      critics; `belief` never has it.

    `reset(options=...)` takes `episode` (index in the list), `target` (index of a ripe fruit in `Plant.fruits`) and
    `camera_position` (x, y, z [m], world frame).

    **Observation** (`state`): the vector of `ViewpointObserver`; `state_dict` has its parts by name.
    **Action** (`pd_look_at`, 3 numbers in [-1, 1]): right, up, forward in the look frame, norm 1 meaning 0.12 m.
    **Info**, each of shape (num_envs,): `success`, `fail`, `visible_fraction`, `visible_fraction_gain`, `target_id`,
    `target_seen`, `tomato_seen`, `reachability` (`Reach`; neighbour: the move was shortened), `clearance` [m],
    `plant_contact`, `moves`, `path_length` [m].
    """

    task: GeneralTaskConfig

    def __init__(
        self,
        *args: Any,
        task: GeneralTaskConfig | None = None,
        episodes: str | Sequence[Episode] | None = None,
        layout: ObservationLayout | Sequence[str] | None = None,
        start_visibility: Sequence[float] | None = None,
        contact_penalty: float | None = None,
        sensor_noise: SensorNoise | Mapping[str, float] | None = None,
        perception: Perception = "ground_truth",
        privileged: bool = False,
        plant: PlantSpec | Mapping[str, object] | str | None = None,
        plant_pose_noise: Sequence[float] | None = None,
        control_mode: str | None = "pd_look_at",
        **kwargs: Any,
    ) -> None:
        self._sensor_noise = SensorNoise.parse(sensor_noise)
        options.check_choice("perception", perception, get_args(Perception))
        if perception != "ground_truth" and self._sensor_noise != SensorNoise():
            raise InvalidInputError(
                "sensor_noise disturbs ground truth; leave it out with perception='occlusion_model', "
                "whose depth has noise of its own"
            )
        if perception in RENDERED and kwargs.get("render_backend") == "none":
            raise InvalidInputError(
                f"perception={perception!r} renders colours; leave render_backend='none' out, or use 'occlusion_model'"
            )
        self.perception: Perception = perception
        self._takes_pictures = perception in RENDERED
        if self._takes_pictures:
            width, height = RENDERED_SIZE
            kwargs.setdefault("sensor_configs", {"width": width, "height": height})
        self._privileged = privileged
        self._leaf_density_limit = math.inf
        task = task or GeneralTaskConfig()
        if start_visibility is not None:
            low, high = options.check_range("start_visibility", start_visibility)
            task = replace(task, start_visibility=(low, high))
        if contact_penalty is not None:
            task = replace(task, contact_penalty=float(contact_penalty))
        choice = PlantSpec.parse(plant, task.plant)
        self._episodes = EpisodeChoice(episodes)
        if self._episodes.episodes is not None:
            choice = replace(choice, seed=self._episodes.split, pool=None)
        if layout is not None and not isinstance(layout, ObservationLayout):
            layout = ObservationLayout(parts=tuple(layout))  # type: ignore[arg-type]
        self.layout: ObservationLayout = layout or ObservationLayout()
        super().__init__(
            *args,
            task=task,
            plant=choice,
            plant_pose_noise=task.plant_pose_noise if plant_pose_noise is None else plant_pose_noise,
            control_mode=control_mode,
            **kwargs,
        )

    def _make_tools(self) -> None:
        n, device = self.num_envs, self.device
        self._observer = ViewpointObserver(n, device, self.layout, self.task.max_moves)
        self._hard_starts = HardStarts(self.task, self._ray_scene, device)
        self.ground_truth = GroundTruth(
            self._ray_scene,
            planting=lambda: self.planting,
            target=lambda: self._target,
            qpos=lambda: self.agent.robot.get_qpos(),
            threshold=self.task.full_visibility,
        )
        """What only the simulator knows; for policies that need the truth."""
        self._errors = SensorErrors(self._sensor_noise, n, device)
        self._camera = make_camera(
            self.perception, self._ray_scene, self.camera_intrinsics, self._wrist_picture
        )
        self._hidden_below: list[float | None] = [None] * n
        self.soft_starts = 0
        """Episodes so far that no drawn start made as hard as asked for."""
        self._true_views = TrueViews(n, self._observer.lattice) if self._privileged else None
        self._views = torch.zeros(n, MAX_VIEWS, 7, device=device)
        self._view_count = torch.zeros(n, dtype=torch.int64, device=device)
        self._moves = torch.zeros(n, dtype=torch.int64, device=device)
        self._path_length = torch.zeros(n, device=device)
        self._clearance = torch.zeros(n, device=device)
        self._gain = torch.zeros(n, device=device)
        self._camera_position = torch.zeros(n, 3, device=device)
        self._observation = torch.zeros(n, self.layout.size, device=device)

    # ---------------------------------------------------------------- episode

    @property
    def belief(self) -> Belief:
        """What is known after the last look, for policies."""
        return self._observer.belief

    def episode(self, env_index: int, options: Mapping[str, Any]) -> Episode | None:
        """The episode of the list that a reset with these options begins; None without a list."""
        return self._episodes.at(env_index, int(self._episode_seed[env_index]), options)

    def _plant_seed(self, env_index: int, rng: np.random.RandomState, options: dict[str, Any]) -> int:
        episode = self.episode(env_index, options)
        if episode is not None:
            return episode.plant_seed
        # Without a limit, or with that of the task's highest density, the first draw is taken.
        for _ in range(MAX_PLANT_DRAWS):
            seed = self._choice.draw_seed(rng)
            if (leaf_density_of(self._choice.leaf_density, seed) or 0.0) <= self._leaf_density_limit:
                return seed
        raise InvalidInputError(
            f"none of {MAX_PLANT_DRAWS} drawn plants has a leaf density of {self._leaf_density_limit} or less; "
            "raise the limit (leaf_density_start) or the plants' pool"
        )

    @property
    def leaf_density_range(self) -> tuple[float, float]:
        """Of the plants that are drawn without a limit; equal numbers where all plants have one density."""
        density = self._choice.leaf_density
        if isinstance(density, tuple):
            return density
        return (1.0, 1.0) if density is None else (density, density)

    def limit_leaf_density(self, highest: float) -> None:
        """From the next reset on, draws only plants whose leaf density is at most this.

        Raises:
            InvalidInputError: No plant of the range is as sparse as that.
        """
        low, _ = self.leaf_density_range
        if highest <= low:
            raise InvalidInputError(f"the highest leaf density must be above {low}, got {highest}")
        self._leaf_density_limit = highest

    def _candidates(self, env_index: int) -> list[int]:
        """The fruits that can become targets."""
        plant, ripe = self.planting.plants[env_index], self.planting.ripe_fruits[env_index]
        return [j for j in ripe if j < plant.middle_fruits] if isinstance(plant, Row) else ripe

    def _initialize_episode(self, env_idx: Tensor, options: dict[str, Any]) -> None:
        indices = [int(i) for i in env_idx]
        episode_rngs: Any = self._batched_episode_rng
        rngs = [episode_rngs[i] for i in indices]
        self._place_plants(env_idx, indices, rngs, options)
        episodes = [self.episode(i, options) for i in indices]
        if self._episodes.episodes is not None:
            self._put_plants(env_idx, np.array([e.plant_pose for e in episodes if e is not None]))
        starts = [
            self._start(i, rng, episode, options)
            for i, rng, episode in zip(indices, rngs, episodes, strict=True)
        ]
        self.soft_starts += sum(not start.is_hard for start in starts)
        self._target[env_idx] = torch.tensor([start.target for start in starts], device=self.device)
        self._look_up_target()
        poses = torch.stack([start.T_world_camera for start in starts]).double()
        near = torch.tensor([START_RPY], dtype=torch.float64, device=self.device).expand(len(starts), 3)
        viewpoint = camera_to_viewpoint(poses, near).float()
        self._set_arm(env_idx, viewpoint, torch.stack([start.qpos for start in starts]))
        for i, rng, start in zip(indices, rngs, starts, strict=True):
            self._errors.begin(i, rng)
            if self._camera is not None:
                self._camera[0].seed(i, int(rng.randint(2**31 - 1)))
                hidden = start.is_hard and options.get("camera_position") is None
                self._hidden_below[i] = self.task.start_visibility[1] if hidden else None
        self._begin(env_idx)

    def _start(
        self, env_index: int, rng: np.random.RandomState, episode: Episode | None, options: dict[str, Any]
    ) -> Start:
        targets = self._candidates(env_index)
        camera_position = options.get("camera_position", None)
        if episode is not None:
            targets = [episode.target]
            camera_position = episode.camera_position if camera_position is None else camera_position
        if "target" in options:
            targets = [self._checked_target(env_index, options["target"])]
        positions = self._fruit_positions(env_index, targets)
        if camera_position is not None:
            k = int(rng.randint(len(targets))) if len(targets) > 1 else 0
            return self._hard_starts.given(camera_position, targets[k], positions[k])
        T_world_plant = self.planting.T_world_plant[env_index]
        return self._hard_starts.draw(env_index, rng, targets, positions, T_world_plant)

    def _fruit_positions(self, env_index: int, fruits: list[int]) -> Tensor:
        plant, T = self.planting.plants[env_index], self.planting.T_world_plant[env_index]
        centres = np.array([plant.fruits[j].centre for j in fruits], dtype=np.float32).reshape(-1, 3)
        return torch.as_tensor(centres, device=self.device) @ T[:3, :3].T + T[:3, 3]

    def _begin(self, env_idx: Tensor) -> None:
        """Begins the episodes of some environments where plants, targets and arms are now."""
        self._moves[env_idx] = 0
        self._path_length[env_idx] = 0.0
        self._gain[env_idx] = 0.0
        qpos = self.agent.robot.get_qpos()
        clearance = self._ray_scene.clearance_at(qpos, self.planting.T_world_plant)
        self._clearance[env_idx] = clearance[env_idx]
        self._look_anew(env_idx)
        self._visible_fraction = self._measured_fraction().clone()

    def _look_anew(self, env_idx: Tensor) -> None:
        """Forgets what was seen in some environments and takes a first look at their targets."""
        self._forget(env_idx)
        self._look_first(env_idx)

    def _forget(self, env_idx: Tensor) -> None:
        """Begins with other targets, of which nothing was seen yet."""
        if self._camera is None:
            return
        camera, perception = self._camera
        for i in env_idx.tolist():
            position = camera.coarse_position(i, self._target_position_w[i].double().cpu().numpy())
            perception.begin(i, position, hidden_below=self._hidden_below[i])
            self._hidden_below[i] = None

    def _look_first(self, env_idx: Tensor) -> None:
        self._ask_truth(env_idx)
        self._observer.begin(env_idx, self._known_target_position()[env_idx])
        self._view_count[env_idx] = 0
        self._views[env_idx] = 0.0
        mask = torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)
        mask[env_idx] = True
        self._look(self.agent.robot.get_qpos(), mask)

    def _ask_truth(self, env_idx: Tensor) -> None:
        if self._true_views is not None:
            fraction = self.ground_truth.visible_fraction
            self._true_views.begin(env_idx, self._target_position_w, fraction)

    # ------------------------------------------------------------------- step

    def _look(self, qpos: Tensor, mask: Tensor | None) -> None:
        """Looks from where the arm stands and takes the view into the memory, once for every view."""
        rows = torch.arange(self.num_envs, device=self.device) if mask is None else mask.nonzero()[:, 0]
        self._views[rows, self._view_count[rows].clamp_max(MAX_VIEWS - 1)] = qpos[rows]
        self._view_count[rows] += 1
        self._observe(qpos, mask)

    def _observe(self, qpos: Tensor, mask: Tensor | None) -> None:
        T_w_links = link_transforms(qpos)
        T_w_camera = T_w_links[:, -1] @ self._T_ee_camera
        T_w_plant = self.planting.T_world_plant
        self._seen: Visibility = self._ray_scene.visibility(T_w_camera, self._target, T_w_plant, T_w_links)
        self._camera_position = T_w_camera[:, :3, 3]
        if self._camera is None:
            known = self._errors.known_target(self._target_position_w)
            exact = self._ray_scene.view_rays(T_w_camera, self._target, known, T_w_plant, T_w_links)
            rays = self._errors.rays(exact, mask)
            measured = self._errors.visible_fraction(self._seen.visible_fraction)
        else:
            camera, perception = self._camera
            located = perception.look(camera.take(T_w_camera, self._target, T_w_plant, T_w_links, mask))
            if bool(located.any()):
                # What was seen before stands about the place where the target was thought to be.
                perception.recall(self._observer, located.nonzero()[:, 0])
            rays, measured = perception.rays(), perception.visible_fraction
        self._observation = self._observer.observe(
            self._viewpoint, T_w_camera, rays, measured, self._moves_left(), mask
        )

    def _wrist_picture(self, env_index: int) -> NDArray[np.uint8]:
        """What the wrist's colour camera sees now. Shape (height, width, 3)."""
        self.scene.update_render(update_sensors=True, update_human_render_cameras=False)
        camera = self.scene.sensors["d435"]
        camera.capture()
        colours = camera.get_obs(rgb=True, depth=False, position=False, segmentation=False)["rgb"]
        return np.asarray(colours[env_index].cpu().numpy())

    def _measured_fraction(self) -> Tensor:
        """V_f that success and reward go by. Shape (num_envs,)."""
        return self._seen.visible_fraction if self._camera is None else self._camera[1].visible_fraction

    def _known_target_position(self) -> Tensor:
        if self._camera is not None:
            return self._camera[1].target_position
        return self._errors.known_target(self._target_position_w)

    def _moves_left(self) -> Tensor:
        return (self.task.max_moves - self._moves).clamp_min(0)

    def _step_action(self, action: Any) -> Tensor | None:
        before, position = self.agent.robot.get_qpos().clone(), self._camera_position
        fraction = self._measured_fraction().clone()
        batch = super()._step_action(action)
        if batch is None:
            return None
        self._path_length = self._path_length + self._pass_way(before, position, batch)
        self._moves = self._moves + 1
        self._look(self.agent.robot.get_qpos(), None)
        self._visible_fraction = self._measured_fraction().clone()
        self._gain = self._visible_fraction - fraction
        return batch

    def _pass_way(self, before: Tensor, position: Tensor, action: Tensor) -> Tensor:
        """Measures the clearance of the last move and how long the camera's way was.

        Args:
            before: Joint positions before it, in [rad]. Shape (num_envs, 7).
            position: Where the camera stood then, in the world frame, in [m]. Shape (num_envs, 3).
            action: What was asked for. Shape (num_envs, A).

        Returns:
            The way's length, in [m]. Shape (num_envs,).
        """
        qpos = self.agent.robot.get_qpos()
        self._clearance = self._ray_scene.clearance_along(before, qpos, self.planting.T_world_plant)
        T_w_camera = link_transforms(qpos)[:, -1] @ self._T_ee_camera
        length: Tensor = (T_w_camera[:, :3, 3] - position).norm(dim=-1)
        return length

    def evaluate(self) -> dict[str, Tensor]:
        """What came of the last move: V_f, whether that is a success, and what the move touched."""
        fraction = self._visible_fraction
        truth = {}
        if self._camera is not None:
            seen = self._seen.visible_fraction
            truth = {"true_visible_fraction": seen.clone(), "true_success": seen > self.task.full_visibility}
        return truth | {
            "success": fraction > self.task.full_visibility,
            "fail": torch.zeros_like(fraction, dtype=torch.bool),
            "visible_fraction": fraction.clone(),
            "visible_fraction_gain": self._gain.clone(),
            "target_id": self._target_id.clone(),
            "target_seen": fraction > 0.0,
            "tomato_seen": self._seen.any_visible,
            "reachability": self._reach.clone(),
            "clearance": self._clearance.clone(),
            "plant_contact": self._clearance <= 0.0,
            "moves": self._moves.clone(),
            "path_length": self._path_length.clone(),
        }

    def compute_dense_reward(self, obs: Any, action: Tensor, info: dict[str, Tensor]) -> Tensor:
        """`view_gain_reward` of the last move. Shape (num_envs,)."""
        fraction = info["visible_fraction"]
        return view_gain_reward(
            fraction,
            fraction - info["visible_fraction_gain"],
            info["success"],
            info["plant_contact"],
            step_cost=self.task.step_cost,
            success_reward=self.task.success_reward,
            contact_penalty=self.task.contact_penalty,
        )

    def compute_normalized_dense_reward(self, obs: Any, action: Tensor, info: dict[str, Tensor]) -> Tensor:
        """The reward over the largest that a move can have. Shape (num_envs,)."""
        return self.compute_dense_reward(obs, action, info) / (1.0 + self.task.success_reward)

    def _get_obs_extra(self, info: dict[str, Tensor]) -> dict[str, Tensor]:
        seen = {str(name): self._observation[:, part].clone() for name, part in self.layout.slices.items()}
        if self._true_views is not None:
            seen["truth"] = self._true_views.describe(self._camera_position, self._target_position_w)
        return seen

    # ------------------------------------------------------------------ state

    def _task_state(self) -> dict[str, Tensor]:
        # The views say all: what the memory holds follows from them.
        return {
            **super()._task_state(),
            "views": self._views.flatten(1).clone(),
            "counts": torch.stack([self._view_count, self._moves], dim=-1).float(),
            "last_move": torch.stack([self._clearance, self._gain, self._path_length], dim=-1),
        }

    def _set_task_state(self, indices: Tensor, task: dict[str, Tensor]) -> None:
        super()._set_task_state(indices, task)
        self._views[indices] = task["views"].view(-1, MAX_VIEWS, 7)
        counts, last = task["counts"].long(), task["last_move"]
        self._view_count[indices], self._moves[indices] = counts[:, 0], counts[:, 1]
        self._clearance, self._gain = self._clearance.clone(), self._gain.clone()
        self._path_length = self._path_length.clone()
        self._clearance[indices], self._gain[indices], self._path_length[indices] = last.unbind(-1)
        self._ask_truth(indices)
        self._replay(indices)

    def _replay(self, indices: Tensor) -> None:
        """Looks again from where some environments looked, so that their memory is what it was."""
        self._observer.begin(indices, self._known_target_position()[indices])
        if self._camera is not None:
            for i in indices.tolist():
                self._camera[1].forget_views(i)
        chosen = torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)
        chosen[indices] = True
        count = self._view_count.clamp_max(MAX_VIEWS)
        for k in range(int(count[indices].max())):
            self._observe(self._views[:, k], chosen & (k < count))
        # Once more for the numbers alone, with all arms where they are now.
        self._observe(self.agent.robot.get_qpos(), torch.zeros_like(chosen))
        self._visible_fraction = self._measured_fraction().clone()


# Gymnasium's registry has the id already, lazily; this line tells ManiSkill's own.
register("TomatoViewpoint-v1", TomatoViewpointGeneralEnv, max_episode_steps=MAX_GENERAL_STEPS)
