"""Episodes of a viewpoint policy on a task that tells its belief."""

import time
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.experiments.view_episode import ViewEpisode
from maniskill_tomato.policies.protocol import Policy, reseed
from maniskill_tomato.robot.inverse_kinematics import Reach

Reset = Callable[[gym.Env[Any, Any], int], Any]
"""Starts the episode with a number."""


def reset_to_seed(env: gym.Env[Any, Any], episode: int) -> Any:
    """Starts the episode of a seed, which is the one of that number where the environment has a list."""
    return env.reset(seed=episode)


def run_view_episode(
    env: gym.Env[Any, Any],
    policy: Policy,
    episode: int,
    reset: Reset = reset_to_seed,
    oracle_moves: int | None = None,
) -> ViewEpisode:
    """One episode, without exploration.

    A policy with `reseed` draws the same random numbers in the same episode, whatever it did before.

    Args:
        env: A single environment whose `unwrapped` has `belief` and the agent.
        policy: Chooses the moves.
        episode: Number of the episode.
        reset: How to start it.
        oracle_moves: Fewest moves known for it.

    Raises:
        InvalidInputError: The environment simulates several at once.
    """
    world: Any = env.unwrapped
    if int(getattr(world, "num_envs", 1)) != 1:
        raise InvalidInputError(
            f"episodes are run one at a time; make the environment with num_envs=1, not {world.num_envs}"
        )
    reseed(policy, episode)
    _, info = reset(env, episode)
    policy.begin(world.belief, torch.zeros(1, dtype=torch.int64, device=world.device))
    views, moves = [_view(world, info)], []
    done = False
    while not done:
        start = time.perf_counter()
        action = policy.act(world.belief)
        decision_ms = 1e3 * (time.perf_counter() - start)
        _, _, terminated, truncated, info = env.step(action)
        views.append(_view(world, info))
        moves.append(
            (
                _number(info["reachability"]) == int(Reach.UNREACHABLE),
                bool(_number(info["plant_contact"])) if "plant_contact" in info else False,
                _number(info["clearance"]) if "clearance" in info else np.nan,
                decision_ms,
            )
        )
        done = bool(_number(terminated)) or bool(_number(truncated))
    seen, camera, qpos = (np.stack(values) for values in zip(*views, strict=True))
    refused, contact, clearance, decisions = (np.array(values) for values in zip(*moves, strict=True))
    return ViewEpisode(
        episode=episode,
        success=bool(_number(info["success"])),
        visible_fraction=seen,
        camera=camera,
        qpos=qpos,
        target=world.belief.target_position[0].double().cpu().numpy(),
        refused=refused.astype(np.bool_),
        contact=contact.astype(np.bool_),
        clearance=clearance.astype(np.float64),
        decision_ms=decisions.astype(np.float64),
        oracle_moves=oracle_moves,
    )


def run_view_episodes(
    env: gym.Env[Any, Any],
    policy: Policy,
    episodes: Sequence[int],
    reset: Reset = reset_to_seed,
    oracle_moves: Callable[[int], int | None] = lambda episode: None,
) -> list[ViewEpisode]:
    """Several episodes, one after the other; see `run_view_episode`."""
    return [run_view_episode(env, policy, i, reset, oracle_moves(i)) for i in episodes]


def _view(world: Any, info: dict[str, Any]) -> tuple[Any, Any, Any]:
    camera = world.belief.camera_position[0].double().cpu().numpy()
    qpos = world.agent.robot.get_qpos()[0].double().cpu().numpy()
    return np.float64(_number(info["visible_fraction"])), camera.copy(), qpos.copy()


def _number(value: Any) -> float:
    """The one entry of a tensor, or the number itself."""
    return float(value.reshape(-1)[0]) if isinstance(value, Tensor | np.ndarray) else float(value)
