"""A task as a plain Gymnasium environment of NumPy arrays, for learners from outside this package."""

from collections.abc import Sequence
from typing import Any, Literal, SupportsFloat, cast

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.learning.rl.envs import make_env
from maniskill_tomato.learning.rl.presets import (
    OBSERVATION_CENTRE,
    OBSERVATION_HALF_RANGE,
    default_preset,
    get_preset,
)
from maniskill_tomato.learning.rl.rewards import potential_reward
from maniskill_tomato.sensing.image_layout import ImageLayout
from maniskill_tomato.sensing.image_observation import STATE
from maniskill_tomato.sensing.perception_kinds import STATE_MODE
from maniskill_tomato.task_registry import find_task
from maniskill_tomato.tasks.observed_world import LearnerEyes

Array = NDArray[np.float32]
Seen = Array | dict[str, NDArray[Any]]
"""A state vector of shape (D,), or a dictionary with `state` of that shape and images of shape (H, W, C)."""
ArrayEnv = gym.Env[Any, Array]

CENTRE: Array = np.array(OBSERVATION_CENTRE, dtype=np.float32)
HALF_RANGE: Array = np.array(OBSERVATION_HALF_RANGE, dtype=np.float32)

_TD3 = get_preset("td3")


class ArrayTask(gym.Env[Any, Array]):
    """One environment of a task with NumPy arrays and plain numbers, and no automatic reset."""

    metadata = {"render_modes": []}

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        """Takes an environment that gives tensors with a row for each of its environments.

        Args:
            env: With one environment that does not reset itself.
        """
        self._env = cast(Any, env)
        self.spec = None  # `gymnasium.make` makes another class of the same id.
        # Gymnasium's wrappers hide what ManiSkill's shell says beside Gymnasium's interface.
        told = self._env if hasattr(self._env, "single_observation_space") else self._env.unwrapped
        self.observation_space = told.single_observation_space
        self.action_space = told.single_action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Seen, dict[str, Any]]:
        """Begins an episode; the seed is that of the task and of `np_random`."""
        super().reset(seed=seed)
        observation, info = self._env.reset(seed=seed, options=options)
        return _row(observation), _row(info)

    def step(self, action: Array) -> tuple[Seen, float, bool, bool, dict[str, Any]]:
        """Makes a move.

        Args:
            action: Shape (A,).

        Returns:
            What is seen, the task's reward, whether the episode terminated, whether it was cut off, and the info.
        """
        observation, reward, terminated, truncated, info = self._env.step(torch.as_tensor(action)[None])
        return _row(observation), float(reward[0]), bool(terminated[0]), bool(truncated[0]), _row(info)

    def close(self) -> None:
        """Frees the simulation, if there is one."""
        self._env.close()


def _row(values: Any) -> Any:
    """The only row of tensors: a number where it is one, else an array."""
    if isinstance(values, dict):
        return {name: _row(value) for name, value in values.items()}
    if not isinstance(values, torch.Tensor):
        return values
    row = values[0].detach().cpu()
    return row.item() if row.ndim == 0 else row.numpy()


class LearnableTask(gym.Wrapper[Any, Array, Any, Array]):
    """A task with normalised observations, actions in [-1, 1] and a choice of reward; by default all as in the
    preset `td3`, for the general tasks as in `general-td3`.

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
            env: One environment with arrays of shape (D,) and (A,), such as `ArrayTask`.
            action_scale: The action that 1 stands for, in the task's units. Shape (A,).
            reward: The task's, or success with V_f as a potential (`learning.rl.rewards.potential_reward`).
            gamma: Discount factor of the learner; only the potential reward uses it.
            step_cost: What each step costs with the potential reward.

        Raises:
            InvalidInputError: The action scale has another length or values outside (0, 1], or the reward is
                unknown.
        """
        super().__init__(env)
        check_learnable(env.action_space, action_scale, reward)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (len(action_scale),), np.float32)
        self._scale = np.array(action_scale, dtype=np.float32)
        self._reward = reward
        self._gamma = gamma
        self._step_cost = step_cost
        self._visible_fraction = 0.0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        observation, info = self.env.reset(seed=seed, options=options)
        if self._reward == "potential" and "reward_penalty" not in info:
            raise InvalidInputError(
                "the potential reward is for the thesis's tasks, and this task tells no reward_penalty; use "
                "reward='task', which is a potential already"
            )
        self._visible_fraction = float(info["visible_fraction"])
        return normalize_observation(observation), {**info, "task_reward": 0.0}

    def step(self, action: Array) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
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


def check_learnable(actions: gym.Space[Any], action_scale: Sequence[float], reward: str) -> None:
    """Accepts a scale for each action, and the rewards that there are.

    Raises:
        InvalidInputError: The scale has another length or values outside (0, 1], or the reward is unknown.
    """
    if actions.shape != (len(action_scale),) or not all(0.0 < s <= 1.0 for s in action_scale):
        raise InvalidInputError(
            f"action_scale must hold one value in (0, 1] for each action of {actions}, got {tuple(action_scale)}"
        )
    if reward not in ("task", "potential"):
        raise InvalidInputError.choice("reward", reward, ("task", "potential"))


def normalize_observation(observation: Any) -> Any:
    """The thesis's nine numbers in the fixed ranges of the `td3` preset, about -1 to 1; others as they are.

    The general tasks' observation is scaled already, and images stay as they are.

    Args:
        observation: Shape (..., D), or a dictionary with such a `state`.
    """
    if isinstance(observation, dict):
        return {**observation, STATE: normalize_observation(observation[STATE])}
    if observation.shape[-1] != len(CENTRE):
        return observation
    return (observation - CENTRE) / HALF_RANGE


def make_gymnasium_env(
    env_id: str,
    *,
    action_scale: Sequence[float] | None = None,
    reward: Literal["task", "potential"] | None = None,
    gamma: float = _TD3.gamma,
    step_cost: float = _TD3.step_cost,
    obs_mode: str = STATE_MODE,
    image_size: tuple[int, int] = (64, 48),
    **options: Any,
) -> LearnableTask:
    """One environment of a task for an outside learner.

    It needs no simulator, unless an option or colours ask for one.

    Args:
        env_id: Id of the task.
        action_scale: See `LearnableTask`; that of the preset `td3`, for the general tasks of `general-td3`, if None.
        reward: Which reward to learn from; the potential one for the thesis's tasks, the task's for the others if None.
        gamma: Discount factor of the learner; only the potential reward uses it.
        step_cost: What each step costs with the potential reward.
        obs_mode: `state`, or images beside it: see `sensing.image_layout.ImageLayout.parse`.
        image_size: Their width and height, in [px].
        options: For `gymnasium.make`, for instance `plant=`.

    Raises:
        InvalidInputError: The id or an option is not allowed.
    """
    find_task(env_id)
    preset = get_preset(default_preset(env_id))
    images = ImageLayout.parse(obs_mode, image_size)
    env = make_env(env_id, eyes=None if images is None else LearnerEyes(images=images), **options)
    return LearnableTask(
        ArrayTask(env),
        action_scale=preset.action_scale if action_scale is None else action_scale,
        reward=preset.reward if reward is None else reward,
        gamma=gamma,
        step_cost=step_cost,
    )
