"""A task as a plain Gymnasium environment of NumPy arrays, for learners from outside this package."""

from collections.abc import Sequence
from typing import Any, Literal, SupportsFloat

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.learning.rl.envs import make_simulated_env
from maniskill_tomato.learning.rl.presets import OBSERVATION_CENTRE, OBSERVATION_HALF_RANGE, get_preset
from maniskill_tomato.learning.rl.rewards import potential_reward

Array = NDArray[np.float32]
ArrayEnv = gym.Env[Array, Array]

CENTRE: Array = np.array(OBSERVATION_CENTRE, dtype=np.float32)
HALF_RANGE: Array = np.array(OBSERVATION_HALF_RANGE, dtype=np.float32)

_TD3 = get_preset("td3")


class LearnableTask(gym.Wrapper[Array, Array, Array, Array]):
    """A task with normalised observations, actions in [-1, 1] and a choice of reward; by default all as in the
    `td3` preset.

    `info["task_reward"]` keeps the task's own reward. The time limit truncates and never terminates, so that a
    learner which bootstraps truncated episodes does it right.
    """

    def __init__(
        self,
        env: ArrayEnv,
        *,
        action_scale: Sequence[float] = _TD3.action_scale,
        reward: Literal["task", "potential"] = "potential",
        gamma: float = _TD3.gamma,
        step_cost: float = _TD3.step_cost,
    ) -> None:
        """Wraps `env`.

        Args:
            env: One environment with arrays of shape (D,) and (A,), such as ManiSkill's CPUGymWrapper makes.
            action_scale: The action that 1 stands for, in the task's units. Shape (A,).
            reward: The task's, or success with V_f as a potential (`learning.rl.rewards.potential_reward`).
            gamma: Discount factor of the learner; only the potential reward uses it.
            step_cost: What each step costs with the potential reward.

        Raises:
            InvalidInputError: The action scale has another length or values outside (0, 1], or the reward is
                unknown.
        """
        super().__init__(env)
        if env.action_space.shape != (len(action_scale),) or not all(0.0 < s <= 1.0 for s in action_scale):
            raise InvalidInputError(
                f"action_scale must hold one value in (0, 1] for each action of {env.action_space}, "
                f"got {tuple(action_scale)}"
            )
        if reward not in ("task", "potential"):
            raise InvalidInputError.choice("reward", reward, ("task", "potential"))
        self.action_space = gym.spaces.Box(-1.0, 1.0, (len(action_scale),), np.float32)
        self._scale = np.array(action_scale, dtype=np.float32)
        self._reward = reward
        self._gamma = gamma
        self._step_cost = step_cost
        self._visible_fraction = 0.0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        observation, info = self.env.reset(seed=seed, options=options)
        self._visible_fraction = float(info["visible_fraction"])
        return normalize_observation(observation), {**info, "task_reward": 0.0}

    def step(self, action: Array) -> tuple[Array, SupportsFloat, bool, bool, dict[str, Any]]:
        scaled = np.clip(action, -1.0, 1.0, dtype=np.float32) * self._scale
        observation, reward, terminated, truncated, info = self.env.step(scaled)
        learned = task_reward = float(reward)
        if self._reward == "potential":
            learned = self._potential_reward(terminated, info)
        self._visible_fraction = float(info["visible_fraction"])
        info = {**info, "task_reward": task_reward}
        return normalize_observation(observation), learned, terminated, truncated, info

    def _potential_reward(self, terminated: bool, info: dict[str, Any]) -> float:
        return float(
            potential_reward(
                torch.tensor(info["visible_fraction"]),
                torch.tensor(self._visible_fraction),
                torch.tensor(info["success"]),
                torch.tensor(terminated),
                torch.tensor(info["reward_penalty"]),
                gamma=self._gamma,
                step_cost=self._step_cost,
            )
        )


def normalize_observation(observation: Array) -> Array:
    """The thesis's nine numbers in the fixed ranges of the `td3` preset, about -1 to 1; others as they are.

    The general tasks' observation is scaled already. Shape (..., D), as given.
    """
    if observation.shape[-1] != len(CENTRE):
        return observation
    normalized: Array = (observation - CENTRE) / HALF_RANGE
    return normalized


def make_gymnasium_env(
    env_id: str,
    *,
    action_scale: Sequence[float] = _TD3.action_scale,
    reward: Literal["task", "potential"] = "potential",
    gamma: float = _TD3.gamma,
    step_cost: float = _TD3.step_cost,
    **options: Any,
) -> LearnableTask:
    """One environment of a task for an outside learner: `LearnableTask` over ManiSkill's CPUGymWrapper.

    Args:
        env_id: Id of the task.
        action_scale: See `LearnableTask`, as for the next three.
        reward: Which reward to learn from.
        gamma: Discount factor of the learner.
        step_cost: What each step costs with the potential reward.
        options: For `gymnasium.make`, for instance `plant=`.

    Raises:
        InvalidInputError: The id or an option is not allowed.
    """
    # ManiSkill takes seconds to import; who only imports this module need not wait for it.
    from mani_skill.utils.wrappers.gymnasium import CPUGymWrapper

    env = CPUGymWrapper(make_simulated_env(env_id, **options))
    return LearnableTask(env, action_scale=action_scale, reward=reward, gamma=gamma, step_cost=step_cost)
