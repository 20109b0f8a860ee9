"""The viewpoint tasks: move the wrist camera to where a tomato hidden by leaves is fully visible."""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import sapien
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.sensors.camera import CameraConfig, parse_camera_configs, update_camera_configs_from_dict
from mani_skill.utils import sapien_utils
from mani_skill.utils.registration import register
from mani_skill.utils.structs.types import SimConfig
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError, RenderingUnavailableError
from maniskill_tomato.plants.organs import SemanticClass
from maniskill_tomato.robot.agent import Iiwa14D435
from maniskill_tomato.robot.d435 import CameraIntrinsics, T_flange_camera_color_optical
from maniskill_tomato.robot.description import link_meshes
from maniskill_tomato.robot.inverse_kinematics import Reach
from maniskill_tomato.robot.kinematics import link_transforms
from maniskill_tomato.robot.rotations import matrix_to_rpy
from maniskill_tomato.robot.viewpoint_controller import ViewpointController
from maniskill_tomato.tasks import MAX_EPISODE_STEPS, options, scene_mask, scenery
from maniskill_tomato.tasks.config import ViewpointTaskConfig, guided_task, sparse_task
from maniskill_tomato.tasks.flat_state import checked_rows, unflatten
from maniskill_tomato.tasks.motion import drive_to
from maniskill_tomato.tasks.other_targets import other_ripe_fruits
from maniskill_tomato.tasks.plant_choice import PlantChoice, PlantPose
from maniskill_tomato.tasks.planting import GROWN_PLANTS, Planting, ripe_fruit_at_random
from maniskill_tomato.tasks.rewards import in_forbidden_zone
from maniskill_tomato.tasks.starts import Starts
from maniskill_tomato.visibility.caster import VisibilityCaster

ROBOTS = ("iiwa14_d435", "iiwa14_d435_raw_depth")
"""The robots that can do the tasks."""


