"""Gymnasium's vector environments as those of Stable-Baselines3, which has an interface of its own."""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn

from maniskill_tomato.errors import InvalidInputError


class GymnasiumVecEnv(VecEnv):  # type: ignore[misc]
    """A Gymnasium vector environment that resets within the step which ends an episode, as Stable-Baselines3 expects.

    The info of an environment holds something only where its episode ended: what `final_info` says of it, with
    `terminal_observation` and `TimeLimit.truncated`, from which learners bootstrap. `VecMonitor` round it counts
    returns, lengths and successes.
    """

    def __init__(self, env: gym.vector.VectorEnv[Any, Any, Any]) -> None:
        """Takes an environment of NumPy arrays.

        Args:
            env: With `AutoresetMode.SAME_STEP`.

        Raises:
            InvalidInputError: It resets in another way.
        """
        if env.metadata.get("autoreset_mode") is not AutoresetMode.SAME_STEP:
            raise InvalidInputError(
                "Stable-Baselines3 resets within the step that ends an episode; make the environment with "
                "autoreset_mode='SameStep'"
            )
        self.env = env
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)
        self._actions: NDArray[Any] = np.zeros(0)

    def reset(self) -> VecEnvObs:
        """Begins an episode everywhere, from the seeds of `seed` if it was called since the last time."""
        seeds: Any = None if all(s is None for s in self._seeds) else self._seeds
        observations, _ = self.env.reset(seed=seeds)
        self._reset_seeds()
        return observations

    def step_async(self, actions: NDArray[Any]) -> None:
        """Keeps the actions. Shape (N, A)."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Makes the move."""
        observations, rewards, terminated, truncated, told = self.env.step(self._actions)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for i in np.flatnonzero(terminated | truncated).tolist():
            final = told["final_info"]
            infos[i] = {name: values[i] for name, values in final.items() if not name.startswith("_")}
            infos[i]["terminal_observation"] = told["final_obs"][i]
            infos[i]["TimeLimit.truncated"] = bool(truncated[i] and not terminated[i])
        return observations, rewards, terminated | truncated, infos

    def close(self) -> None:
        """Closes the environment."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """An attribute, once for each of these environments."""
        return [self._found(attr_name)] * self._count(indices)

    def _found(self, name: str) -> Any:
        """An attribute of the environments or of what they wrap; Gymnasium's vector wrappers hide it."""
        env: Any = self.env
        while not hasattr(env, name) and isinstance(env, gym.vector.VectorWrapper):
            env = env.env
        return getattr(env, name)

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Sets an attribute of all environments."""
        setattr(self.env, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """What a method gives, once for each of these environments."""
        return [self._found(method_name)(*method_args, **method_kwargs)] * self._count(indices)

    def env_is_wrapped(
        self, wrapper_class: type[gym.Wrapper[Any, Any, Any, Any]], indices: VecEnvIndices = None
    ) -> list[bool]:
        """No: single environments have no wrappers here."""
        return [False] * self._count(indices)

    def _count(self, indices: VecEnvIndices) -> int:
        return len(list(self._get_indices(indices)))
