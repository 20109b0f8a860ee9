"""The benchmark: policies on the same held-out episodes, in several processes, to be stopped and gone on with."""

import logging
import multiprocessing
import os
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym

import maniskill_tomato
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.experiments.benchmark_conditions import Condition
from maniskill_tomato.experiments.benchmark_policies import PolicySpec
from maniskill_tomato.experiments.benchmark_store import EpisodeStore
from maniskill_tomato.experiments.view_episode import ViewEpisode
from maniskill_tomato.experiments.view_rollout import run_view_episode
from maniskill_tomato.learning.rl.envs import make_env

logger = logging.getLogger(__name__)

BLOCK = 5
"""Episodes that one process runs before it hands them over, each with every policy: a plant grows once for all."""

LINE_SECONDS = 15.0
"""How often progress is told."""


@dataclass(frozen=True, kw_only=True)
class BenchmarkConfig:
    """What to run."""

    policies: tuple[PolicySpec, ...]
    conditions: tuple[Condition, ...]
    episodes: dict[str, int]
    """Number of episodes by condition."""
    seed: int = 0
    """The first episode; the others follow."""
    env_id: str = "TomatoViewpoint-v1"
    jobs: int = 1
    """Processes at a time."""
    contact_free_oracle: bool = False
    """Whether the oracle avoids the plant."""
    env_options: dict[str, Any] = field(default_factory=dict)
    """Options for `gymnasium.make` in every condition."""

    def __post_init__(self) -> None:
        if self.jobs < 1:
            raise InvalidInputError(f"jobs must be 1 or more, got {self.jobs}")
        if self.seed < 0:
            raise InvalidInputError(f"seed must be 0 or more, got {self.seed}")
        for condition in self.conditions:
            if self.episodes.get(condition.name, 0) < 1:
                raise InvalidInputError(
                    f"episodes must be 1 or more for every condition, got {self.episodes}"
                )

    def numbers(self, condition: Condition) -> range:
        """The episodes of a condition."""
        return range(self.seed, self.seed + self.episodes[condition.name])

    def settings(self) -> dict[str, Any]:
        """What every stored episode depends on."""
        return {
            "env_id": self.env_id,
            "package_version": maniskill_tomato.__version__,
            "contact_free_oracle": self.contact_free_oracle,
            "env_options": self.env_options,
        }


def run_benchmark(config: BenchmarkConfig, store: EpisodeStore) -> None:
    """Runs all episodes that the store does not have yet.

    Stopped at any time, a second call goes on; at most `BLOCK` episodes of each process are run again.

    Args:
        config: What to run.
        store: Where the episodes go.
    """
    blocks = list(_missing_blocks(config, store))
    total = sum(len(block["numbers"]) * len(block["policies"]) for block in blocks)
    if not total:
        return
    logger.info("%d episodes to run", total)
    started, told, done = time.monotonic(), 0.0, 0
    for block, results in _results(blocks, config.jobs):
        for label, episodes in results.items():
            store.add(block["condition"]["name"], label, [ViewEpisode.from_json(e) for e in episodes])
            done += len(episodes)
        if time.monotonic() - told > LINE_SECONDS:
            told = time.monotonic()
            left = (told - started) / done * (total - done)
            logger.info("%d of %d episodes, about %.0f minutes left", done, total, left / 60.0)


def run_block(block: dict[str, Any]) -> dict[str, list[dict[str, Any]]]:
    """Runs some episodes with some policies, in whatever process this is.

    Args:
        block: Plain values as `_missing_blocks` makes them.

    Returns:
        The episodes of each policy, ready for JSON.
    """
    env = _environment(block["env_id"], block["options"])
    oracle = _known_moves(block["condition"]["episode_list"])
    results: dict[str, list[dict[str, Any]]] = {}
    for text, numbers in zip(block["policies"], block["missing"], strict=True):
        spec = PolicySpec(**{**text, "path": None if text["path"] is None else Path(text["path"])})
        policy = _policy(spec, env, block["contact_free"])
        results[spec.label] = [
            run_view_episode(env, policy, number, oracle_moves=oracle(number)).to_json() for number in numbers
        ]
    return results


def _missing_blocks(config: BenchmarkConfig, store: EpisodeStore) -> Iterator[dict[str, Any]]:
    """The episodes still to run, in parts that a process can do by itself."""
    for condition in config.conditions:
        numbers = config.numbers(condition)
        missing = {
            spec.label: set(store.missing(condition.name, spec.label, numbers)) for spec in config.policies
        }
        for first in range(numbers.start, numbers.stop, BLOCK):
            block = range(first, min(first + BLOCK, numbers.stop))
            specs = [spec for spec in config.policies if missing[spec.label].intersection(block)]
            if not specs:
                continue
            yield {
                "env_id": config.env_id,
                "options": {**config.env_options, **condition.env_options},
                "contact_free": config.contact_free_oracle,
                "condition": asdict(condition),
                "numbers": list(block),
                "policies": [
                    {**asdict(spec), "path": None if spec.path is None else str(spec.path)} for spec in specs
                ],
                "missing": [sorted(missing[spec.label].intersection(block)) for spec in specs],
            }


def _results(
    blocks: Sequence[dict[str, Any]], jobs: int
) -> Iterator[tuple[dict[str, Any], dict[str, list[dict[str, Any]]]]]:
    """What becomes of each block, as it becomes known."""
    if jobs == 1:
        for block in blocks:
            yield block, run_block(block)
        return
    # A forked child would share Warp's and the simulator's state with this process.
    context = multiprocessing.get_context("spawn")
    waiting = list(reversed(blocks))
    running: dict[Future[Any], dict[str, Any]] = {}
    with ProcessPoolExecutor(min(jobs, len(blocks)), mp_context=context, initializer=_start_process) as pool:
        try:
            while waiting or running:
                while waiting and len(running) < jobs:
                    block = waiting.pop()
                    running[pool.submit(run_block, block)] = block
                finished, _ = wait(running, return_when=FIRST_COMPLETED)
                for future in finished:
                    yield running.pop(future), future.result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def _start_process() -> None:
    """One thread a process: they are as many as there are cores."""
    import torch

    os.environ["OMP_NUM_THREADS"] = "1"
    torch.set_num_threads(1)
    logging.basicConfig(level=logging.WARNING)


_kept: dict[str, Any] = {}
"""The environment of this process and its policies; a new condition replaces them."""


def _environment(env_id: str, options: dict[str, Any]) -> gym.Env[Any, Any]:
    key = repr((env_id, sorted(options.items(), key=str)))
    if _kept.get("key") != key:
        if "env" in _kept:
            _kept["env"].close()
        _kept.clear()
        _kept.update(key=key, env=make_env(env_id, **options), policies={})
    env: gym.Env[Any, Any] = _kept["env"]
    return env


def _policy(spec: PolicySpec, env: gym.Env[Any, Any], contact_free: bool) -> Any:
    policies = _kept["policies"]
    key = (spec, contact_free)
    if key not in policies:
        policies[key] = spec.make(env, contact_free)
    return policies[key]


def _known_moves(episode_list: str | None) -> Any:
    """The oracle's moves by episode number."""
    if episode_list is None:
        return lambda number: None
    from maniskill_tomato.plants.episode_list import load_episodes

    episodes = load_episodes(episode_list)
    return lambda number: episodes[number % len(episodes)].oracle_moves
