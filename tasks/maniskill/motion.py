"""Driving the arm to a joint position through physics: a minimum-jerk path within the velocity limits, then
settling."""

import math
from typing import Any

import torch
from mani_skill.agents.base_agent import BaseAgent
from mani_skill.agents.controllers.base_controller import BaseController
from mani_skill.envs.scene import ManiSkillScene
from torch import Tensor

from maniskill_tomato.robot.iiwa14 import VELOCITY_LIMITS

PEAK_TO_MEAN_SPEED = 1.875
"""Of a minimum-jerk profile 10 s^3 - 15 s^4 + 6 s^5, whose largest slope is 15/8."""

SPEED_FRACTION = 0.5
"""Share of the joint velocity limits that a move uses at its peak."""

SETTLED_SPEED = 1e-3
"""A joint slower than this has settled, in [rad/s]."""

MAX_SETTLING_TIME = 1.0
"""Longest wait for that, in [s]."""


def move_duration(start_qpos: Tensor, target_qpos: Tensor) -> float:
    """How long the slowest of the moves takes, in [s].

    Args:
        start_qpos: Joint positions, in [rad]. Shape (num_envs, 7).
        target_qpos: Likewise. Shape (num_envs, 7).
    """
    limits = torch.tensor(VELOCITY_LIMITS, dtype=start_qpos.dtype, device=start_qpos.device)
    shares = (target_qpos - start_qpos).abs() / (SPEED_FRACTION * limits)
    return PEAK_TO_MEAN_SPEED * float(shares.max())


def drive_to(scene: ManiSkillScene, agent: BaseAgent, target_qpos: Tensor) -> None:
    """Moves all environments' arms and returns when they stand still.

    Args:
        scene: The scene, whose physics is stepped.
        agent: The arm, with its joint drives set up.
        target_qpos: Joint positions, in [rad]. Shape (num_envs, 7).
    """
    controller = agent.controller
    start_qpos = agent.robot.get_qpos().clone()
    steps = max(1, math.ceil(move_duration(start_qpos, target_qpos) / scene.timestep))
    for k in range(1, steps + 1):
        s = k / steps
        blend = s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
        _step(scene, agent, controller, torch.lerp(start_qpos, target_qpos, blend))
    for _ in range(math.ceil(MAX_SETTLING_TIME / scene.timestep)):
        _step(scene, agent, controller, target_qpos)
        if scene.gpu_sim_enabled:
            scene._gpu_fetch_all()
        if float(agent.robot.get_qvel().abs().max()) < SETTLED_SPEED:
            break


def _step(scene: ManiSkillScene, agent: BaseAgent, controller: BaseController, targets: Tensor) -> None:
    agent.robot.set_joint_drive_targets(targets, controller.joints, controller.active_joint_indices)
    if scene.gpu_sim_enabled:
        gpu_system: Any = scene.px
        gpu_system.gpu_apply_articulation_target_position()
    scene.step()
