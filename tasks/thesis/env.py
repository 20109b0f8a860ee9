"""The viewpoint tasks: move the wrist camera to where a tomato hidden by leaves is fully visible."""

from dataclasses import replace
from typing import Any

import torch
from mani_skill.utils.registration import register
from torch import Tensor

from maniskill_tomato.robot.inverse_kinematics import Reach
from maniskill_tomato.robot.kinematics import link_transforms
from maniskill_tomato.tasks import MAX_EPISODE_STEPS, options
from maniskill_tomato.tasks.maniskill.planting import ripe_fruit_at_random
from maniskill_tomato.tasks.maniskill.tomato_env import TomatoEnv
from maniskill_tomato.tasks.maniskill.viewpoint_controller import ViewpointController
from maniskill_tomato.tasks.row.other_targets import other_ripe_fruits
from maniskill_tomato.tasks.thesis.config import ViewpointTaskConfig, guided_task, sparse_task
from maniskill_tomato.tasks.thesis.rewards import in_forbidden_zone
from maniskill_tomato.tasks.thesis.starts import Starts


class TomatoViewpointEnv(TomatoEnv):
    """One environment class for all viewpoint tasks; a `ViewpointTaskConfig` tells them apart.

    **Options** beside ManiSkill's own:

    - `plant`: a preset's name or a mapping of `PlantSpec` fields, e.g. `{"preset": "full", "seed":
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

    task: ViewpointTaskConfig

    def __init__(self, *args: Any, task: ViewpointTaskConfig, other_targets: int = 0, **kwargs: Any) -> None:
        options.check_other_targets(other_targets)
        self._other_targets = other_targets
        super().__init__(*args, task=task, **kwargs)

    def _load_agent(self, options: dict[str, Any], *args: Any, **kwargs: Any) -> None:
        super()._load_agent(options, *args, **kwargs)
        controller = self.agent.controller
        if isinstance(controller, ViewpointController):
            controller.config = replace(
                controller.config,
                neighbour_poses=self.task.neighbour_poses,
                outside_workspace="home" if self.task.outside_workspace == "home" else "stay",
                drive_joints=False,
            )

    def _make_tools(self) -> None:
        self._starts = Starts(self.task, self.device)

    def _initialize_episode(self, env_idx: Tensor, options: dict[str, Any]) -> None:
        indices = [int(i) for i in env_idx]
        episode_rngs: Any = self._batched_episode_rng
        rngs = [episode_rngs[i] for i in indices]
        self._place_plants(env_idx, indices, rngs, options)
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

    def _look_up_target(self) -> None:
        super()._look_up_target()
        if self._other_targets:
            self._others, self._others_exist = other_ripe_fruits(
                self.planting, self._target, self._other_targets
            )

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
        seen = self._ray_scene.visibility(
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

    def _get_obs_extra(self, info: dict[str, Tensor]) -> dict[str, Tensor]:
        return {
            "ee_position": self._viewpoint[:, :3].clone(),
            "ee_rpy": self._viewpoint[:, 3:].clone(),
            "target_position": self.target_position_w,
        }


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
