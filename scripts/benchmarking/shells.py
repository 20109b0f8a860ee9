"""N environments of ManiSkill's shell: simulated together on a GPU, one after the other on a CPU.

ManiSkill simulates several environments on CUDA only. With as many single ones in their place, whatever is asked of N
environments on a GPU can be asked on a CPU too.
"""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import torch
from torch import Tensor

import maniskill_tomato.tasks  # noqa: F401  Registers the environments.


class Shells:
    """The environments; observations and the like are batches over all of them."""

    def __init__(self, env_id: str, num_envs: int, device: str, **options: Any) -> None:
        """Makes them.

        Args:
            env_id: The task.
            num_envs: N.
            device: `cuda` to simulate them together, `cpu` for N single ones.
            options: Of `gymnasium.make`.
        """
        self.num_envs = num_envs
        self.device = torch.device(device)
        together = self.device.type == "cuda"
        self._size = num_envs if together else 1
        if together:
            options["sim_backend"] = "physx_cuda"
        count = 1 if together else num_envs
        self.envs = [gym.make(env_id, num_envs=self._size, **options) for _ in range(count)]
        """One of N environments, or N of one."""

    def reset(self, seed: int | None = None, rows: Sequence[int] | None = None) -> Any:
        """Begins episodes.

        Args:
            seed: Of the first environment; the i-th gets `seed + i`. None lets the generators go on.
            rows: Which environments; all if None.

        Returns:
            The observations of all environments.
        """
        chosen = range(self.num_envs) if rows is None else rows
        if self._size > 1:
            options = {} if rows is None else {"env_idx": torch.tensor(rows, device=self.device)}
            seeds = None if seed is None else [seed + i for i in chosen]
            return self.envs[0].reset(seed=seeds, options=options)[0]  # type: ignore[arg-type]
        for i in chosen:
            self.envs[i].reset(seed=None if seed is None else seed + i)
        return self.observation()

    def step(self, actions: Tensor) -> Any:
        """Observations after a move in every environment. Shape (N, A)."""
        return self.step_all(actions)[0]

    def step_all(self, actions: Tensor) -> tuple[Any, ...]:
        """Observations, rewards, terminations and truncations after a move everywhere. Shape (N, A)."""
        parts = torch.split(actions, self._size)
        told = [env.step(part)[:4] for env, part in zip(self.envs, parts, strict=True)]
        return tuple(_joined(column) for column in zip(*told, strict=True))

    def observation(self) -> Any:
        """What is observed now."""
        return _joined([env.unwrapped.get_obs() for env in self._bare])

    def elapsed_steps(self) -> Tensor:
        """Steps of the episodes so far. Shape (N,)."""
        return torch.cat([env.unwrapped.elapsed_steps for env in self._bare])

    def state(self) -> list[Any]:
        """The state, for `take_back`."""
        return [env.unwrapped.get_state_dict() for env in self._bare]

    def take_back(self, state: Sequence[Any]) -> None:
        """Takes back what `state` gave."""
        for env, part in zip(self._bare, state, strict=True):
            env.unwrapped.set_state_dict(part)

    def close(self) -> None:
        """Frees the simulations."""
        for env in self.envs:
            env.close()

    @property
    def _bare(self) -> list[Any]:
        return [env.unwrapped for env in self.envs]


def _joined(parts: Sequence[Any]) -> Any:
    """Batches of environments one after the other; dictionaries entry by entry."""
    if len(parts) == 1:
        return parts[0]
    if isinstance(parts[0], dict):
        return {name: _joined([part[name] for part in parts]) for name in parts[0]}
    return torch.cat([torch.as_tensor(part) for part in parts])
