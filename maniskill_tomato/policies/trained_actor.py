"""Reading what a training wrote: checkpoints, and the actor in them, ready to act."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import maniskill_tomato
from maniskill_tomato.errors import CheckpointError, InvalidInputError
from maniskill_tomato.files import read_tensors
from maniskill_tomato.network_weights import check_weight, fill_network
from maniskill_tomato.policies.actor import Actor, ObservationNormalizer

FORMAT = 1
"""Version of the layout that `learning.rl.checkpoint.make_checkpoint` documents."""

REQUIRED_KEYS = (
    "format",
    "package_version",
    "env_id",
    "config",
    "observation",
    "action",
    "normalizer",
    "actor",
    "counters",
)


@dataclass(frozen=True, kw_only=True)
class TrainedActor:
    """An actor with its normaliser and action scale: observations in, actions of the environment out."""

    actor: Actor
    normalizer: ObservationNormalizer
    action_scale: Tensor
    """Shape (action_dim,)."""
    action_low: Tensor
    """Shape (action_dim,)."""
    action_high: Tensor
    """Shape (action_dim,)."""
    config: dict[str, Any]
    """The training's options, as `learning.rl.train_config.TrainConfig.to_dict` wrote them."""
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
        return "TD3" if self.config.get("twin_critics", False) else "DDPG"

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

    def describe(self) -> dict[str, Any]:
        """Where it comes from, for reports."""
        return {
            "kind": self.algorithm,
            "trained_on": self.env_id,
            "trained_with": self.env_options,
            "training_steps": self.counters.get("steps"),
            "training_episodes": self.counters.get("episodes"),
            "training_seconds": round(float(self.counters.get("seconds", 0.0)), 1),
            "training_seed": self.counters.get("seed"),
            "package_version": self.package_version,
        }


def load_actor(
    path: Path | str, device: torch.device | str = "cpu", env_id: str | None = None
) -> TrainedActor:
    """The actor of a checkpoint or a policy file.

    Args:
        path: The file.
        device: Where the actor runs.
        env_id: The task that it must have been trained on; None accepts any.

    Raises:
        CheckpointError: The file is missing, damaged, inconsistent or made for another task.
    """
    data = load_checkpoint(path, device)
    if env_id is not None and data["env_id"] != env_id:
        raise CheckpointError(
            f"{path} was trained on {data['env_id']}, not on {env_id}; give a policy of this task (`maniskill-tomato "
            "eval` tries any with --allow-other-task)"
        )
    try:
        (observation_dim,) = data["observation"]["shape"]
        scale = data["action"]["scale"]
        actor = Actor(observation_dim, len(scale), tuple(data["config"]["actor_hidden"])).to(device)
        fill_network(actor, data["actor"])
        normalizer = ObservationNormalizer.identity(observation_dim).to(device)
        fill_network(normalizer, data["normalizer"])
        low, high = data["action"]["low"], data["action"]["high"]
        for name, values in (("scale", scale), ("low", low), ("high", high)):
            check_weight(f"action {name}", values, torch.zeros(len(scale)))
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise CheckpointError(f"{path} does not fit itself: {error}; train the policy again") from error
    options = data.get("env_options")
    if options is not None and not isinstance(options, dict):
        raise CheckpointError(
            f"{path} does not fit itself: env_options is {options!r}; train the policy again"
        )
    return TrainedActor(
        actor=actor.eval().requires_grad_(False),
        normalizer=normalizer.requires_grad_(False),
        action_scale=scale,
        action_low=low,
        action_high=high,
        config=data["config"],
        env_id=data["env_id"],
        package_version=data["package_version"],
        counters=data["counters"],
        env_options=options,
    )


def load_checkpoint(path: Path | str, device: torch.device | str = "cpu") -> dict[str, Any]:
    """The content of a checkpoint file (see `make_checkpoint`).

    Raises:
        CheckpointError: The file is missing, damaged, not one of ours, or of a newer format.
    """
    data = read_tensors(path, device)
    if not isinstance(data, dict) or any(key not in data for key in REQUIRED_KEYS):
        raise CheckpointError(
            f"{path} is not a checkpoint of this package, which would hold {', '.join(REQUIRED_KEYS)}"
        )
    checkpoint: dict[str, Any] = data
    if not isinstance(checkpoint["format"], int) or checkpoint["format"] > FORMAT:
        raise CheckpointError(
            f"{path} has checkpoint format {checkpoint['format']}, written by version "
            f"{checkpoint['package_version']}; "
            f"this version, {maniskill_tomato.__version__}, reads up to {FORMAT}: upgrade maniskill-tomato",
            newer_format=True,
        )
    return checkpoint
