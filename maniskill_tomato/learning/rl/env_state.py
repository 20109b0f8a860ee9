"""The state of a learner's environments in the middle of their episodes, with every random generator of theirs."""

import logging
from collections.abc import Callable, Mapping
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor

from maniskill_tomato.errors import CheckpointError
from maniskill_tomato.tasks.numpy_streams import random_state, set_random_state

logger = logging.getLogger(__name__)


@runtime_checkable
class KeepsState(Protocol):
    """An environment that describes its own state."""

    def get_run_state(self) -> dict[str, Any]:
        """Everything that decides how it goes on: tensors, numbers, text, lists and dictionaries."""
        ...

    def set_run_state(self, state: dict[str, Any]) -> None:
        """Takes back what `get_run_state` gave."""
        ...


def env_state(env: object) -> dict[str, Any] | None:
    """The state of `env` as plain data, or None where it cannot be known."""
    return env.get_run_state() if isinstance(env, KeepsState) else None


def shell_state(shell: Any) -> dict[str, Any]:
    """The state of ManiSkill's shell as plain data.

    It is the world's, completed by the joints' speeds, step counters, and the seeds and generators that the world's
    follow from.
    """
    return {
        "world": shell.world.save(),
        "qvel": shell.agent.robot.get_qvel().cpu().clone(),
        "elapsed_steps": shell._elapsed_steps.cpu().clone(),
        "reconfig_counter": int(shell._reconfig_counter),
        "main_seed": [int(seed) for seed in shell._main_seed],
        "episode_seed": [int(seed) for seed in shell._episode_seed],
        "main_rng": random_state(shell._main_rng),
        "batched_main_rng": [random_state(rng) for rng in shell._batched_main_rng.rngs],
    }


def set_env_state(env: object, state: dict[str, Any] | None) -> None:
    """Puts `env`, made with the same options, where it was; its global random generators are left to the caller.

    Raises:
        CheckpointError: The environment's state was not saved.
    """
    if state is None or not isinstance(env, KeepsState):
        raise CheckpointError(
            "this run's environment does not tell its state, so that the run cannot be continued; "
            "give it get_run_state and set_run_state"
        )
    env.set_run_state(state)


def set_shell_state(shell: Any, state: dict[str, Any], reset: Callable[..., Any]) -> None:
    """Puts ManiSkill's shell where it was.

    Args:
        shell: Made with the same options.
        state: What `shell_state` gave.
        reset: Resets it, by a seed a row and options.
    """
    if shell.motion == "dynamic":
        logger.warning(
            "the physics engine keeps numbers that cannot be saved; last digits may differ from here on"
        )
    # An episode is begun from the same seed, so that the scene holds its plants, and then moved on.
    options = {"reconfigure": True} if shell.reconfiguration_freq else {}
    reset(seed=list(state["episode_seed"]), options=options)
    shell.restore_world(state["world"], state["qvel"])
    shell._elapsed_steps[:] = state["elapsed_steps"].to(shell.device)
    shell._reconfig_counter = state["reconfig_counter"]
    shell._main_seed = list(state["main_seed"])
    set_random_state(shell._main_rng, state["main_rng"])
    for rng, saved in zip(shell._batched_main_rng.rngs, state["batched_main_rng"], strict=True):
        set_random_state(rng, saved)


def tensor_attributes(thing: object) -> dict[str, Tensor | int | float | bool | None]:
    """What an object such as an exploration remembers: its attributes that are tensors or numbers."""
    return {
        name: value.detach().cpu().clone() if isinstance(value, Tensor) else value
        for name, value in vars(thing).items()
        if value is None or isinstance(value, Tensor | bool | int | float)
    }


def set_tensor_attributes(
    thing: object, values: Mapping[str, Tensor | int | float | bool | None], device: torch.device
) -> None:
    """Gives `thing` back what `tensor_attributes` found.

    Raises:
        KeyError: `thing` has no such attribute.
    """
    for name, value in values.items():
        if name not in vars(thing):
            raise KeyError(name)
        setattr(thing, name, value.to(device) if isinstance(value, Tensor) else value)
