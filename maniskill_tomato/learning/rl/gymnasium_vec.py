"""A task as a Gymnasium vector environment for learners from outside this package, prepared as `LearnableTask` is."""

from collections.abc import Sequence
from typing import Any, Literal

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.learning.rl.gymnasium_env import check_learnable, normalize_observation
from maniskill_tomato.learning.rl.presets import default_preset, get_preset
from maniskill_tomato.learning.rl.rewards import potential_reward
from maniskill_tomato.task_registry import find_task
from maniskill_tomato.tasks.vector_env import VectorEnv, make_vector_env

_TD3 = get_preset("td3")


class LearnableVector(gym.vector.VectorWrapper[Any, Any, Any, Any, NDArray[Any]]):
    """Tasks with normalised observations, actions in [-1, 1] and a choice of reward, whatever their way to reset.

    `info["task_reward"]` keeps the tasks' own reward.
    """

    def __init__(
        self,
        env: VectorEnv,
        *,
        action_scale: Sequence[float],
        reward: Literal["task", "potential"],
        gamma: float = _TD3.gamma,
        step_cost: float = _TD3.step_cost,
    ) -> None:
        """Wraps `env`; the arguments are those of `LearnableTask`.

        Raises:
            InvalidInputError: The action scale has another length or values outside (0, 1], the reward is unknown, or
                `env` gives tensors.
        """
        if env.arrays != "numpy":
            raise InvalidInputError(
                f"LearnableVector takes an environment of arrays='numpy'; got {env.arrays!r}"
            )
        check_learnable(env.single_action_space, action_scale, reward)
        super().__init__(env)
        self._scale = np.array(action_scale, dtype=np.float32)
        self._reward, self._gamma, self._step_cost = reward, gamma, step_cost
        self._visible_fraction: NDArray[np.float32] = np.zeros(env.num_envs, dtype=np.float32)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begins episodes; see `VectorEnv.reset`."""
        observations, info = self.env.reset(seed=seed, options=options)
        if self._reward == "potential" and "reward_penalty" not in info:
            raise InvalidInputError(
                "the potential reward is for the thesis's tasks, and this task tells no reward_penalty; use "
                "reward='task', which is a potential already"
            )
        self._visible_fraction = info["visible_fraction"]
        return normalize_observation(observations), _with_reward(info, np.zeros_like(self._visible_fraction))

    def step(self, actions: NDArray[Any]) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Makes a move in every environment. Shape (N, A)."""
        scaled = np.clip(actions, -1.0, 1.0, dtype=np.float32) * self._scale
        observations, task_reward, terminated, truncated, info = self.env.step(scaled)
        reward = task_reward
        if self._reward == "potential":
            reward = self._potential_reward(terminated, info)
        self._visible_fraction = info["visible_fraction"]
        if "final_obs" in info:
            info["final_info"] = _with_reward(info["final_info"], task_reward)
            for i in np.flatnonzero(info["_final_obs"]):
                info["final_obs"][i] = normalize_observation(info["final_obs"][i])
            task_reward = np.where(
                info["_final_obs"], np.float32(0.0), task_reward
            )  # Of the episodes just begun.
        observations = normalize_observation(observations)
        return observations, reward, terminated, truncated, _with_reward(info, task_reward)

    def _potential_reward(self, terminated: NDArray[np.bool_], info: dict[str, Any]) -> NDArray[Any]:
        """Shape (N,); 0 where a step only began an episode."""
        told = {name: info[name] for name in ("visible_fraction", "success", "reward_penalty")}
        if "final_info" in info:
            ended = info["_final_info"]
            told = {name: np.where(ended, info["final_info"][name], value) for name, value in told.items()}
        fraction, success, penalty = (torch.from_numpy(np.asarray(value)) for value in told.values())
        reward = potential_reward(
            fraction,
            torch.from_numpy(self._visible_fraction),
            success,
            torch.from_numpy(terminated),
            penalty,
            gamma=self._gamma,
            step_cost=self._step_cost,
        ).numpy()
        begun = np.zeros_like(terminated) if "final_info" in info else info["elapsed_steps"] == 0
        return np.where(begun, np.float32(0.0), reward)


def _with_reward(info: dict[str, Any], task_reward: NDArray[Any]) -> dict[str, Any]:
    return {**info, "task_reward": task_reward, "_task_reward": info["_success"].copy()}


def make_gymnasium_vec(
    env_id: str,
    num_envs: int,
    *,
    action_scale: Sequence[float] | None = None,
    reward: Literal["task", "potential"] | None = None,
    gamma: float = _TD3.gamma,
    step_cost: float = _TD3.step_cost,
    **options: Any,
) -> LearnableVector:
    """N environments of a task for an outside learner, in one process and without a simulator.

    Args:
        env_id: Id of the task.
        num_envs: N.
        action_scale: As of `make_gymnasium_env`, like the next three.
        reward: Which reward to learn from.
        gamma: Discount factor of the learner.
        step_cost: What each step costs with the potential reward.
        options: Of `gymnasium.make_vec`, for instance `autoreset_mode=` or `plant=`.

    Raises:
        InvalidInputError: The id or an option is not allowed.
    """
    find_task(env_id)
    preset = get_preset(default_preset(env_id))
    return LearnableVector(
        make_vector_env(env_id, num_envs, **options),
        action_scale=preset.action_scale if action_scale is None else action_scale,
        reward=preset.reward if reward is None else reward,
        gamma=gamma,
        step_cost=step_cost,
    )