class TomatoViewpointEnv(BaseEnv):  # type: ignore[misc]
    """One environment class for all viewpoint tasks; a `ViewpointTaskConfig` tells them apart.

    **Options** beside ManiSkill's own:

    - `plant`: a preset's name or a mapping of `PlantChoice` fields, e.g. `{"preset": "full", "seed":
      "held_out"}` for a new held-out plant at every reset.
    - `plant_pose`: `(x, y, yaw)` of the stem in the world frame, in [m, m, rad].
    - `plant_pose_noise`: half ranges of a uniform addition to it at every reset, in [m, m, rad].
    - `motion`: `"kinematic"` puts the joints at the solution, `"dynamic"` drives them there through physics.
    - `rays_per_side`: the visibility query casts this number squared.
    - `other_targets`: how many other ripe fruits are judged at every step as if each were the target (below).
    - `render_backend`: `"auto"` renders on the GPU if there is one, else on the CPU, and not at all where no
      picture is asked for.

    `reset(options=...)` also takes `target` (index of a ripe fruit in `Plant.fruits`) and `viewpoint` (x, y,
    z, roll, pitch, yaw of the start), for all environments being reset.

    **Observation** (`state`, 9 numbers, world frame): end-effector x, y, z [m], roll, pitch, yaw [rad],
    target x, y, z [m].
    **Action** (`pd_viewpoint`, 6 numbers in [-1, 1]): increments of the first six, 1 meaning 1 m or 1 rad.
    **Info**, each of shape (num_envs,): `success`, `fail`, `visible_fraction`, `target_id` (segmentation id),
    `target_seen`, `tomato_seen`, `reachability` (`Reach`), `in_forbidden_zone`, `reward_visual`,
    `reward_penalty`. With `other_targets` K also what another target in the same place would have given, for the K
    ripe fruits that follow the target in the plant's order: `other_visible_fraction`, `other_success`,
    `other_reward`, `other_exists` (the plant has that many), each of shape (num_envs, K), and `other_position` in
    the world frame, in [m], of shape (num_envs, K, 3).
    """

    SUPPORTED_ROBOTS = list(ROBOTS)
    SUPPORTED_REWARD_MODES = options.REWARD_MODES
    agent: Iiwa14D435  # pyright: ignore[reportIncompatibleVariableOverride]

    def __init__(
        self,
        *args: Any,
        task: ViewpointTaskConfig,
        robot_uids: str = "iiwa14_d435",
        plant: PlantChoice | Mapping[str, object] | str | None = None,
        plant_pose: PlantPose | Sequence[float] | None = None,
        plant_pose_noise: Sequence[float] = (0.0, 0.0, 0.0),
        motion: options.Motion = "kinematic",
        rays_per_side: int = 16,
        other_targets: int = 0,
        num_envs: int = 1,
        obs_mode: str | None = None,
        reward_mode: str | None = None,
        render_mode: str | None = None,
        control_mode: str | None = None,
        sim_backend: str = "auto",
        render_backend: str = "auto",
        reconfiguration_freq: int | None = None,
        **kwargs: Any,
    ) -> None:
        options.check_choice("robot_uids", robot_uids, ROBOTS)
        options.check_choice("reward_mode", reward_mode, options.REWARD_MODES)
        options.check_choice("render_mode", render_mode, options.RENDER_MODES)
        options.check_choice("control_mode", control_mode, Iiwa14D435.CONTROL_MODES)
        options.check_obs_mode(obs_mode)
        options.check_motion(motion)
        options.check_num_envs(num_envs, sim_backend)
        options.check_rays_per_side(rays_per_side)
        options.check_other_targets(other_targets)
        self.task = task
        self._choice = PlantChoice.parse(plant, task.plant)
        self._plant_pose = PlantPose.parse(plant_pose, task.plant_pose)
        self._plant_pose_noise = options.check_half_ranges("plant_pose_noise", plant_pose_noise, 3)
        self.motion = motion
        self._rays_per_side = rays_per_side
        self._other_targets = other_targets
        self._has_caster = False
        rendering = options.needs_rendering(obs_mode, render_mode)
        render_backend = options.pick_render_backend(render_backend, rendering)
        # A new plant to look at needs new actors, and so a new scene.
        self._swaps_plants = self._choice.changes and render_backend == "none"
        if reconfiguration_freq is None:
            reconfiguration_freq = 1 if self._choice.changes and not self._swaps_plants else 0
        try:
            super().__init__(
                *args,
                robot_uids=robot_uids,
                num_envs=num_envs,
                obs_mode=obs_mode,
                reward_mode=reward_mode,
                render_mode=render_mode,
                control_mode=control_mode,
                sim_backend=options.pick_sim_backend(sim_backend, num_envs),
                render_backend=render_backend,
                reconfiguration_freq=reconfiguration_freq,
                **kwargs,
            )
        except RuntimeError as error:
            problem = options.rendering_failure(error) if rendering else None
            if problem is not None:
                raise RenderingUnavailableError(problem) from error
            raise

    # ------------------------------------------------------------------ scene

    @property
    def _default_sim_config(self) -> SimConfig:
        return SimConfig(sim_freq=100, control_freq=20)

    @property
    def _default_human_render_camera_configs(self) -> CameraConfig:
        pose = sapien_utils.look_at(eye=[-0.35, -1.65, 1.45], target=[0.38, 0.0, 0.66])
        return CameraConfig("render_camera", pose=pose, width=640, height=480, fov=0.82, near=0.01, far=20.0)

    def _load_agent(self, options: dict[str, Any], *args: Any, **kwargs: Any) -> None:
        super()._load_agent(options, sapien.Pose())
        controller = self.agent.controller
        if isinstance(controller, ViewpointController):
            controller.config = replace(
                controller.config,
                neighbour_poses=self.task.neighbour_poses,
                outside_workspace="home" if self.task.outside_workspace == "home" else "stay",
                drive_joints=False,
            )

    def _load_scene(self, options: dict[str, Any]) -> None:
        scenery.build(self.scene)
        seeds = [self._choice.draw_seed(self._batched_episode_rng[i]) for i in range(self.num_envs)]
        self.planting = Planting(
            self.scene, self._choice, seeds, self.device, with_actors=not self._swaps_plants
        )
        if not self._has_caster:
            self._has_caster = True
            self._caster = VisibilityCaster(
                plants=self.planting.plants,
                intrinsics=self.camera_intrinsics,
                robot_meshes=link_meshes(),
                rays_per_side=self._rays_per_side,
                cached_plants=GROWN_PLANTS,
                device=str(self.device),
            )
            n, device = self.num_envs, self.device
            self._T_ee_camera = torch.tensor(
                T_flange_camera_color_optical, dtype=torch.float32, device=device
            )
            self._starts = Starts(self.task, device)
            self._viewpoint = torch.zeros(n, 6, device=device)
            self._reach = torch.zeros(n, dtype=torch.int64, device=device)
            self._target = torch.zeros(n, dtype=torch.int64, device=device)
        else:
            for i, plant in enumerate(self.planting.plants):
                self._caster.replace_plant(i, plant)

    def _load_lighting(self, options: dict[str, Any]) -> None:
        scenery.light(self.scene, shadows=self.enable_shadow)

    @property
    def camera_intrinsics(self) -> CameraIntrinsics:
        """Intrinsics of the wrist's colour camera, with what `sensor_configs` changes about them."""
        configs = parse_camera_configs(self.agent._sensor_configs)
        update_camera_configs_from_dict(configs, copy.deepcopy(self._custom_sensor_configs) or {})
        camera = configs["d435"]
        if camera.intrinsic is None:
            return CameraIntrinsics.from_fov(width=camera.width, height=camera.height, fov_y=camera.fov)
        K = np.asarray(camera.intrinsic, dtype=np.float64)
        return CameraIntrinsics(
            width=camera.width, height=camera.height, fx=K[0, 0], fy=K[1, 1], cx=K[0, 2], cy=K[1, 2]
        )

    # ---------------------------------------------------------------- episode

    def _initialize_episode(self, env_idx: Tensor, options: dict[str, Any]) -> None:
        indices = [int(i) for i in env_idx]
        episode_rngs: Any = self._batched_episode_rng
        rngs: list[np.random.RandomState] = [episode_rngs[i] for i in indices]
        if self._choice.changes:
            self._change_plants(indices, rngs)
        noise = np.array(self._plant_pose_noise)
        poses = [self._plant_pose.as_array() + noise * rng.uniform(-1.0, 1.0, 3) for rng in rngs]
        x, y, yaw = torch.as_tensor(np.stack(poses), dtype=torch.float32, device=self.device).unbind(-1)
        self.planting.place(env_idx, x, y, yaw)
        targets = [ripe_fruit_at_random(self.planting, i, rng) for i, rng in zip(indices, rngs, strict=True)]
        if "target" in options:
            targets = [self._checked_target(i, options["target"]) for i in indices]
        self._target[env_idx] = torch.as_tensor(targets, device=self.device)
        self._look_up_target()
        if "viewpoint" in options:
            viewpoint, qpos = self._starts.given(options["viewpoint"], len(indices))
        else:
            viewpoint, qpos = self._starts.draw(rngs)
        self._set_arm(env_idx, viewpoint, qpos)

    def _change_plants(self, indices: list[int], rngs: list[np.random.RandomState]) -> None:
        # The first draw of an episode is its plant's seed, the same that a new scene was built with just before.
        for i, rng in zip(indices, rngs, strict=True):
            seed = self._choice.draw_seed(rng)
            if self._swaps_plants and seed != self.planting.seeds[i]:
                self._caster.replace_plant(i, self.planting.replace(i, seed))

    def _look_up_target(self) -> None:
        rows = torch.arange(self.num_envs, device=self.device)
        self._target_id = self.planting.fruit_segmentation_id[rows, self._target]
        self._target_position_w = self.planting.fruit_position_w(self._target)
        if self._other_targets:
            self._others, self._others_exist = other_ripe_fruits(
                self.planting, self._target, self._other_targets
            )

    def _checked_target(self, env_index: int, target: object) -> int:
        ripe = self.planting.ripe_fruits[env_index]
        if isinstance(target, bool) or not isinstance(target, int) or target not in ripe:
            raise InvalidInputError(
                f"reset option target must be a ripe fruit of the plant, one of {ripe}; got {target!r}"
            )
        return target

    def _set_arm(self, env_idx: Tensor, viewpoint: Tensor, qpos: Tensor) -> None:
        self._viewpoint[env_idx] = viewpoint
        self._reach[env_idx] = Reach.REACHABLE
        self.agent.robot.set_qpos(qpos)
        self.agent.robot.set_qvel(torch.zeros_like(qpos))

    # ------------------------------------------------------------------- step

    def _step_action(self, action: Any) -> Tensor | None:
        if action is None:
            return None
        if isinstance(action, Mapping):
            raise InvalidInputError(
                "an action is an array; choose its meaning with control_mode in gymnasium.make"
            )
        batch = self._checked_action(action)
        controller = self.agent.controller
        if isinstance(controller, ViewpointController):
            controller.viewpoint, controller.reach = self._viewpoint, self._reach
            controller.set_action(batch)
            if self.motion == "kinematic":
                self._put_joints(controller.target_qpos)
            else:
                drive_to(self.scene, self.agent, controller.target_qpos)
                controller.observe()
            self._viewpoint, self._reach = controller.viewpoint, controller.reach
        else:
            self._reach = torch.full_like(self._reach, int(Reach.REACHABLE))
            if self.motion == "kinematic":
                self.agent.set_action(batch)
                self._put_joints(self.agent.robot.get_drive_targets())
            else:
                super()._step_action(batch)
            self._observe_viewpoint()
        return batch

    def _checked_action(self, action: Any) -> Tensor:
        try:
            batch = torch.as_tensor(action, dtype=torch.float32, device=self.device)
        except (TypeError, ValueError, RuntimeError) as error:
            raise InvalidInputError(
                f"an action must be an array of numbers; got {type(action).__name__}"
            ) from error
        space: Any = self._orig_single_action_space
        size: int = space.shape[0]
        if batch.shape == (size,) and self.num_envs == 1:
            batch = batch[None]
        if batch.shape != (self.num_envs, size):
            single = f" or ({size},)" if self.num_envs == 1 else ""
            raise InvalidInputError(
                f"an action must have shape ({self.num_envs}, {size}){single}; got {tuple(batch.shape)}"
            )
        if not bool(batch.isfinite().all()):
            raise InvalidInputError("an action must be finite; got NaN or infinity")
        return batch

    def _put_joints(self, qpos: Tensor) -> None:
        self.agent.robot.set_qpos(qpos)
        if self.gpu_sim_enabled:
            gpu_system: Any = self.scene.px
            self.scene._gpu_apply_all()
            gpu_system.gpu_update_articulation_kinematics()
            self.scene._gpu_fetch_all()

    def _observe_viewpoint(self) -> None:
        T_w_ee = link_transforms(self.agent.robot.get_qpos())[:, -1]
        rpy = matrix_to_rpy(T_w_ee[:, :3, :3], self._viewpoint[:, 3:])
        self._viewpoint = torch.cat([T_w_ee[:, :3, 3], rpy], dim=-1)

    def evaluate(self) -> dict[str, Tensor]:
        """What the camera sees from where it is: V_f, whether that is a success, and the terms of the
        reward."""
        T_w_links = link_transforms(self.agent.robot.get_qpos())
        info = self._judge(self._target, T_w_links)
        info["target_id"] = self._target_id.clone()
        if self._other_targets:
            info |= self._judge_others(T_w_links)
        return info

    def _judge(self, target: Tensor, T_w_links: Tensor) -> dict[str, Tensor]:
        """The present view as one of `target`, indices in `Plant.fruits`. Shape (num_envs,)."""
        seen = self._caster.cast(
            T_w_links[:, -1] @ self._T_ee_camera, target, self.planting.T_world_plant, T_w_links
        )
        fraction, tomato_seen = seen.visible_fraction, seen.any_visible
        target_seen = fraction > 0.0
        forbidden = in_forbidden_zone(self._viewpoint[:, :3])
        unreachable = self._reach == int(Reach.UNREACHABLE)
        fail = unreachable if self.task.outside_workspace == "end" else torch.zeros_like(unreachable)
        return {
            "success": (fraction > self.task.full_visibility) & ~fail,
            "fail": fail,
            "visible_fraction": fraction,
            "target_seen": target_seen,
            "tomato_seen": tomato_seen,
            "reachability": self._reach.clone(),
            "in_forbidden_zone": forbidden,
            "reward_visual": self.task.visual_reward(fraction, target_seen, tomato_seen, self._reach),
            "reward_penalty": self.task.pose_penalty(self._reach, forbidden),
        }

    def _judge_others(self, T_w_links: Tensor) -> dict[str, Tensor]:
        """The present view as one of each of the other ripe fruits."""
        fruits = self._others.unbind(-1)
        judged = [self._judge(fruit, T_w_links) for fruit in fruits]
        rewards: list[Tensor] = [self.get_reward(obs=None, action=torch.empty(0), info=j) for j in judged]
        return {
            "other_visible_fraction": torch.stack([j["visible_fraction"] for j in judged], dim=-1),
            "other_success": torch.stack([j["success"] for j in judged], dim=-1),
            "other_reward": torch.stack(rewards, dim=-1),
            "other_exists": self._others_exist.clone(),
            "other_position": torch.stack([self.planting.fruit_position_w(f) for f in fruits], dim=-2),
        }

    def compute_dense_reward(self, obs: Any, action: Tensor, info: dict[str, Tensor]) -> Tensor:
        """R = R_v + P_p (Eq. 4-5), clipped to the task's bounds. Shape (num_envs,)."""
        low, high = self.task.reward_bounds
        return (info["reward_visual"] + info["reward_penalty"]).clamp(low, high)

    def compute_normalized_dense_reward(self, obs: Any, action: Tensor, info: dict[str, Tensor]) -> Tensor:
        """The reward over its largest value. Shape (num_envs,)."""
        return self.compute_dense_reward(obs, action, info) / self.task.reward_bounds[1]

    # ------------------------------------------------------------ observation

    def _get_obs_agent(self) -> dict[str, Tensor]:
        """Nothing in the state modes, whose observation is the thesis's nine numbers; joints and viewpoint
        beside pictures."""
        if self._obs_mode in ("state", "state_dict"):
            return {}
        return {"qpos": self.agent.robot.get_qpos(), "qvel": self.agent.robot.get_qvel()}

    def _flatten_raw_obs(self, obs: Any) -> Any:
        if self._obs_mode == "state":
            return torch.cat(tuple(obs["extra"].values()), dim=-1)
        return super()._flatten_raw_obs(obs)

    def _get_obs_extra(self, info: dict[str, Tensor]) -> dict[str, Tensor]:
        return {
            "ee_position": self._viewpoint[:, :3].clone(),
            "ee_rpy": self._viewpoint[:, 3:].clone(),
            "target_position": self.target_position_w,
        }

    @property
    def target_position_w(self) -> Tensor:
        """Centre of the target fruit in the world frame, in [m]. Shape (num_envs, 3)."""
        return self._target_position_w.clone()

    @property
    def target_fruit(self) -> Tensor:
        """Index of the target in `Plant.fruits`. Shape (num_envs,)."""
        return self._target.clone()

    def semantic_classes(self, env_index: int = 0) -> dict[int, SemanticClass]:
        """The semantic class of every segmentation id of an environment; ids that are missing are
        background."""
        links = self.agent.robot.get_links()
        robot = {int(link._objs[env_index].entity.per_scene_id): SemanticClass.ROBOT for link in links}
        return robot | self.planting.semantic_classes(env_index)

    # ------------------------------------------------------------------ state

    def get_state_dict(self) -> dict[str, Any]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """ManiSkill's state and the task's own under `task`: viewpoint, reach, target, and pose and seed of
        the plant."""
        sim_state: Any = self.scene.get_sim_state()
        state: dict[str, Any] = dict(sim_state)
        state["task"] = {
            "viewpoint": self._viewpoint.clone(),
            "reach": self._reach[:, None].float(),
            "target": self._target[:, None].float(),
            "plant_pose": torch.cat([self.planting.position_w[:, :2], self.planting.yaw[:, None]], dim=-1),
            "plant_seed": torch.tensor(self.planting.seeds, dtype=torch.float32, device=self.device)[:, None],
        }
        return state

    def set_state_dict(self, state: dict[str, Any], env_idx: Tensor | None = None) -> None:
        """Takes back what `get_state_dict` gave.

        Raises:
            InvalidInputError: The state belongs to another plant, lacks something or is not finite; nothing was
                changed.
        """
        indices = torch.arange(self.num_envs, device=self.device) if env_idx is None else env_idx
        robot = self.agent.robot
        task = {
            name: checked_rows(state, ("task", name), len(indices), self.device)
            for name in ("viewpoint", "reach", "target", "plant_pose", "plant_seed")
        }
        arm = checked_rows(state, ("articulations", robot.name), len(indices), self.device)
        seeds = [self.planting.seeds[int(i)] for i in indices]
        stored = [int(s) for s in task["plant_seed"][:, 0]]
        if stored != seeds:
            raise InvalidInputError(
                f"the state belongs to plants of seed {stored}, but this environment holds {seeds}; "
                "make it with plant={'seed': ...} or reset it with the seed of that episode"
            )
        # The base never moves, and to set its pose again would shift it by rounding.
        dof = robot.max_dof
        qpos, qvel = arm[:, -2 * dof : -dof].float(), arm[:, -dof:].float()
        with scene_mask.only(self.scene, indices):
            robot.set_qvel(qvel)
            self._put_joints(qpos)
        x, y, yaw = task["plant_pose"].unbind(-1)
        self.planting.place(indices, x, y, yaw)
        self._viewpoint, self._reach, self._target = (
            self._viewpoint.clone(),
            self._reach.clone(),
            self._target.clone(),
        )
        self._viewpoint[indices] = task["viewpoint"].float()
        self._reach[indices] = task["reach"][:, 0].long()
        self._target[indices] = task["target"][:, 0].long()
        self._look_up_target()

    def set_state(self, state: Any, env_idx: Tensor | None = None) -> None:
        """Takes back the flat vector that `get_state` gave. Shape (b, D)."""
        like: Any = self._init_raw_state
        self.set_state_dict(unflatten(torch.as_tensor(state, device=self.device), like), env_idx)


