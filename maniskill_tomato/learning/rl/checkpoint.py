"""What a checkpoint holds: weights with everything needed to use them."""

import json
from typing import Any

import torch
from torch import Tensor

import maniskill_tomato
from maniskill_tomato.learning.rl.agent import Agent
from maniskill_tomato.policies.layout import layout_of
from maniskill_tomato.policies.trained_actor import FORMAT, sight_of

TRAINING_PARTS = (
    "critics",
    "target_actor",
    "target_critics",
    "actor_optimizer",
    "critic_optimizer",
    "statistics",
    "heads",
)
"""Parts of an agent that only its further training needs."""


def make_checkpoint(
    agent: Agent,
    env_id: str,
    action_bounds: tuple[Tensor, Tensor],
    counters: dict[str, int | float],
    with_training_state: bool = True,
    run: dict[str, Any] | None = None,
    env_options: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """What a checkpoint file holds: tensors, numbers and strings only, so that it loads without running code.

    Args:
        agent: Its weights.
        env_id: The task that it was trained on.
        action_bounds: Low and high of the environment's action space. Each of shape (action_dim,).
        counters: Steps, episodes, updates, seconds, seed.
        with_training_state: Also keep critics, target networks and optimisers; a policy to be used needs none
            of them.
        run: What else a run needs to go on exactly, kept under `run`; see `Trainer`.
        env_options: The options that the task was made with, as JSON can hold them; none were given if empty,
            None if that is not known.
    """
    low, high = action_bounds
    scale = torch.tensor(agent.config.action_scale)
    observation_dim = len(agent.normalizer.centre)
    layout = layout_of(env_id, sight_of(agent.config.to_dict()))
    data: dict[str, Any] = {
        "format": FORMAT,
        "package_version": maniskill_tomato.__version__,
        "env_id": env_id,
        "config": agent.config.to_dict(),
        "observation": {
            "names": _names(layout.observation_names, observation_dim),
            "shape": [observation_dim],
            "frame": layout.frame,
            "units": _units(layout.observation_units),
        },
        "action": {
            "names": _names(layout.action_names, len(scale)),
            "low": low.cpu(),
            "high": high.cpu(),
            "scale": scale,
            "units": _units(layout.action_units),
        },
        "normalizer": agent.normalizer.state_dict(),
        "actor": agent.actor.state_dict(),
        "counters": counters,
    }
    if agent.encoder is not None:
        data["encoder"] = agent.encoder.state_dict()
    if env_options is not None:
        data["env_options"] = json.loads(json.dumps(env_options))
    if with_training_state:
        for name in TRAINING_PARTS:
            data[name] = getattr(agent, name).state_dict()
    if run is not None:
        data["run"] = run
    return data


def _names(names: tuple[str, ...], count: int) -> list[str]:
    """The documented names, or numbered ones for spaces of another size."""
    return list(names) if len(names) == count else [f"value_{i}" for i in range(count)]


def _units(units: tuple[str, ...]) -> str:
    return ", ".join(dict.fromkeys(units))
