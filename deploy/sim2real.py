"""ManiSkill's `Sim2RealEnv` for the viewpoint tasks: the observation comes from the arm and the camera, not from the
simulation.

What the base class would do wrong here, and what is done instead:

- State observations would be the simulated robot's: they are made from the measured joints and the picture.
- Kinematic tasks set no drive targets: the goal is the world's plan.
- The picture would be cropped to a square and depth lose an axis: the agent delivers what the simulation has.
- A dense reward would raise, `evaluate`'s numbers be missing: both are computed from what the camera sees.
- A reset would wait for the enter key and send the arm to a simulated start: the arm stays where it is.
- A step would be timed: it takes as long as the move.
"""

import logging
from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.envs.sim2real_env import Sim2RealEnv
from torch import Tensor

from maniskill_tomato.deploy.deploy_errors import PerceptionError, ProfileError, RefusedError
from maniskill_tomato.deploy.interface import Float64
from maniskill_tomato.deploy.real_agent import IiwaRealAgent
from maniskill_tomato.deploy.robot_perception import RobotBelief, Sighting
from maniskill_tomato.robot.inverse_kinematics import Reach
from maniskill_tomato.robot.viewpoint_move import viewpoint_of
from maniskill_tomato.tasks.arm_moves import ACTION_SIZES, CONTROL_MODES
from maniskill_tomato.tasks.row.row_config import GeneralTaskConfig
from maniskill_tomato.tasks.world import World, check_action

logger = logging.getLogger(__name__)


