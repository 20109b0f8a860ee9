"""The environments a learner steps: many at once, reset when done, with the last observation of an episode
kept."""

from collections.abc import Mapping, Sequence
from typing import Any, Protocol, cast

import gymnasium as gym
import torch
from gymnasium.vector import AutoresetMode
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.learning.rl.env_state import set_shell_state, shell_state
from maniskill_tomato.sensing.perception_kinds import RENDERED
from maniskill_tomato.task_registry import find_task
from maniskill_tomato.tasks.making import option_names
from maniskill_tomato.tasks.observed_world import LearnerEyes
from maniskill_tomato.tasks.vector_env import VectorEnv, make_vector_env


class LearnerEnv(Protocol):
    """What a learner needs of an environment; `tasks.vector_env.VectorEnv` of tensors offers it.

    Environments that are done are reset within `step`: the returned observation is the first of the new
    episode and `info["final_obs"]`, `info["final_info"]` are what the step itself gave, in all environments.
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
    find_task(env_id)
    colours = colours or (eyes is not None and eyes.images.needs_colours)
    mode = AutoresetMode.DISABLED
    if not colours and not needs_simulator(env_id, options):
        return _as_env(_make_world_env(env_id, num_envs, eyes, mode, options))
    if colours:
        options = {"render_backend": _renderer(), **options}
    if eyes is not None:
        env = make_simulated_env(env_id, num_envs, **options)
        return _as_env(SimulatedVectorEnv(env, eyes, autoreset_mode=mode))
    return make_simulated_env(env_id, num_envs, **options)


def make_simulated_env(env_id: str, num_envs: int = 1, **options: Any) -> gym.Env[Any, Any]:
    """The same in ManiSkill's shell, without rendering unless `options` say otherwise.

    Raises:
        InvalidInputError: The id is unknown, or more environments are asked for than this machine can
            simulate at once.
    """
    find_task(env_id)
    if num_envs > 1 and not torch.cuda.is_available():
        raise InvalidInputError(
            f"num_envs must be 1 without a CUDA device, where ManiSkill simulates on the CPU, got {num_envs}; give "
            "--num-envs 1, or leave out what needs the simulator"
        )
    options = {"obs_mode": "state", "render_backend": "none", "num_envs": num_envs, **options}
    return gym.make(find_task(env_id).env_id, **options)


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
    find_task(env_id)
    colours = eyes is not None and eyes.images.needs_colours
    if not colours and not needs_simulator(env_id, options):
        return _make_world_env(env_id, num_envs, eyes, AutoresetMode.SAME_STEP, options)
    renderer = {"render_backend": _renderer()} if colours else {}
    return SimulatedVectorEnv(make_simulated_env(env_id, num_envs, **{**renderer, **options}), eyes)


def _make_world_env(
    env_id: str, num_envs: int, eyes: LearnerEyes | None, mode: AutoresetMode, options: Mapping[str, Any]
) -> VectorEnv:
    device = "cuda" if num_envs > 1 and torch.cuda.is_available() else "cpu"
    return make_vector_env(
        env_id, num_envs, device, autoreset_mode=mode, arrays="torch", eyes=eyes, **options
    )


def _as_env(env: VectorEnv) -> gym.Env[Any, Any]:
    """The same: it is reset and stepped as ManiSkill's shell, whose base class is this one."""
    return cast(gym.Env[Any, Any], env)


class SimulatedVectorEnv(VectorEnv):
    """ManiSkill's shell as a `VectorEnv`, which takes from the shell what it does not have itself.

    ManiSkill's own wrapper refuses environments whose scene is built anew for every plant.
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        eyes: LearnerEyes | None = None,
        *,
        autoreset_mode: AutoresetMode = AutoresetMode.SAME_STEP,
    ) -> None:
        """Takes an environment that does not reset itself.

        Args:
            env: One of this package's, with a renderer where colours are observed.
            eyes: What is observed.
            autoreset_mode: When environments that are done are reset.
        """
        self._env = env
        self.base_env = cast(Any, env.unwrapped)
        """ManiSkill's environment."""
        env_id = self.base_env.env_id
        super().__init__(
            self.base_env.world,
            find_task(env_id).max_episode_steps,
            autoreset_mode=autoreset_mode,
            arrays="torch",
            env_id=env_id,
            eyes=eyes,
        )
        self.single_action_space = self.base_env.single_action_space
        self.action_space = gym.vector.utils.batch_space(self.single_action_space, self.num_envs)

    @property
    def _told_by(self) -> Any:
        return self.base_env

    def _begin(self, seeds: Sequence[int | None] | None, rows: Tensor, options: Mapping[str, Any]) -> None:
        where = {"env_idx": rows} if len(rows) < self.num_envs else {}
        self._env.reset(seed=cast(Any, seeds), options={**options, **where})

    def _play(self, actions: Any) -> tuple[Tensor, Tensor, dict[str, Any]]:
        _, reward, terminated, _, info = self._env.step(actions)
        self._elapsed += 1
        return torch.as_tensor(reward), torch.as_tensor(terminated), dict(info)

    def _info(self) -> dict[str, Any]:
        return dict(self.base_env.get_info())

    def close_extras(self, **kwargs: Any) -> None:
        """Frees the simulation."""
        self._env.close()

    def get_run_state(self) -> dict[str, Any]:
        """Everything that decides how the environments go on."""
        return {"shell": shell_state(self.base_env), **self._progress()}

    def set_run_state(self, state: Mapping[str, Any]) -> None:
        """Takes back what `get_run_state` of an environment made with the same options gave."""
        set_shell_state(self.base_env, state["shell"], self._env.reset)
        self._set_progress(state)


def needs_simulator(env_id: str, options: Mapping[str, Any]) -> bool:
    """Whether options ask for what a world does not have."""
    return bool(set(options) - option_names(env_id)) or options.get("perception") in RENDERED


def _renderer() -> str:
    return "gpu" if torch.cuda.is_available() else "cpu"
