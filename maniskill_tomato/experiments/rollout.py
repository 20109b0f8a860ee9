"""The loop that runs episodes of any task and records them."""

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
from torch import Tensor
from tqdm import tqdm

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.experiments.episode_record import EpisodeRecord, Float64, RowSearch
from maniskill_tomato.policies.adapters import as_state_policy
from maniskill_tomato.policies.opening import RANDOM
from maniskill_tomato.policies.protocol import Policy, RandomPlanner, StatePolicy, reseed
from maniskill_tomato.sensing.inspection_judge import JudgedFruit, truly_seen


class Watcher(Protocol):
    """Follows the episodes while they are run, for instance to film them."""

    def view(self, info: dict[str, Any], done: bool) -> None:
        """Called at every view, the first one included.

        Args:
            info: Of the reset or of the step that led here.
            done: Whether the episode ends here.
        """


def run_episodes(
    env: gym.Env[Any, Any],
    policy: Policy | StatePolicy,
    episodes: int,
    seed: int,
    show_progress: bool = False,
) -> list[EpisodeRecord]:
    """Runs `episodes` episodes without exploration; episode i starts from the seed `seed + i`.

    In a single environment a policy that draws random numbers draws them from that seed, too, so that an episode that
    is run again by itself is the same.

    Args:
        env: One or several environments that do not reset themselves.
        policy: Chooses the actions.
        episodes: How many to run, 1 or more.
        seed: Seed of the first one, 0 or more.
        show_progress: Whether to draw a progress bar.

    Returns:
        The episodes in the order of their seeds.

    Raises:
        InvalidInputError: `episodes` or `seed` is out of range.
    """
    if episodes < 1:
        raise InvalidInputError(f"episodes must be 1 or more, got {episodes}")
    if not 0 <= seed <= 2**31 - 1 - episodes:
        raise InvalidInputError(f"seed must be from 0 to {2**31 - 1 - episodes}, got {seed}")
    num_envs = int(getattr(env.unwrapped, "num_envs", 1))
    done: list[EpisodeRecord] = []
    interval = 0.5 if sys.stderr.isatty() else 10.0
    with tqdm(
        total=episodes, desc="evaluating", unit="episode", disable=not show_progress, mininterval=interval
    ) as bar:
        while len(done) < episodes:
            first = seed + len(done)
            if num_envs == 1:
                batch = [run_episode(env, policy, first)]
            else:
                batch = run_batch(env, policy, range(first, first + num_envs))
            new = batch[: episodes - len(done)]
            done += new
            bar.set_postfix_str(f"success {sum(e.success for e in done) / len(done):.0%}", refresh=False)
            bar.update(len(new))
    return done


def open_widest(
    make: Callable[[int], tuple[gym.Env[Any, Any], Policy]], num_envs: int
) -> tuple[gym.Env[Any, Any], Policy]:
    """Environments with their policy: `num_envs` of them, or one for a policy that draws random numbers.

    Such a policy draws in the order of its decisions, so that other episodes would come of several environments.

    Args:
        make: Makes a number of environments and opens the policy for them.
        num_envs: How many are wanted.
    """
    env, policy = make(num_envs)
    draws = isinstance(policy, RandomPlanner) or policy.name == RANDOM
    return make(1) if draws and num_envs > 1 else (env, policy)


def run_listed(
    env: gym.Env[Any, Any],
    policy: Policy | StatePolicy,
    seeds: Sequence[int],
    oracle_moves: Callable[[int], int | None] = lambda seed: None,
) -> list[EpisodeRecord]:
    """Runs episodes of any seeds, as many at once as there are environments; see `run_episode`."""
    num_envs = int(getattr(env.unwrapped, "num_envs", 1))
    if num_envs == 1:
        return [run_episode(env, policy, seed, oracle_moves=oracle_moves(seed)) for seed in seeds]
    done: list[EpisodeRecord] = []
    for first in range(0, len(seeds), num_envs):
        batch = list(seeds[first : first + num_envs])
        filled = batch + batch[-1:] * (num_envs - len(batch))
        moves = [oracle_moves(seed) for seed in filled]
        done += run_batch(env, policy, filled, oracle_moves=moves)[: len(batch)]
    return done