class TomatoViewpointGuidedEnv(TomatoViewpointEnv):
    """**Task Description:**
    One ripe tomato hangs behind leaves. Move the camera, step by step, to where it is fully visible; the
    reward (Eq. 5-3, 5-4) grows with the visible fraction V_f. A pose outside the workspace sends the arm
    home, and the episode goes on.

    **Randomizations:**
    - The end-effector starts uniformly in x [-0.1, 0.2], y [-0.35, 0.1], z [0.65, 1.15] m, roll 0, pitch
      [0.45 pi, 0.7 pi], yaw [0, 0.25 pi] (Eq. 5-1, 5-2), redrawn while the arm cannot reach the pose.

    **Success Conditions:**
    - V_f of the tomato is above 0.85.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, task=guided_task(), **kwargs)


class TomatoViewpointSparseEnv(TomatoViewpointEnv):
    """**Task Description:**
    Three ripe tomatoes hang behind leaves, and one of them is the target. Move the camera to where it is
    fully visible; only good views are rewarded (Eq. 5-9, 5-10). A pose outside the workspace ends the
    episode.

    **Randomizations:**
    - The target is one of the three ripe tomatoes.
    - The end-effector starts uniformly in x [-0.1, 0.2], y [-0.25, 0.25], z [0.65, 1.15] m, roll 0, pitch
      [0.45 pi, 0.7 pi], yaw [-pi/8, pi/8] (Eq. 5-7, 5-8), redrawn while the arm cannot reach the pose.

    **Success Conditions:**
    - V_f of the target is above 0.8.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, task=sparse_task(), **kwargs)


# Gymnasium's registry has the ids already, lazily; these lines tell ManiSkill's own.
register("TomatoViewpointGuided-v1", TomatoViewpointGuidedEnv, max_episode_steps=MAX_EPISODE_STEPS)
register("TomatoViewpointSparse-v1", TomatoViewpointSparseEnv, max_episode_steps=MAX_EPISODE_STEPS)
