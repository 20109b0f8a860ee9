"""Reading what a training wrote: checkpoints, and the actor in them, ready to act."""

from collections.abc import Mapping
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
from maniskill_tomato.policies.image_encoder import ImageEncoder
from maniskill_tomato.sensing.image_layout import ImageLayout, Sight, check_images
from maniskill_tomato.sensing.image_observation import Observation, images_of, state_of
from maniskill_tomato.sensing.perception_kinds import STATE_MODE
from maniskill_tomato.task_registry import is_same_task

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
    encoder: ImageEncoder | None = None
    """What turns images into features; None for an actor that observes none."""

    @property
    def observation_dim(self) -> int:
        """Number of observed values, those of images left out."""
        return len(self.normalizer.centre)

    @property
    def sight(self) -> Sight | None:
        """The images that it observes; None if it observes none."""
        return None if self.encoder is None else sight_of(self.config)

    @property
    def algorithm(self) -> str:
        """TD3 or DDPG."""
        return "TD3" if self.config.get("twin_critics", False) else "DDPG"

    def act(self, observations: Observation) -> Tensor:
        """The actions for a batch of observations, without exploration.

        Args:
            observations: As the task gives them: world frame, [m] and [rad]. Shape (B, observation_dim), or a
                dictionary with such a `state` and the images of `sight`.

        Returns:
            In units of the environment, [m] and [rad]. Shape (B, action_dim).

        Raises:
            InvalidInputError: The observations have another shape.
        """
        state = state_of(observations)
        if state.ndim != 2 or state.shape[1] != self.observation_dim:
            raise InvalidInputError(
                f"observations must have shape (B, {self.observation_dim}), got {tuple(state.shape)}"
            )
        if (sight := self.sight) is not None:
            check_images(images_of(observations), sight, len(state))
        with torch.no_grad():
            seen = self.normalizer(state)
            if self.encoder is not None:
                seen = torch.cat((seen, self.encoder(images_of(observations))), dim=-1)
            actions: Tensor = self.actor(seen) * self.action_scale
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
    if env_id is not None and not is_same_task(data["env_id"], env_id):
        raise CheckpointError(
            f"{path} was trained on {data['env_id']}, not on {env_id}; give a policy of this task (`maniskill-tomato "
            "eval` tries any with --allow-other-task)"
        )
    try:
        (observation_dim,) = data["observation"]["shape"]
        scale = data["action"]["scale"]
        encoder = _encoder(data, device)
        features = 0 if encoder is None else encoder.features
        hidden = tuple(data["config"]["actor_hidden"])
        actor = Actor(observation_dim + features, len(scale), hidden).to(device)
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
        encoder=encoder,
    )


def sight_of(config: Mapping[str, Any]) -> Sight | None:
    """What a training with some options observed as images; None for state vectors alone.

    Args:
        config: As `learning.rl.train_config.TrainConfig.to_dict` writes it, of any version.
    """
    images = ImageLayout.parse(config.get("obs_mode", STATE_MODE), config.get("image_size", (64, 48)))
    if images is None:
        return None
    return Sight(images=images, frames=int(config["frame_stack"]), state_parts=tuple(config["state_parts"]))


def _encoder(data: Mapping[str, Any], device: torch.device | str) -> ImageEncoder | None:
    """The encoder of a checkpoint that has one."""
    sight = sight_of(data["config"])
    if sight is None:
        return None
    encoder = ImageEncoder(sight.images, sight.frames, int(data["config"]["image_features"])).to(device)
    fill_network(encoder, data["encoder"])
    return encoder.eval().requires_grad_(False)


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