def run_episode(
    env: gym.Env[Any, Any],
    policy: Policy | StatePolicy,
    seed: int,
    *,
    oracle_moves: int | None = None,
    watcher: Watcher | None = None,
) -> EpisodeRecord:
    """One episode of one environment, whatever came before it: a policy with `reseed` draws from its seed.

    Args:
        env: A single environment.
        policy: Chooses the actions.
        seed: Of the reset; the number of the episode where the environment has a fixed list.
        oracle_moves: Fewest moves known for it.
        watcher: Follows it.

    Raises:
        InvalidInputError: The environment simulates several at once.
    """
    num_envs = int(getattr(env.unwrapped, "num_envs", 1))
    if num_envs != 1:
        raise InvalidInputError(
            f"episodes are run one at a time; make the environment with num_envs=1, not {num_envs}"
        )
    reseed(policy, seed)
    (record,) = run_batch(env, policy, [seed], oracle_moves=[oracle_moves], watcher=watcher)
    return record


def run_batch(
    env: gym.Env[Any, Any],
    policy: Policy | StatePolicy,
    seeds: Sequence[int],
    *,
    oracle_moves: Sequence[int | None] | None = None,
    watcher: Watcher | None = None,
) -> list[EpisodeRecord]:
    """One episode in each of B parallel environments; those that end early wait for the others.

    Args:
        env: B environments that do not reset themselves.
        policy: Chooses the actions.
        seeds: Of the resets. Length B.
        oracle_moves: Fewest moves known for each episode. Length B.
        watcher: Follows them.
    """
    world: Any = env.unwrapped
    observations, info = env.reset(seed=seeds[0] if len(seeds) == 1 else list(seeds))  # type: ignore[arg-type]
    acting = as_state_policy(policy, env)
    # Of all tasks that search for fruits, a row alone tells of every step whether its target is done.
    searches = "target_done" in info
    targets = [world.open_targets(i) if searches else () for i in range(len(seeds))]
    inspecting = getattr(world, "inspecting", None)
    lists: dict[int, tuple[dict[str, Any], ...]] = {}
    views, steps = [_view(world, observations, info)], []
    running = np.ones(len(seeds), dtype=np.bool_)
    success = np.zeros_like(running)
    threshold = float(world.task.full_visibility) if searches else 1.0
    if watcher is not None:
        watcher.view(info, False)
    while running.any():
        start = time.perf_counter()
        actions = acting.act(observations)
        decision_ms = 1e3 * (time.perf_counter() - start) / len(seeds)
        observations, reward, terminated, truncated, info = env.step(actions)
        views.append(_view(world, observations, info))
        steps.append(_step(reward, info, running, decision_ms))
        success |= _array(info["success"]).astype(np.bool_) & running
        running &= ~(_array(terminated).astype(np.bool_) | _array(truncated).astype(np.bool_))
        if inspecting is not None:
            for i in set(np.flatnonzero(~running).tolist()) - set(lists):
                lists[i] = tuple(asdict(fruit) for fruit in inspecting.judged(i))
        if watcher is not None:
            watcher.view(info, not running.any())
    seen, happened = _stacked(views), _stacked(steps)
    records = []
    for i, seed in enumerate(seeds):
        count = int(happened["running"][:, i].sum())
        view = {name: values[: count + 1, i] for name, values in seen.items()}
        step = {name: values[:count, i] for name, values in happened.items()}
        records.append(
            EpisodeRecord(
                seed=int(seed),
                success=bool(success[i]),
                visible_fraction=view["visible_fraction"],
                viewpoints=view["viewpoint"],
                target=view["target"],
                rewards=step["reward"],
                reachability=step["reachability"].astype(np.int64),
                decision_ms=step["decision_ms"],
                camera=view.get("camera"),
                qpos=view.get("qpos"),
                in_forbidden_zone=_flags(step.get("in_forbidden_zone")),
                contact=_flags(step.get("plant_contact")),
                clearance=step.get("clearance"),
                true_visible_fraction=view.get("true_visible_fraction"),
                true_target=view.get("true_target"),
                chosen_visible_fraction=view.get("chosen_visible_fraction"),
                chosen_fruit=_indices(view.get("chosen_fruit")),
                target_fruit=_indices(view["target_fruit"]) if "chosen_fruit" in view else None,
                target_named=_flags(view.get("target_named")),
                oracle_moves=None if oracle_moves is None else oracle_moves[i],
                row=_row_search(targets[i], view, step, lists.get(i), threshold) if searches else None,
            )
        )
    return records


