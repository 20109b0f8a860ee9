"""ManiSkill's shell over a world: actors, cameras, lights, control modes, pictures, physics; no rule of any game."""

import copy
import inspect
from collections.abc import Mapping
from typing import Any, ClassVar, cast

import numpy as np
import sapien
import torch
from gymnasium.utils import seeding
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.sensors.camera import CameraConfig, parse_camera_configs, update_camera_configs_from_dict
from mani_skill.utils import sapien_utils
from mani_skill.utils.structs.types import SimConfig
from numpy.typing import NDArray
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError, RenderingUnavailableError
from maniskill_tomato.plants.episode_list import Episode
from maniskill_tomato.plants.organs import SemanticClass
from maniskill_tomato.robot.d435 import Calibration, CameraIntrinsics
from maniskill_tomato.sensing.belief import Belief
from maniskill_tomato.sensing.image_layout import ImageLayout
from maniskill_tomato.sensing.observation import ObservationLayout
from maniskill_tomato.sensing.simulated_camera import RENDERED_SIZE
from maniskill_tomato.tasks.arm_moves import CONTROL_MODES, Plan
from maniskill_tomato.tasks.ground_truth import WorldTruth
from maniskill_tomato.tasks.making import (
    check_choice,
    check_other_tasks,
    default_control,
    make_setup,
    option_names,
)
from maniskill_tomato.tasks.maniskill import scenery, shell_options
from maniskill_tomato.tasks.maniskill.flat_state import checked_rows, unflatten
from maniskill_tomato.tasks.maniskill.iiwa14_agent import Iiwa14D435
from maniskill_tomato.tasks.maniskill.motion import drive_to
from maniskill_tomato.tasks.numpy_streams import seed_some
from maniskill_tomato.tasks.plant_batch import PlantBatch
from maniskill_tomato.tasks.row.search_game import SearchGame
from maniskill_tomato.tasks.world import World, check_action

ROBOTS = ("iiwa14_d435", "iiwa14_d435_raw_depth")
"""The robots that can do the tasks."""


