"""The state of a learner's environments in the middle of their episodes, with every random generator of theirs."""

import logging
from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor

from maniskill_tomato.errors import CheckpointError
from maniskill_tomato.learning.rl.envs import LearnerEnv
from maniskill_tomato.learning.rl.random_state import (
    generator_state,
    random_state,
    set_generator_state,
    set_random_state,
)

logger = logging.getLogger(__name__)


@runtime_checkable
class KeepsState(Protocol):
    """An environment that describes its own state; others than ManiSkill's can offer it."""

    def get_run_state(self) -> dict[str, Any]:
        """Everything that decides how it goes on: tensors, numbers, text, lists and dictionaries."""
        ...

    def set_run_state(self, state: dict[str, Any]) -> None:
        """Takes back what `get_run_state` gave."""
        ...


def seed_action_spaces(env: LearnerEnv, seed: int) -> None:
    """Makes what the action spaces of `env` draw repeatable; ManiSkill's reset leaves them unseeded."""
    base: Any = getattr(env, "base_env", None)
    if base is not None:
        base.action_space.seed(seed)
        base.single_action_space.seed(seed)


def env_state(env: LearnerEnv) -> dict[str, Any] | None:
    """The state of `env` as plain data, or None where it cannot be known.

    ManiSkill's own state is completed by its step counters, the seeds and generators of the run and of the
    episode, and the generators of the action spaces.
    """
    if isinstance(env, KeepsState):
        return env.get_run_state()
    base: Any = getattr(env, "base_env", None)
    if base is None:
        return None
    return {
        "sim": _map_tensors(base.get_state_dict(), "cpu"),
        "elapsed_steps": base._elapsed_steps.cpu().clone(),
        "reconfig_counter": int(base._reconfig_counter),
        "main_seed": [int(seed) for seed in base._main_seed],
        "episode_seed": [int(seed) for seed in base._episode_seed],
        "main_rng": random_state(base._main_rng),
        "batched_main_rng": [random_state(rng) for rng in base._batched_main_rng.rngs],
        "batched_episode_rng": [random_state(rng) for rng in base._batched_episode_rng.rngs],
        "action_space": generator_state(base.action_space.np_random),
        "single_action_space": generator_state(base.single_action_space.np_random),
    }


def set_env_state(env: LearnerEnv, state: dict[str, Any] | None) -> None:
    """Puts `env`, made with the same options, where it was; its global random generators are left to the caller.

    An episode is begun from the same seed, its plants are grown, and it is then moved on to the saved state.

    Raises:
        CheckpointError: The environment's state was not saved.
    """
    if state is None:
        raise CheckpointError(
            "this run's environment does not tell its state, so that the run cannot be continued; "
            "give it get_run_state and set_run_state"
        )
    if isinstance(env, KeepsState):
        env.set_run_state(state)
        return
    anything: Any = env
    base: Any = anything.base_env
    if getattr(base, "motion", None) == "dynamic":
        logger.warning(
            "the physics engine keeps numbers that cannot be saved; last digits may differ from here on"
        )
    options = {"reconfigure": True} if base.reconfiguration_freq else {}
    anything.reset(seed=list(state["episode_seed"]), options=options)
    if getattr(base, "_swaps_plants", False):
        for i, seed in enumerate(int(s) for s in state["sim"]["task"]["plant_seed"][:, 0]):
            if seed != base.planting.seeds[i]:
                base._ray_scene.replace_plant(i, base.planting.replace(i, seed))
    base.set_state_dict(_map_tensors(state["sim"], base.device))
    base._elapsed_steps[:] = state["elapsed_steps"].to(base.device)
    base._reconfig_counter = state["reconfig_counter"]
    base._main_seed = list(state["main_seed"])
    set_random_state(base._main_rng, state["main_rng"])
    for name in ("batched_main_rng", "batched_episode_rng"):
        rngs = getattr(base, f"_{name}").rngs
        for rng, saved in zip(rngs, state[name], strict=True):
            set_random_state(rng, saved)
    set_generator_state(base.action_space.np_random, state["action_space"])
    set_generator_state(base.single_action_space.np_random, state["single_action_space"])


def _map_tensors(tree: Mapping[str, Any], device: torch.device | str) -> dict[str, Any]:
    return {
        name: _map_tensors(value, device)
        if isinstance(value, Mapping)
        else torch.as_tensor(value).detach().to(device).clone()
        for name, value in tree.items()
    }


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
