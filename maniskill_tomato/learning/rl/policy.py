"""A trained policy, ready to act."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from maniskill_tomato.errors import CheckpointError, InvalidInputError
from maniskill_tomato.learning.rl.agent import make_actor
from maniskill_tomato.learning.rl.checkpoint import load_checkpoint
from maniskill_tomato.learning.rl.networks import Actor, ObservationNormalizer
from maniskill_tomato.learning.rl.presets import EPSILON_GREEDY_HIGH, EPSILON_GREEDY_LOW, TrainConfig


@dataclass(frozen=True, kw_only=True)
class Policy:
    """An actor with its normaliser and action scale: observations in, environment actions out."""

    actor: Actor
    normalizer: ObservationNormalizer
    action_scale: Tensor
    """Shape (action_dim,)."""
    action_low: Tensor
    """Shape (action_dim,)."""
    action_high: Tensor
    """Shape (action_dim,)."""
    config: TrainConfig
    env_id: str
    """The task that it was trained on."""
    package_version: str
    """The version that wrote it."""
    counters: dict[str, Any]
    """Steps, episodes, updates, seconds and seed of its training."""
    env_options: dict[str, Any] | None = None
    """Options of the task that it was trained with, such as its plant; empty if the task was as it is, None if the
    file is of a version that did not keep them."""

    @property
    def observation_dim(self) -> int:
        """Number of observed values."""
        return len(self.normalizer.centre)

    @property
    def algorithm(self) -> str:
        """TD3 or DDPG."""
        return "TD3" if self.config.twin_critics else "DDPG"

    def act(self, observations: Tensor) -> Tensor:
        """The actions for a batch of observations, without exploration.

        Args:
            observations: As the task gives them: world frame, [m] and [rad]. Shape (B, observation_dim).

        Returns:
            In units of the environment, [m] and [rad]. Shape (B, action_dim).

        Raises:
            InvalidInputError: The observations have another shape.
        """
        if observations.ndim != 2 or observations.shape[1] != self.observation_dim:
            raise InvalidInputError(
                f"observations must have shape (B, {self.observation_dim}), got {tuple(observations.shape)}"
            )
        with torch.no_grad():
            actions: Tensor = self.actor(self.normalizer(observations)) * self.action_scale
        return torch.maximum(torch.minimum(actions, self.action_high), self.action_low)


class RandomPolicy:
    """Uniformly random actions from the ranges of Eq. 5-6: what a policy must beat."""

    def __init__(self, seed: int, device: torch.device | str = "cpu") -> None:
        self._generator = torch.Generator(device=device).manual_seed(seed)
        self._low = torch.tensor(EPSILON_GREEDY_LOW, device=device)
        self._range = torch.tensor(EPSILON_GREEDY_HIGH, device=device) - self._low

    def act(self, observations: Tensor) -> Tensor:
        """Random actions, [m] and [rad]. Shape (B, 6)."""
        uniform = torch.rand(len(observations), 6, generator=self._generator, device=self._low.device)
        return self._low + uniform * self._range


def load_policy(path: Path | str, device: torch.device | str = "cpu", env_id: str | None = None) -> Policy:
    """Reads a policy from a checkpoint or a policy file.

    Args:
        path: The file.
        device: Where the policy runs.
        env_id: The task that it must have been trained on; None accepts any.

    Raises:
        CheckpointError: The file is missing, damaged, inconsistent or made for another task.
    """
    data = load_checkpoint(path, device)
    if env_id is not None and data["env_id"] != env_id:
        raise CheckpointError(
            f"{path} was trained on {data['env_id']}, not on {env_id}; give the policy of this task, or pass "
            "--allow-other-task to try it all the same"
        )
    try:
        config = TrainConfig.from_dict(data["config"])
        (observation_dim,) = data["observation"]["shape"]
        scale = data["action"]["scale"]
        actor = make_actor(config, observation_dim, len(scale)).to(device)
        actor.load_state_dict(data["actor"])
        normalizer = ObservationNormalizer.identity(observation_dim).to(device)
        normalizer.load_state_dict(data["normalizer"])
        low, high = data["action"]["low"], data["action"]["high"]
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise CheckpointError(f"{path} does not fit itself: {error}; train the policy again") from error
    if not all(bool(torch.isfinite(p).all()) for p in actor.parameters()):
        raise CheckpointError(
            f"{path} holds weights that are not finite; use an earlier checkpoint from its run folder"
        )
    return Policy(
        actor=actor.eval().requires_grad_(False),
        normalizer=normalizer.requires_grad_(False),
        action_scale=scale,
        action_low=low,
        action_high=high,
        config=config,
        env_id=data["env_id"],
        package_version=data["package_version"],
        counters=data["counters"],
        env_options=_options(path, data.get("env_options")),
    )


def _options(path: Path | str, options: Any) -> dict[str, Any] | None:
    if options is not None and not isinstance(options, dict):
        raise CheckpointError(
            f"{path} does not fit itself: env_options is {options!r}; train the policy again"
        )
    return options