class TomatoSim2RealEnv(Sim2RealEnv):  # type: ignore[misc]
    """A viewpoint task on hardware, with the spaces and wrappers of its simulation.

    Info, each of shape (1,): `visible_fraction`, `visible_fraction_gain`, `success`, `fail`, `target_seen`,
    `tomato_seen`, `reachability`, `refused` (safety held the move back, and the arm stands where it did). What only a
    simulator knows, such as contact with the plant, is not told.
    """

    agent: IiwaRealAgent

    def __init__(
        self, sim_env: gym.Env[Any, Any], agent: IiwaRealAgent, skip_data_checks: bool = False
    ) -> None:
        """Takes a started agent.

        Args:
            sim_env: The simulation of the task, `num_envs=1`, on the CPU, with `pd_viewpoint` or `pd_look_at`.
            agent: Started.
            skip_data_checks: Do not compare an observation of both when beginning.

        Raises:
            ProfileError: The simulation has another control mode.
            DeployError: A device fails.
        """
        base: Any = sim_env.unwrapped
        if base.control_mode not in CONTROL_MODES:
            raise ProfileError(
                f"control_mode must be {' or '.join(CONTROL_MODES)} on hardware, got {base.control_mode!r}"
            )
        self._robot_belief: RobotBelief | None = None
        self._view: Sighting | None = None
        self._fraction_before = 0.0
        self._refused = False
        self._moves = 0
        reset: Any = _reset_without_moving
        super().__init__(
            sim_env,
            agent,
            real_reset_function=reset,
            sensor_data_preprocessing_function=_as_it_is,
            skip_data_checks=skip_data_checks,
        )

    @property
    def target_position(self) -> Float64:
        """Where the target is, world frame, in [m]. Shape (3,).

        Raises:
            PerceptionError: Before the first reset.
        """
        if self._view is None:
            raise PerceptionError("no target is known before reset()")
        return self._view.target_position

    def begin(self) -> None:
        """Looks for the target and begins an episode from where the arm stands.

        Raises:
            PerceptionError: No ripe fruit is in the picture.
            DeployError: A device fails.
        """
        workcell = self.agent.workcell
        workcell.perception.begin(workcell.target_position())
        self._moves, self._refused, self._fraction_before = 0, False, 0.0
        self._viewpoint: Tensor = self._world.state.viewpoint.clone()
        layout = getattr(self.base_sim_env, "layout", None)
        if layout is not None:
            self._robot_belief = RobotBelief(
                workcell.profile.T_flange_camera, self._max_moves, layout, workcell.arm.model
            )
        self._reach = torch.full((1,), int(Reach.REACHABLE), dtype=torch.int64)
        self._take_view()
        assert self._view is not None
        self._fraction_before = self._view.visible_fraction

    @property
    def _max_moves(self) -> int:
        base: Any = self.base_sim_env
        return int(base.task.max_moves)

    def _step_action(self, action: Any) -> Any:
        if action is None:
            return None
        moves = self._world.moves
        batch = check_action(action, 1, ACTION_SIZES[moves.control], self._world.device)
        qpos = self._follow_the_arm()
        plan = moves.plan(qpos, self._viewpoint, self._target_tensor(), batch)
        self._reach = plan.reach.clone()
        self._moves += 1
        assert self._view is not None
        self._fraction_before = self._view.visible_fraction
        self._refused = False
        try:
            self.agent.set_target_qpos(plan.target_qpos)
            self._viewpoint = plan.viewpoint
        except RefusedError as error:
            self._refused = True
            logger.warning("the arm stays: %s", error)
        self._take_view()
        return batch

    def get_info(self) -> dict[str, Any]:
        """What the camera sees from where the arm stands."""
        view = self._view
        if view is None:
            return {"elapsed_steps": self._elapsed_steps}
        base: Any = self.base_sim_env
        fraction = torch.tensor([view.visible_fraction])
        seen, any_seen = torch.tensor([view.target_seen]), torch.tensor([view.fruits_seen > 0])
        unreachable = self._reach == int(Reach.UNREACHABLE)
        fail = unreachable & (getattr(base.task, "outside_workspace", "") == "end")
        info: dict[str, Any] = {
            "elapsed_steps": self._elapsed_steps,
            "visible_fraction": fraction,
            "visible_fraction_gain": fraction - self._fraction_before,
            "success": (torch.tensor([view.sure_fraction]) > base.task.full_visibility) & ~fail,
            "fail": fail,
            "target_seen": seen,
            "tomato_seen": any_seen,
            "reachability": self._reach.clone(),
            "refused": torch.tensor([self._refused]),
        }
        if hasattr(base.task, "visual_reward"):
            forbidden = torch.zeros(1, dtype=torch.bool)  # Safety lets no move end there.
            info["reward_visual"] = base.task.visual_reward(fraction, seen, any_seen, self._reach)
            info["reward_penalty"] = base.task.pose_penalty(self._reach, forbidden)
        return info

    def compute_dense_reward(self, obs: Any, action: Tensor, info: Mapping[str, Tensor]) -> Tensor:
        """The task's reward of what the camera sees, without contact. Shape (1,)."""
        task = self._world.task
        if not isinstance(task, GeneralTaskConfig):
            reward: Tensor = task.reward(info["reward_visual"], info["reward_penalty"])
            return reward
        fraction, success = info["visible_fraction"], info["success"]
        before = torch.full_like(fraction, self._fraction_before)
        return task.reward(fraction, before, success, torch.zeros_like(success))

    def compute_normalized_dense_reward(self, obs: Any, action: Tensor, info: Mapping[str, Tensor]) -> Tensor:
        """The reward over its largest value. Shape (1,)."""
        return self.compute_dense_reward(obs, action, info) / float(self._world.task.largest_reward)

    def _get_obs_state_dict(self, info: Mapping[str, Any]) -> dict[str, Any]:
        return {"agent": self._get_obs_agent(), "extra": self._get_obs_extra(info)}

    def _get_obs_extra(self, info: Mapping[str, Any]) -> dict[str, Tensor]:
        base: Any = self.base_sim_env
        if self._robot_belief is not None:
            vector = self._vector
            return {name: vector[:, part].clone() for name, part in base.layout.slices.items()}
        return {
            "ee_position": self._viewpoint[:, :3].clone(),
            "ee_rpy": self._viewpoint[:, 3:].clone(),
            "target_position": self._target_tensor(),
        }

    def _flatten_raw_obs(self, obs: Any) -> Any:
        if self._obs_mode == "state":
            return torch.cat(tuple(obs["extra"].values()), dim=-1)
        base: Any = BaseEnv
        return base._flatten_raw_obs(self, obs)

    def _take_view(self) -> None:
        """Looks, once for every place where the arm stands."""
        frame, joints = self.agent.look()
        view = self.agent.workcell.perception.look(frame, self.agent.camera_pose(joints))
        if view is None:
            raise PerceptionError("the first picture shows no ripe fruit; start where one is in view")
        self._view = view
        self._follow_the_arm()
        if self._robot_belief is not None:
            left = max(0, self._max_moves - self._moves)
            self._vector = self._robot_belief.observe(joints, view, left).observation

    def _follow_the_arm(self) -> Tensor:
        """Puts the simulated arm where the real one stands; returns the joint positions. Shape (1, 7)."""
        base: Any = self.base_sim_env
        _, joints = self.agent.look()
        qpos = torch.as_tensor(np.array(joints), dtype=torch.float32)[None]
        base.agent.robot.set_qpos(qpos)
        self._viewpoint = viewpoint_of(qpos, self._viewpoint[:, 3:])
        return qpos

    @property
    def _world(self) -> World:
        base: Any = self.base_sim_env
        world: World = base.world
        return world

    def _target_tensor(self) -> Tensor:
        return torch.as_tensor(self.target_position, dtype=torch.float32)[None]


def _reset_without_moving(env: TomatoSim2RealEnv, seed: int | None = None, options: Any = None) -> None:
    """A new episode of the simulation for its bookkeeping; the arm stays, and the target is looked for."""
    env.sim_env.reset(seed=seed, options=options)
    env._elapsed_steps[:] = 0
    env.begin()


def _as_it_is(data: dict[str, Any]) -> dict[str, Any]:
    return data
