"""What all tasks share: robot, plants and scene, options, moving and looking, saved states."""

import copy
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np
import sapien
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.sensors.camera import CameraConfig, parse_camera_configs, update_camera_configs_from_dict
from mani_skill.utils import sapien_utils
from mani_skill.utils.structs.types import SimConfig
from numpy.typing import NDArray
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError, RenderingUnavailableError
from maniskill_tomato.plants.organs import SemanticClass
from maniskill_tomato.plants.spec import PlantPose, PlantSpec
from maniskill_tomato.raycast.scene import RayScene
from maniskill_tomato.robot.d435 import CameraIntrinsics, T_flange_camera_color_optical
from maniskill_tomato.robot.inverse_kinematics import Reach
from maniskill_tomato.robot.kinematics import link_transforms
from maniskill_tomato.robot.robot_description import link_meshes
from maniskill_tomato.robot.rotations import matrix_to_rpy
from maniskill_tomato.tasks import options
from maniskill_tomato.tasks.maniskill import scene_mask, scenery
from maniskill_tomato.tasks.maniskill.agent import Iiwa14D435
from maniskill_tomato.tasks.maniskill.flat_state import checked_rows, unflatten
from maniskill_tomato.tasks.maniskill.look_at_controller import LookAtController
from maniskill_tomato.tasks.maniskill.motion import drive_to
from maniskill_tomato.tasks.maniskill.planting import GROWN_PLANTS, Planting
from maniskill_tomato.tasks.maniskill.viewpoint_controller import ViewpointController

ROBOTS = ("iiwa14_d435", "iiwa14_d435_raw_depth")
"""The robots that can do the tasks."""


class TaskConfig(Protocol):
    """What every task says about itself."""

    @property
    def plant(self) -> PlantSpec:
        """The plant that it uses unless it is given another."""
        ...

    @property
    def plant_pose(self) -> PlantPose:
        """Where that plant stands."""
        ...

    @property
    def full_visibility(self) -> float:
        """The target is fully visible when V_f is above this."""
        ...


