"""The environments a learner steps: many at once, reset when done, with the last observation of an episode
kept."""

from collections.abc import Mapping
from typing import Any, Protocol, cast

import gymnasium as gym
import torch
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.sensing.perception_kinds import RENDERED
from maniskill_tomato.tasks import TASK_IDS
from maniskill_tomato.tasks.making import option_names
from maniskill_tomato.tasks.vector_env import make_vector_env


class LearnerEnv(Protocol):
    """What a learner needs of an environment; `tasks.vector_env.VectorEnv` offers it, and ManiSkill's wrapper.

    Environments that are done are reset within `step`: the returned observation is the first of the new
    episode and `info["final_observation"]`, `info["final_info"]` are what the step itself gave.
    """

    num_envs: int

    @property
    def single_observation_space(self) -> gym.Space[Any]:
        """Space of one environment's observation."""
        ...

    @property
    def single_action_space(self) -> gym.Space[Any]:
        """Space of one environment's action."""
        ...

    def reset(self, *, seed: int | list[int] | None = None) -> tuple[Tensor, dict[str, Any]]:
        """Starts an episode everywhere."""
        ...

    def step(self, actions: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        """Observations, rewards, terminations, truncations, info; `num_envs` rows each."""
        ...

    def close(self) -> None:
        """Frees the simulation."""
        ...


def check_env_id(env_id: str) -> None:
    """Accepts the ids of this package's tasks.

    Raises:
        InvalidInputError: Another id; the message lists the allowed ones.
    """
    if env_id not in TASK_IDS:
        raise InvalidInputError.choice("the environment id", env_id, TASK_IDS)


def make_env(env_id: str, num_envs: int = 1, **options: Any) -> gym.Env[Any, Any]:
    """N environments of a task with state observations, which do not reset themselves.

    They are worlds in this process, on the first GPU if there is one and N is above 1. Options that only a simulator
    has, such as `motion` or `render_mode`, or perception that renders colours, make it ManiSkill's shell.

    Raises:
        InvalidInputError: The id or an option is not allowed, or the simulator cannot run that many.
    """
    check_env_id(env_id)
    if not needs_simulator(env_id, options):
        return make_vector_env(env_id, num_envs, _device(num_envs), auto_reset=False, **options)
    return make_simulated_env(env_id, num_envs, **options)


def make_simulated_env(env_id: str, num_envs: int = 1, **options: Any) -> gym.Env[Any, Any]:
    """The same in ManiSkill's shell, without rendering unless `options` say otherwise.

    Raises:
        InvalidInputError: The id is unknown, or more environments are asked for than this machine can
            simulate at once.
    """
    check_env_id(env_id)
    if num_envs > 1 and not torch.cuda.is_available():
        raise InvalidInputError(
            f"num_envs must be 1 without a CUDA device, where ManiSkill simulates on the CPU; got {num_envs}"
        )
    options = {"obs_mode": "state", "render_backend": "none", "num_envs": num_envs, **options}
    return gym.make(env_id, **options)


def make_learner_env(env_id: str, num_envs: int = 1, **options: Any) -> LearnerEnv:
    """The same as `make_env`, but environments that are done are reset; see `LearnerEnv`."""
    check_env_id(env_id)
    if not needs_simulator(env_id, options):
        return make_vector_env(env_id, num_envs, _device(num_envs), **options)
    env = make_simulated_env(env_id, num_envs, **options)
    # ManiSkill takes seconds to import; commands that do not simulate need not wait for it.
    from mani_skill.vector.wrappers.gymnasium import ManiSkillVectorEnv

    return cast(LearnerEnv, ManiSkillVectorEnv(env, auto_reset=True))


def needs_simulator(env_id: str, options: Mapping[str, Any]) -> bool:
    """Whether options ask for what a world does not have."""
    return bool(set(options) - option_names(env_id)) or options.get("perception") in RENDERED


def _device(num_envs: int) -> str:
    return "cuda" if num_envs > 1 and torch.cuda.is_available() else "cpu"