class TomatoEnv(BaseEnv):  # type: ignore[misc]
    """A task as a ManiSkill environment; `world` plays, this moves the arm and takes pictures.

    **Options** beside ManiSkill's own and those of the task (`tasks.making`):

    - `motion`: `"kinematic"` puts the joints at the solution, `"dynamic"` drives them there through physics.
    - `scenery`: `"plain"` is a bare room, `"greenhouse"` a row in a glasshouse with the robot on a cart, which is
      slower to render and for one environment; neither changes anything but pictures.
    - `render_backend`: `"auto"` renders on the GPU if there is one, else on the CPU, and not at all where no
      picture is asked for.
    """

    SUPPORTED_ROBOTS = list(ROBOTS)
    SUPPORTED_REWARD_MODES = shell_options.REWARD_MODES
    agent: Iiwa14D435  # pyright: ignore[reportIncompatibleVariableOverride]
    env_id: ClassVar[str]
    """The task."""
    world: World
    """The game: plants, arms, what is seen and known, reward."""

    def __init__(
        self,
        *args: Any,
        robot_uids: str = "iiwa14_d435",
        motion: shell_options.Motion = "kinematic",
        num_envs: int = 1,
        obs_mode: str | None = None,
        reward_mode: str | None = None,
        render_mode: str | None = None,
        control_mode: str | None = None,
        sim_backend: str = "auto",
        render_backend: str = "auto",
        scenery: shell_options.Scenery = "plain",
        reconfiguration_freq: int | None = None,
        **kwargs: Any,
    ) -> None:
        check_choice("robot_uids", robot_uids, ROBOTS)
        check_choice("reward_mode", reward_mode, shell_options.REWARD_MODES)
        check_choice("render_mode", render_mode, shell_options.RENDER_MODES)
        check_choice("control_mode", control_mode, Iiwa14D435.CONTROL_MODES)
        shell_options.check_obs_mode(obs_mode)
        shell_options.check_motion(motion)
        shell_options.check_num_envs(num_envs, sim_backend)
        shell_options.check_scenery(scenery, num_envs)
        names = option_names(self.env_id)
        options = {name: kwargs.pop(name) for name in list(kwargs) if name in names}
        check_other_tasks(self.env_id, kwargs)
        own = set(inspect.signature(TomatoEnv.__init__).parameters) | names
        shell_options.check_names(
            self.env_id, kwargs, own | set(inspect.signature(BaseEnv.__init__).parameters)
        )
        self._setup = setup = make_setup(self.env_id, **options)
        self.motion = motion
        if control_mode is None:
            control_mode = f"pd_{default_control(self.env_id)}"
        if setup.needs_pictures:
            if render_backend == "none":
                raise InvalidInputError(
                    f"perception={options['perception']!r} renders colours; leave render_backend='none' out, or use "
                    "'occlusion_model'"
                )
            width, height = RENDERED_SIZE
            kwargs.setdefault("sensor_configs", {"width": width, "height": height})
        if setup.calibration != "nominal":
            kwargs["sensor_configs"] = _with_calibration(kwargs.get("sensor_configs"), setup.calibration)
        rendering = shell_options.needs_rendering(obs_mode, render_mode) or setup.needs_pictures
        render_backend = shell_options.pick_render_backend(render_backend, rendering)
        self._renders = render_backend != "none"
        self._in_glasshouse = scenery == "greenhouse" and render_backend != "none"
        # A new plant to look at needs new actors, and so a new scene.
        self._has_actors = not setup.plant.changes or render_backend != "none"
        reconfiguration_freq = shell_options.pick_reconfiguration_freq(
            reconfiguration_freq,
            new_actors=self._has_actors and setup.plant.changes,
            follows_list=setup.follows_list,
        )
        try:
            super().__init__(
                *args,
                robot_uids=robot_uids,
                num_envs=num_envs,
                obs_mode=obs_mode,
                reward_mode=reward_mode,
                render_mode=render_mode,
                control_mode=control_mode,
                sim_backend=shell_options.pick_sim_backend(sim_backend, num_envs),
                render_backend=render_backend,
                reconfiguration_freq=reconfiguration_freq,
                **kwargs,
            )
        except RuntimeError as error:
            problem = shell_options.device_failure(error, rendering)
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
        if self._in_glasshouse:
            pose = sapien_utils.look_at(eye=[-0.85, -1.7, 0.72], target=[0.45, 0.1, 0.32])
        return CameraConfig("render_camera", pose=pose, width=640, height=480, fov=0.82, near=0.01, far=20.0)

    def _load_agent(self, options: dict[str, Any], *args: Any, **kwargs: Any) -> None:
        super()._load_agent(options, sapien.Pose())

    def _load_scene(self, options: dict[str, Any]) -> None:
        if not self._in_glasshouse:
            scenery.build(self.scene)
        if not hasattr(self, "world"):
            self.world = self._setup.build(
                self.num_envs,
                self.device,
                control=CONTROL_MODES.get(self.control_mode, default_control(self.env_id)),
                intrinsics=self.camera_intrinsics,
                pictures=self._wrist_pictures if self._renders else None,
            )
        world = self.world
        self._hand_over_generators()
        if self._has_actors and world.plant_batch.spec.changes:
            world.show_plants({i: world.game.draw_plant(i, rng, options) for i, rng in enumerate(world.rngs)})
        world.swaps_plants = not self._has_actors
        self._plants = scenery.PlantScene(self.scene, world.plant_batch, with_actors=self._has_actors)
        if self._in_glasshouse:
            self._glasshouse = scenery.GlasshouseScene(self.scene, world.plant_batch)
        world.first_organ_id = torch.tensor(
            self._plants.first_organ_id, dtype=torch.int32, device=self.device
        )

    def _load_lighting(self, options: dict[str, Any]) -> None:
        if self._in_glasshouse:
            self._glasshouse.light()
        else:
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

    def _wrist_pictures(self, qpos: Tensor) -> NDArray[np.uint8]:
        """What the wrists' colour cameras see with the arms at some joint positions, rendered once for all.

        Args:
            qpos: In [rad]. Shape (num_envs, 7).

        Returns:
            Shape (num_envs, height, width, 3).
        """
        self._show_plants()
        if not torch.equal(self.agent.robot.get_qpos(), qpos):
            self._put_joints(qpos)
        self.scene.update_render(update_sensors=True, update_human_render_cameras=False)
        camera = self.scene.sensors["d435"]
        camera.capture()
        colours = camera.get_obs(rgb=True, depth=False, position=False, segmentation=False)["rgb"]
        return np.asarray(colours.cpu().numpy())

    # ---------------------------------------------------------------- episode

    def reset(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """ManiSkill's reset; `env_idx` among the options may also be a list, and the seed goes to `np_random` too."""
        if seed is not None:
            first = int(np.atleast_1d(np.asarray(seed))[0])
            self._np_random, self._np_random_seed = seeding.np_random(first)
        if options is not None and "env_idx" in options:
            rows = self.world.env_rows(options["env_idx"])
            due = self.reconfiguration_freq != 0 and self._reconfig_counter == 0
            shell_options.check_partial_reset(
                len(rows), self.num_envs, builds_anew=due or bool(options.get("reconfigure"))
            )
            options = {**options, "env_idx": rows}
            if seed is not None and len(rows) < self.num_envs:
                # ManiSkill would drop the generators of the others.
                generators: Any = self._batched_episode_rng
                seed_some(generators.rngs, self._episode_seed, rows.tolist(), seed)
                seed = None
        result: tuple[Any, dict[str, Any]] = super().reset(seed=seed, options=options)
        return result

    def _hand_over_generators(self) -> None:
        generators: Any = self._batched_episode_rng
        self.world.rngs = list(generators.rngs)
        self.world.seeds = [int(seed) for seed in self._episode_seed]

    def _initialize_episode(self, env_idx: Tensor, options: dict[str, Any]) -> None:
        self._hand_over_generators()
        self.world.begin(env_idx, options)
        self._show_world()

    def _show_plants(self) -> None:
        self._plants.follow()
        if self._in_glasshouse:
            self._glasshouse.follow()

    def _show_world(self) -> None:
        """Puts plants and arms where they are in the world."""
        self._show_plants()
        self._put_joints(self.world.state.qpos)

    # ------------------------------------------------------------------- step

    def _step_action(self, action: Any) -> Tensor | None:
        if action is None:
            return None
        space: Any = self._orig_single_action_space
        batch = check_action(action, self.num_envs, space.shape[0], self.device)
        if self.control_mode in CONTROL_MODES:
            self.world.step(batch, self._move)
            return batch
        if self.motion == "kinematic":
            self.agent.set_action(batch)
            lower, upper = self.agent.robot.get_qlimits().unbind(-1)
            self._put_joints(self.agent.robot.get_drive_targets().clamp(lower, upper))
        else:
            super()._step_action(batch)
        self.world.arrive(self.agent.robot.get_qpos().clone(), self._move)
        return batch

    def _move(self, plan: Plan) -> Tensor:
        """Moves the arms and returns where they are. Shape (num_envs, 7)."""
        if not plan.moves_arms:
            return self.world.state.qpos
        if self.motion == "kinematic":
            self._put_joints(plan.target_qpos)
            return plan.target_qpos
        for goal in _stages(plan):
            drive_to(self.scene, self.agent, goal)
        qpos: Tensor = self.agent.robot.get_qpos().clone()
        return qpos

    def _put_joints(self, qpos: Tensor) -> None:
        robot = self.agent.robot
        if not self.gpu_sim_enabled:
            robot.set_qpos(qpos)
            return
        gpu_system: Any = self.scene.px
        with scenery.writing_only_to(self.scene, None):
            robot.set_qpos(qpos)
            self.scene._gpu_apply_all()
            gpu_system.gpu_update_articulation_kinematics()
            self.scene._gpu_fetch_all()

    # ---------------------------------------------------------------- outcome

    def evaluate(self) -> dict[str, Tensor]:
        """What came of the last move."""
        info = self.world.info()
        if "other_reward" in info:
            judged = {"success": info["other_success"], "fail": info["fail"][:, None]}
            info["other_reward"] = self._reward_in_mode(info["other_reward"], judged)
        return info

    def compute_dense_reward(self, obs: Any, action: Tensor, info: dict[str, Tensor]) -> Tensor:
        """The task's reward. Shape (num_envs,)."""
        return self.world.reward(info)

    def compute_normalized_dense_reward(self, obs: Any, action: Tensor, info: dict[str, Tensor]) -> Tensor:
        """The reward over its largest value. Shape (num_envs,)."""
        return self.world.reward(info) / float(self.task.largest_reward)

    def _reward_in_mode(self, dense: Tensor, info: Mapping[str, Tensor]) -> Tensor:
        if self._reward_mode == "dense":
            return dense
        if self._reward_mode == "normalized_dense":
            return dense / float(self.task.largest_reward)
        if self._reward_mode == "sparse":
            return info["success"].float() - info["fail"].float()
        return torch.zeros_like(dense)

    def _get_obs_agent(self) -> dict[str, Tensor]:
        """Nothing in the state modes, whose observation is the task's own vector; joints beside pictures."""
        if self._obs_mode in ("state", "state_dict"):
            return {}
        return {"qpos": self.agent.robot.get_qpos(), "qvel": self.agent.robot.get_qvel()}

    def _get_obs_extra(self, info: dict[str, Tensor]) -> dict[str, Tensor]:
        return self.world.game.observation()

    def _flatten_raw_obs(self, obs: Any) -> Any:
        if self._obs_mode == "state":
            return torch.cat(tuple(obs["extra"].values()), dim=-1)
        return super()._flatten_raw_obs(obs)

    def semantic_classes(self, env_index: int = 0) -> dict[int, SemanticClass]:
        """The semantic class of every segmentation id of an environment; ids that are missing are
        background."""
        links = self.agent.robot.get_links()
        robot = {int(link._objs[env_index].entity.per_scene_id): SemanticClass.ROBOT for link in links}
        return robot | self._plants.semantic_classes(env_index)

    # ------------------------------------------------------- what the world tells

    @property
    def task(self) -> Any:
        """The task's configuration."""
        return self.world.task

    @property
    def plant_batch(self) -> PlantBatch:
        """The plants."""
        return self.world.plant_batch

    @property
    def ground_truth(self) -> WorldTruth:
        """What only the simulator knows; for planners that need the truth."""
        return self.world.ground_truth

    @property
    def keeps_belief(self) -> bool:
        """Whether there is a `belief`; the general tasks alone have one."""
        return self.world.keeps_belief

    @property
    def belief(self) -> Belief:
        """What is known after the last look, for policies; see `World.belief`."""
        return self.world.belief

    def images(self, layout: ImageLayout) -> dict[str, Tensor]:
        """What the wrist cameras show; see `World.images`."""
        return self.world.images(layout)

    @property
    def qpos(self) -> Tensor:
        """Joint positions, in [rad]. Shape (num_envs, 7)."""
        return self.world.qpos

    @property
    def target_fruit(self) -> Tensor:
        """Index of the target in `Plant.fruits`. Shape (num_envs,)."""
        return self.world.target_fruit

    @property
    def target_position_w(self) -> Tensor:
        """Centre of the target fruit in the world frame, in [m]. Shape (num_envs, 3)."""
        return self.world.target_position_w.clone()

    # ------------------------------------------------------------------ state

    def get_state_dict(self) -> dict[str, Any]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """ManiSkill's state and the world's under `task`; see `World.saved_rows`."""
        sim_state: Any = self.scene.get_sim_state()
        return {**sim_state, "task": self.world.saved_rows()}

    def set_state_dict(self, state: dict[str, Any], env_idx: Tensor | None = None) -> None:
        """Takes back what `get_state_dict` gave.

        Raises:
            InvalidInputError: The state belongs to another plant, lacks something or is not finite; nothing was
                changed.
        """
        world, robot = self.world, self.agent.robot
        rows = world.env_rows(env_idx)
        task = {
            name: checked_rows(state, ("task", name), len(rows), self.device) for name in world.saved_rows()
        }
        arm = checked_rows(state, ("articulations", robot.name), len(rows), self.device)
        seeds = [world.plant_batch.seeds[i] for i in rows.tolist()]
        stored = [int(s) for s in task["plant_seed"][:, 0]]
        if stored != seeds:
            raise InvalidInputError(
                f"the state belongs to plants of seed {stored}, but this environment holds {seeds}; "
                "make it with plant={'seed': ...} or reset it with the seed of that episode"
            )
        # The base never moves, and to set its pose again would shift it by rounding.
        dof = robot.max_dof
        qpos, qvel = arm[:, -2 * dof : -dof].float(), arm[:, -dof:].float()
        with scenery.writing_only_to(self.scene, rows):
            robot.set_qvel(qvel)
        world.take_up(rows, task, qpos)
        self._show_world()

    def set_state(self, state: Any, env_idx: Tensor | None = None) -> None:
        """Takes back the flat vector that `get_state` gave. Shape (b, D)."""
        like: Any = self._init_raw_state
        self.set_state_dict(unflatten(torch.as_tensor(state, device=self.device), like), env_idx)

    def restore_world(self, saved: Mapping[str, Any], qvel: Tensor) -> None:
        """Takes back what `World.save` gave, in a scene that holds its plants.

        Args:
            saved: The world's state.
            qvel: Speeds of the joints, in [rad/s]. Shape (num_envs, 7).
        """
        self.world.restore(saved)
        self.agent.robot.set_qvel(qvel.to(self.device))
        self._show_world()


class SearchEnv(TomatoEnv):
    """What the shell of the general tasks tells beside."""

    @property
    def soft_starts(self) -> int:
        """Episodes so far that no drawn start made as hard as asked for."""
        return self._game.soft_starts

    @property
    def layout(self) -> ObservationLayout:
        """What the observation holds."""
        return self._game.layout

    @property
    def _game(self) -> SearchGame:
        return cast(SearchGame, self.world.game)

    def episode(self, env_index: int, options: Mapping[str, Any]) -> Episode | None:
        """The episode of the list that a reset with these options begins; None without a list."""
        return self._game.episode(env_index, options)


class RowEnv(SearchEnv):
    """What the shell of the row tells beside."""

    @property
    def targets_begun(self) -> Tensor:
        """How many targets each row has had so far. Shape (num_envs,)."""
        return self.world.targets_begun

    @property
    def inspecting(self) -> Any:
        """What knows the inspection lists of rows that are inspected with a camera; there is none otherwise."""
        return self.world.inspecting

    def open_targets(self, env_index: int = 0) -> list[int]:
        """The fruits of a row that are yet to be looked for, as indices in `Plant.fruits`."""
        return self.world.open_targets(env_index)

    def fruit_position_w(self, env_index: int, fruit: int) -> Tensor:
        """Centre of a fruit in the world frame, in [m]. Shape (3,)."""
        return self.world.fruit_position_w(env_index, fruit)


def _stages(plan: Plan) -> list[Tensor]:
    """Joint positions that a plan leads the arms through, one after the other; each of shape (num_envs, 7)."""
    ways = {i: way.waypoints[1:].to(plan.target_qpos) for i, way in plan.transits.items()}
    stages = []
    for k in range(max((len(way) for way in ways.values()), default=1)):
        goal = plan.target_qpos.clone()
        for i, way in ways.items():
            goal[i] = way[min(k, len(way) - 1)]
        stages.append(goal)
    return stages


def _with_calibration(sensor_configs: Mapping[str, Any] | None, calibration: Calibration) -> dict[str, Any]:
    """ManiSkill's `sensor_configs` with the task's calibration of the colour camera, unless the user gave one."""
    given = dict(sensor_configs or {})
    if "calibration" not in given:
        given["d435"] = {"calibration": calibration, **given.get("d435", {})}
    return given