class TomatoEnv(BaseEnv):  # type: ignore[misc]
    """Robot, plants, scene, and how a step moves the camera; tasks add episodes, what is seen and rewards."""

    SUPPORTED_ROBOTS = list(ROBOTS)
    SUPPORTED_REWARD_MODES = options.REWARD_MODES
    agent: Iiwa14D435  # pyright: ignore[reportIncompatibleVariableOverride]

    _takes_pictures: bool = False
    """Whether the task itself renders, whatever the observation."""

    def __init__(
        self,
        *args: Any,
        task: TaskConfig,
        robot_uids: str = "iiwa14_d435",
        plant: PlantSpec | Mapping[str, object] | str | None = None,
        plant_pose: PlantPose | Sequence[float] | None = None,
        plant_pose_noise: Sequence[float] = (0.0, 0.0, 0.0),
        motion: options.Motion = "kinematic",
        rays_per_side: int = 16,
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
        self.task = task
        self._choice = PlantSpec.parse(plant, task.plant)
        self._plant_pose = PlantPose.parse(plant_pose, task.plant_pose)
        self._plant_pose_noise = options.check_half_ranges("plant_pose_noise", plant_pose_noise, 3)
        self.motion = motion
        self._rays_per_side = rays_per_side
        self._has_ray_scene = False
        rendering = options.needs_rendering(obs_mode, render_mode) or self._takes_pictures
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

    def _load_scene(self, options: dict[str, Any]) -> None:
        scenery.build(self.scene)
        rngs: Any = self._batched_episode_rng
        seeds = [self._plant_seed(i, rngs[i], options) for i in range(self.num_envs)]
        self.planting = Planting(
            self.scene, self._choice, seeds, self.device, with_actors=not self._swaps_plants
        )
        if not self._has_ray_scene:
            self._has_ray_scene = True
            self._ray_scene = RayScene(
                self.planting.plants,
                self.camera_intrinsics,
                robot_meshes=link_meshes(),
                rays_per_side=self._rays_per_side,
                cached_plants=GROWN_PLANTS,
                device=self.device,
            )
            n, device = self.num_envs, self.device
            self._T_ee_camera = torch.tensor(
                T_flange_camera_color_optical, dtype=torch.float32, device=device
            )
            self._viewpoint = torch.zeros(n, 6, device=device)
            self._reach = torch.zeros(n, dtype=torch.int64, device=device)
            self._target = torch.zeros(n, dtype=torch.int64, device=device)
            self._make_tools()
        else:
            for i, plant in enumerate(self.planting.plants):
                self._ray_scene.replace_plant(i, plant)

    def _make_tools(self) -> None:
        """Makes what a task needs beside the ray-traced scene, once."""

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

    def _plant_seed(self, env_index: int, rng: np.random.RandomState, options: dict[str, Any]) -> int:
        """The seed of an environment's next plant; the first draw of its episode."""
        return self._choice.draw_seed(rng)

    def _place_plants(
        self,
        env_idx: Tensor,
        indices: list[int],
        rngs: list[np.random.RandomState],
        options: dict[str, Any],
    ) -> None:
        """New plants where every reset has one, and all of them at their drawn poses."""
        if self._choice.changes:
            # The same draw that a new scene was built with just before.
            for i, rng in zip(indices, rngs, strict=True):
                self._show_plant(i, self._plant_seed(i, rng, options))
        noise = np.array(self._plant_pose_noise)
        poses = [self._plant_pose.as_array() + noise * rng.uniform(-1.0, 1.0, 3) for rng in rngs]
        self._put_plants(env_idx, np.stack(poses))

    def _put_plants(self, env_idx: Tensor, poses: NDArray[np.float64]) -> None:
        x, y, yaw = torch.as_tensor(poses, dtype=torch.float32, device=self.device).unbind(-1)
        self.planting.place(env_idx, x, y, yaw)

    def _show_plant(self, env_index: int, seed: int) -> None:
        if self._swaps_plants and seed != self.planting.seeds[env_index]:
            self._ray_scene.replace_plant(env_index, self.planting.replace(env_index, seed))

    def _look_up_target(self) -> None:
        rows = torch.arange(self.num_envs, device=self.device)
        self._target_id = self.planting.fruit_segmentation_id[rows, self._target]
        self._target_position_w = self.planting.fruit_position_w(self._target)

    def _known_target_position(self) -> Tensor:
        """Where the robot believes its targets to be, in the world frame, in [m]. Shape (num_envs, 3)."""
        return self._target_position_w

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
            if isinstance(controller, LookAtController):
                controller.target_position = self._known_target_position()
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

    # ------------------------------------------------------------ observation

    def _get_obs_agent(self) -> dict[str, Tensor]:
        """Nothing in the state modes, whose observation is the task's own vector; joints beside pictures."""
        if self._obs_mode in ("state", "state_dict"):
            return {}
        return {"qpos": self.agent.robot.get_qpos(), "qvel": self.agent.robot.get_qvel()}

    def _flatten_raw_obs(self, obs: Any) -> Any:
        if self._obs_mode == "state":
            return torch.cat(tuple(obs["extra"].values()), dim=-1)
        return super()._flatten_raw_obs(obs)

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
        """ManiSkill's state and the task's own under `task`: viewpoint, reach, target, pose and seed of the
        plant, and what a task adds."""
        sim_state: Any = self.scene.get_sim_state()
        state: dict[str, Any] = dict(sim_state)
        state["task"] = self._task_state()
        return state

    def _task_state(self) -> dict[str, Tensor]:
        """The task's own state by name, each of shape (num_envs, D), float32."""
        return {
            "viewpoint": self._viewpoint.clone(),
            "reach": self._reach[:, None].float(),
            "target": self._target[:, None].float(),
            "plant_pose": torch.cat([self.planting.position_w[:, :2], self.planting.yaw[:, None]], dim=-1),
            "plant_seed": torch.tensor(self.planting.seeds, dtype=torch.float32, device=self.device)[:, None],
        }

    def _set_task_state(self, indices: Tensor, task: dict[str, Tensor]) -> None:
        """Takes back checked rows of `_task_state` for some environments, whose joints are set already."""
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
            for name in self._task_state()
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
        self._set_task_state(indices, task)

    def set_state(self, state: Any, env_idx: Tensor | None = None) -> None:
        """Takes back the flat vector that `get_state` gave. Shape (b, D)."""
        like: Any = self._init_raw_state
        self.set_state_dict(unflatten(torch.as_tensor(state, device=self.device), like), env_idx)