def _view(world: Any, observations: Any, info: dict[str, Any]) -> dict[str, Float64]:
    """What there is to keep of the present views, a row per environment."""
    view = {"visible_fraction": _array(info["visible_fraction"])}
    belief = getattr(world, "belief", None)
    if belief is None:
        view["viewpoint"], view["target"] = _array(observations[:, :6]), _array(observations[:, 6:9])
    else:
        view["viewpoint"], view["target"] = _array(belief.viewpoint), _array(belief.target_position)
        view["camera"] = _array(belief.camera_position)
    if belief is None and (inner := getattr(world, "world", None)) is not None:
        view["camera"] = _array(inner.T_w_camera[:, :3, 3])
    if (qpos := getattr(world, "qpos", None)) is not None:
        view["qpos"] = _array(qpos)
    if (true := info.get("true_visible_fraction")) is not None:
        view["true_visible_fraction"] = _array(true)
        view["true_target"] = _array(world.target_position_w)
    if "chosen_fruit" in info:
        for name in ("chosen_visible_fraction", "chosen_fruit", "target_named"):
            view[name] = _array(info[name])
    if (fruit := getattr(world, "target_fruit", None)) is not None:
        view["target_fruit"] = _array(fruit)
    return view


STEP_FACTS = (
    "reachability",
    "in_forbidden_zone",
    "plant_contact",
    "clearance",
    "target_done",
    "transits",
    "moves",
    "path_length",
    "joint_path_length",
)
"""Entries of a task's info that are kept of every step, where it has them."""


def _step(reward: Any, info: dict[str, Any], running: Any, decision_ms: float) -> dict[str, Float64]:
    facts = {name: _array(info[name]) for name in STEP_FACTS if name in info}
    count = len(running)
    return {
        "reward": np.broadcast_to(_array(reward), (count,)),
        "running": running.copy(),
        "decision_ms": np.full(count, decision_ms),
        **facts,
    }


def _row_search(
    targets: Sequence[int],
    view: dict[str, Float64],
    step: dict[str, Float64],
    listed: tuple[dict[str, Any], ...] | None,
    threshold: float,
) -> RowSearch:
    seen = {int(fruit) for fruit in view["target_fruit"][:-1][step["target_done"].astype(np.bool_)]}
    if listed is not None:
        # What the robot believes is not what it saw.
        seen = truly_seen([JudgedFruit(**entry) for entry in listed], threshold) & set(targets)
    return RowSearch(
        targets=tuple(int(fruit) for fruit in targets),
        seen=tuple(sorted(seen)),
        moves=int(step["moves"][-1]),
        transits=int(step["transits"].sum()),
        path_m=float(step["path_length"][-1]),
        joint_path_rad=float(step["joint_path_length"][-1]),
        listed=listed,
    )


def _stacked(parts: Sequence[dict[str, Float64]]) -> dict[str, Float64]:
    return {name: np.stack([part[name] for part in parts]) for name in parts[0]}


def _flags(values: Float64 | None) -> Any:
    return None if values is None else values.astype(np.bool_)


def _indices(values: Float64 | None) -> Any:
    return None if values is None else values.astype(np.int64)


def _array(values: Any) -> Float64:
    """A copy as an array of numbers, whatever device they are on."""
    if isinstance(values, Tensor):
        values = values.detach().double().cpu().numpy()
    return np.atleast_1d(np.array(values, dtype=np.float64))
