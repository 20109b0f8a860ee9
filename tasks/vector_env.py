"""The shell for learners: a world stepped with automatic resets, observations and infos as learners want them."""

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor

from maniskill_tomato.tasks.arm_moves import ACTION_SIZES
from maniskill_tomato.tasks.making import MAX_STEPS, make_world
from maniskill_tomato.tasks.observed_world import LearnerEyes, ObservedWorld
from maniskill_tomato.tasks.world import World


class VectorEnv(gym.Env[Any, Any]):
    """N environments of one task in this process, without a simulator.

    With `auto_reset`, environments that are done are reset within `step`: the returned observation is the first of the
    new episode, and `info["final_observation"]` and `info["final_info"]` are what the step itself gave, in all
    environments.
    """

    def __init__(
        self,
        world: World,
        max_steps: int,
        *,
        auto_reset: bool = True,
        env_id: str | None = None,
        eyes: LearnerEyes | None = None,
    ) -> None:
        """Takes a world.

        Args:
            world: Which.
            max_steps: Steps after which an episode is cut off.
            auto_reset: Whether `step` resets environments that are done.
            env_id: The task's, for `spec`.
            eyes: What images stand in the observation, which then is a dictionary; None for state vectors.
        """
        self.world = world
        self.spec = None if env_id is None else gym.spec(env_id)
        self.num_envs = world.num_envs
        self.max_steps = max_steps
        self.auto_reset = auto_reset
        self._observed = ObservedWorld(world, eyes)
        self.single_observation_space: gym.Space[Any] = self._observed.space
        self.single_action_space: gym.Space[Any] = gym.spaces.Box(
            -1.0, 1.0, (ACTION_SIZES[world.moves.control],), np.float32
        )
        self.observation_space = gym.vector.utils.batch_space(self.single_observation_space, self.num_envs)
        self.action_space = gym.vector.utils.batch_space(self.single_action_space, self.num_envs)
        self._elapsed = torch.zeros(self.num_envs, dtype=torch.int32, device=world.device)

    @property
    def unwrapped(self) -> Any:
        """The world, which tells what ManiSkill's shell tells beside pictures."""
        return self.world

    def reset(
        self, *, seed: int | Sequence[int] | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begins episodes; see `World.reset`. The option `env_idx` says where, everywhere if it is missing."""
        options = dict(options or {})
        rows = self.world.env_rows(options.pop("env_idx", None))
        self.world.reset(seed, rows, options)
        self._elapsed[rows] = 0
        return self._observed.observe(rows), self._info()

    def step(  # type: ignore[override]
        self, actions: Any
    ) -> tuple[Any, Tensor, Tensor, Tensor, dict[str, Any]]:
        """Makes a move in every environment.

        Args:
            actions: Shape (N, A).

        Returns:
            Observations, of shape (N, D) where they are vectors; rewards, terminations and truncations of shape (N,);
            the info.
        """
        self.world.step(actions)
        self._elapsed += 1
        observation, info = self._observed.observe(None), self._info()
        reward = self.world.reward(info)
        terminated = info["success"] | info["fail"]
        truncated = self._elapsed >= self.max_steps
        done = terminated | truncated
        if self.auto_reset and bool(done.any()):
            final = {"final_observation": observation, "final_info": info}
            observation, info = self.reset(options={"env_idx": done.nonzero()[:, 0]})
            info |= final
        return observation, reward, terminated, truncated, info

    def close(self) -> None:
        """Nothing: a world holds no simulation."""

    def get_run_state(self) -> dict[str, Any]:
        """Everything that decides how the environments go on."""
        return {
            "world": self.world.save(),
            "elapsed": self._elapsed.cpu().clone(),
            "frames": self._observed.frames.state_dict(),
        }

    def set_run_state(self, state: Mapping[str, Any]) -> None:
        """Takes back what `get_run_state` of environments made with the same options gave."""
        self.world.restore(state["world"])
        self._elapsed = state["elapsed"].to(self._elapsed).clone()
        self._observed.frames.load_state_dict(state.get("frames", {}), self.world.device)

    def _info(self) -> dict[str, Any]:
        return {"elapsed_steps": self._elapsed.clone(), **self.world.info()}


def make_vector_env(
    env_id: str,
    num_envs: int = 1,
    device: str | torch.device = "cpu",
    *,
    auto_reset: bool = True,
    eyes: LearnerEyes | None = None,
    **options: Any,
) -> VectorEnv:
    """N environments of a task for a learner; see `making.make_world` and `VectorEnv`."""
    world = make_world(env_id, num_envs, device, **options)
    return VectorEnv(world, MAX_STEPS[env_id], auto_reset=auto_reset, env_id=env_id, eyes=eyes)
