"""The environments a learner steps: many at once, reset when done, with the last observation of an episode
kept."""

from collections.abc import Mapping
from typing import Any, Protocol, cast

import gymnasium as gym
import torch
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.learning.rl.env_state import set_shell_state, shell_state
from maniskill_tomato.sensing.perception_kinds import RENDERED
from maniskill_tomato.tasks import TASK_IDS
from maniskill_tomato.tasks.making import MAX_STEPS, option_names
from maniskill_tomato.tasks.observed_world import LearnerEyes, ObservedWorld
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

    def reset(self, *, seed: int | list[int] | None = None) -> tuple[Any, dict[str, Any]]:
        """Starts an episode everywhere."""
        ...

    def step(self, actions: Tensor) -> tuple[Any, Tensor, Tensor, Tensor, dict[str, Any]]:
        """Observation, rewards, terminations, truncations, info; `num_envs` rows each."""
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


def make_env(
    env_id: str,
    num_envs: int = 1,
    *,
    colours: bool = False,
    eyes: LearnerEyes | None = None,
    **options: Any,
) -> gym.Env[Any, Any]:
    """N environments of a task with state observations, which do not reset themselves.

    They are worlds in this process, on the first GPU if there is one and N is above 1. Options that only a simulator
    has, such as `motion` or `render_mode`, or perception that renders colours, make it ManiSkill's shell.

    Args:
        env_id: Id of the task.
        num_envs: N.
        colours: Whether a policy observes colours, which makes it ManiSkill's shell with a renderer.
        eyes: Images that stand in the observations, which are dictionaries then; with colours it is the shell too.
        options: Of the task or the shell.

    Raises:
        InvalidInputError: The id or an option is not allowed, or the simulator cannot run that many.
    """
    check_env_id(env_id)
    colours = colours or (eyes is not None and eyes.images.needs_colours)
    if not colours and not needs_simulator(env_id, options):
        return make_vector_env(env_id, num_envs, _device(num_envs), auto_reset=False, eyes=eyes, **options)
    if colours:
        options = {"render_backend": _renderer(), **options}
    if eyes is not None:
        return SimulatedVectorEnv(make_simulated_env(env_id, num_envs, **options), eyes, auto_reset=False)
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


def make_learner_env(
    env_id: str, num_envs: int = 1, *, eyes: LearnerEyes | None = None, **options: Any
) -> LearnerEnv:
    """The same as `make_env`, but environments that are done are reset; see `LearnerEnv`.

    Args:
        env_id: Id of the task.
        num_envs: N.
        eyes: The images that are observed; colours make it ManiSkill's shell, which renders them.
        options: Of the task or the shell.
    """
    check_env_id(env_id)
    colours = eyes is not None and eyes.images.needs_colours
    if not colours and not needs_simulator(env_id, options):
        return make_vector_env(env_id, num_envs, _device(num_envs), eyes=eyes, **options)
    if eyes is not None:
        renderer = {"render_backend": _renderer() if colours else "none"}
        return SimulatedVectorEnv(make_simulated_env(env_id, num_envs, **{**renderer, **options}), eyes)
    env = make_simulated_env(env_id, num_envs, **options)
    # ManiSkill takes seconds to import; commands that do not simulate need not wait for it.
    from mani_skill.vector.wrappers.gymnasium import ManiSkillVectorEnv

    return cast(LearnerEnv, ManiSkillVectorEnv(env, auto_reset=True))


class SimulatedVectorEnv(gym.Env[Any, Any]):
    """ManiSkill's shell for a learner that observes images, with resets as in `VectorEnv`.

    ManiSkill's own wrapper refuses environments whose scene is built anew for every plant.
    """

    def __init__(self, env: gym.Env[Any, Any], eyes: LearnerEyes, *, auto_reset: bool = True) -> None:
        """Takes an environment that does not reset itself.

        Args:
            env: One of this package's, with a renderer where colours are observed.
            eyes: What is observed.
            auto_reset: Whether `step` resets environments that are done.
        """
        self._env = env
        self.spec = env.spec
        self.auto_reset = auto_reset
        self.base_env = cast(Any, env.unwrapped)
        """ManiSkill's environment."""
        self._observed = ObservedWorld(self.base_env.world, eyes)
        self.num_envs = int(self.base_env.num_envs)
        self.single_observation_space: gym.Space[Any] = self._observed.space
        self.single_action_space: gym.Space[Any] = self.base_env.single_action_space
        self.observation_space = gym.vector.utils.batch_space(self._observed.space, self.num_envs)
        self.action_space = gym.vector.utils.batch_space(self.single_action_space, self.num_envs)
        self._max_steps = MAX_STEPS[self.base_env.env_id]
        self._elapsed = torch.zeros(self.num_envs, dtype=torch.int32, device=self.base_env.device)

    @property
    def unwrapped(self) -> Any:
        """ManiSkill's environment."""
        return self.base_env

    def reset(
        self, *, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begins episodes; the option `env_idx` says where, everywhere if it is missing."""
        rows = self.base_env.world.env_rows((options or {}).get("env_idx"))
        _, info = self._env.reset(seed=seed, options=options)  # type: ignore[arg-type]
        self._elapsed[rows] = 0
        return self._observed.observe(rows), info

    def step(  # type: ignore[override]
        self, actions: Tensor
    ) -> tuple[Any, Tensor, Tensor, Tensor, dict[str, Any]]:
        """Makes a move in every environment; see `VectorEnv.step`."""
        _, reward, terminated, _, info = self._env.step(actions)
        self._elapsed += 1
        observation, truncated = self._observed.observe(None), self._elapsed >= self._max_steps
        done = torch.as_tensor(terminated) | truncated
        if self.auto_reset and bool(done.any()):
            final = {"final_observation": observation, "final_info": info}
            partial = {"env_idx": done.nonzero()[:, 0]} if self.num_envs > 1 else None
            observation, info = self.reset(options=partial)
            info = {**info, **final}
        return observation, torch.as_tensor(reward), torch.as_tensor(terminated), truncated, info

    def close(self) -> None:
        """Frees the simulation."""
        self._env.close()

    def get_run_state(self) -> dict[str, Any]:
        """Everything that decides how the environments go on."""
        return {
            "shell": shell_state(self.base_env),
            "elapsed": self._elapsed.cpu().clone(),
            "frames": self._observed.frames.state_dict(),
        }

    def set_run_state(self, state: dict[str, Any]) -> None:
        """Takes back what `get_run_state` of an environment made with the same options gave."""
        set_shell_state(self.base_env, state["shell"], self._env.reset)
        self._elapsed = state["elapsed"].to(self._elapsed)
        self._observed.frames.load_state_dict(state["frames"], self.base_env.device)


def needs_simulator(env_id: str, options: Mapping[str, Any]) -> bool:
    """Whether options ask for what a world does not have."""
    return bool(set(options) - option_names(env_id)) or options.get("perception") in RENDERED


def _device(num_envs: int) -> str:
    return "cuda" if num_envs > 1 and torch.cuda.is_available() else "cpu"


def _renderer() -> str:
    return "gpu" if torch.cuda.is_available() else "cpu"
