"""Policies on the same episodes under several conditions, in several processes, to be stopped and gone on with."""

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
from tqdm import tqdm

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.experiments.episode_record import EpisodeRecord
from maniskill_tomato.experiments.result_store import ResultStore, fingerprint
from maniskill_tomato.experiments.rollout import open_widest, run_listed
from maniskill_tomato.experiments.stored_episodes import about_condition
from maniskill_tomato.extension_points import is_import_path, source_file
from maniskill_tomato.learning.rl.envs import make_env
from maniskill_tomato.policies.opening import find_policy, needs_colours, open_policy
from maniskill_tomato.policies.protocol import Policy
from maniskill_tomato.policies.registry import policy_names
from maniskill_tomato.worker_pool import run_jobs

logger = logging.getLogger(__name__)

BLOCK = 5
"""Episodes that one process runs before it hands them over, each with every policy: a plant grows once for all."""

LINE_SECONDS = 15.0
"""How often progress is told."""


@dataclass(frozen=True, kw_only=True)
class PolicySpec:
    """One policy as the command line names it."""

    label: str
    """Its name in tables and files."""
    source: str
    """What `open_policy` opens: a name or a file."""

    @classmethod
    def parse(cls, text: str) -> "PolicySpec":
        """Reads `NAME`, `FILE` or `LABEL=FILE`.

        Raises:
            PolicyError: There is no such name and no such file.
        """
        label, _, source = text.rpartition("=")
        found = find_policy(source)
        where = found if isinstance(found, str) else str(found.resolve())
        return cls(label=label or label_of(found), source=where)

    @property
    def fingerprint(self) -> str:
        """Says whether stored episodes are of this policy: its name, or the hash of its file or of its module."""
        path = Path(self.source)
        if path.is_file():
            return f"file:{fingerprint(path)}"
        module = source_file(self.source) if is_import_path(self.source) else None
        return self.source if module is None else f"{self.source} {fingerprint(module)}"


def label_of(found: str | Path) -> str:
    """What a policy is called that has no other label: its name, or its file's; `policy.pt` is called as its folder."""
    if isinstance(found, str):
        return found
    return found.parent.name if found.stem == "policy" and found.parent.name else found.stem


def parse_policies(text: str) -> list[PolicySpec]:
    """Reads a list with commas.

    Raises:
        InvalidInputError: It is empty, or two have the same label.
        PolicyError: There is no such policy.
    """
    specs = [PolicySpec.parse(part.strip()) for part in text.split(",") if part.strip()]
    if not specs:
        raise InvalidInputError(
            f"give one policy or more, with commas between them, such as {', '.join(policy_names())}"
        )
    labels = [spec.label for spec in specs]
    for label in labels:
        if labels.count(label) > 1:
            raise InvalidInputError(f"two policies are called {label!r}; name them as LABEL=FILE")
    return specs


@dataclass(frozen=True, kw_only=True)
class Condition:
    """What some episodes have in common."""

    name: str
    env_id: str = "TomatoViewpoint-v1"
    env_options: dict[str, Any] = field(default_factory=dict)
    """Options for `gymnasium.make` beside the defaults; plain JSON values."""
    contact_free: bool = False
    """Whether the oracle avoids the plant."""
    axis: str | None = None
    """Which sweep it belongs to."""
    value: float | None = None
    """Where it stands on that axis."""
    episode_list: str | None = None
    """Name of a fixed list; None draws each episode from its seed."""


@dataclass(frozen=True, kw_only=True)
class EpisodeBlock:
    """Some episodes under one condition, for a process to run by itself."""

    condition: Condition
    missing: tuple[tuple[PolicySpec, tuple[int, ...]], ...]
    """The episodes that each policy still has to run."""
    num_envs: int = 1
    """Environments stepped at once."""

    @property
    def episodes(self) -> int:
        return sum(len(numbers) for _, numbers in self.missing)


def run_policies(
    store: ResultStore,
    plan: Sequence[tuple[Condition, Sequence[PolicySpec], range]],
    processes: int,
    num_envs: int = 1,
) -> None:
    """Runs all episodes that the store does not have yet.

    Stopped at any time, a second call goes on; at most one block of each process is run again.

    Args:
        store: Where the episodes go: the condition's name is the part, the policy's label the name.
        plan: Policies and numbers of episodes under each condition.
        processes: How many at a time.
        num_envs: Environments that each steps at once.
    """
    for condition, specs, _ in plan:
        describe_condition(store, condition, specs)
    blocks = [block for part in plan for block in _missing_blocks(store, *part, num_envs)]
    total = sum(block.episodes for block in blocks)
    if not total:
        return
    logger.info("%d episodes to run", total)
    started, told, done = time.monotonic(), 0.0, 0
    with tqdm(total=total, unit="episode", disable=None) as bar:
        for block, results in run_jobs(run_block, blocks, processes):
            for label, episodes in results.items():
                store.add_episodes(block.condition.name, label, episodes)
            bar.update(block.episodes)
            done += block.episodes
            # Where nobody watches a bar, a log gets a line now and then.
            if bar.disable and time.monotonic() - told > LINE_SECONDS:
                told = time.monotonic()
                left = (told - started) / done * (total - done)
                logger.info("%d of %d episodes, about %.0f minutes left", done, total, left / 60.0)


def describe_condition(store: ResultStore, condition: Condition, specs: Sequence[PolicySpec]) -> None:
    """Keeps with a condition's episodes what is needed to show them again, where that can be written down."""
    policies = dict(store.description(condition.name).get("policies", {}))
    policies |= {spec.label: spec.source for spec in specs}
    about = about_condition(condition.name, condition.env_id, condition.env_options, policies)
    if about is not None:
        store.describe(condition.name, about)


def run_block(block: EpisodeBlock) -> dict[str, list[EpisodeRecord]]:
    """Runs some episodes with some policies, in whatever process this is; the episodes by policy."""
    oracle = known_moves(block.condition.episode_list)
    return {
        spec.label: run_listed(*_opened(spec, block.condition, block.num_envs), numbers, oracle)
        for spec, numbers in block.missing
    }


def open_for(spec: PolicySpec, env: gym.Env[Any, Any], contact_free: bool = False) -> Policy:
    """The policy for an environment.

    Raises:
        PolicyError: It cannot be used there.
    """
    world: Any = env.unwrapped
    return open_policy(
        spec.source,
        env_id=None if env.spec is None else env.spec.id,
        ground_truth=getattr(world, "ground_truth", None),
        contact_free=contact_free,
        device=getattr(world, "device", "cpu"),
    )


def known_moves(episode_list: str | None) -> Callable[[int], int | None]:
    """The oracle's moves by number of the episode."""
    if episode_list is None:
        return lambda number: None
    from maniskill_tomato.plants.episode_list import load_episodes

    episodes = load_episodes(episode_list)
    return lambda number: episodes[number % len(episodes)].oracle_moves


def _missing_blocks(
    store: ResultStore, condition: Condition, specs: Sequence[PolicySpec], numbers: range, num_envs: int
) -> list[EpisodeBlock]:
    missing = {spec: set(store.missing(condition.name, spec.label, numbers)) for spec in specs}
    blocks, size = [], max(BLOCK, num_envs)
    for first in range(numbers.start, numbers.stop, size):
        some = range(first, min(first + size, numbers.stop))
        wanted = tuple((spec, tuple(n for n in some if n in missing[spec])) for spec in specs)
        if any(missing_here for _, missing_here in wanted):
            left = tuple(part for part in wanted if part[1])
            blocks.append(EpisodeBlock(condition=condition, missing=left, num_envs=num_envs))
    return blocks


_kept: dict[str, Any] = {}
"""The environments of this process and its policies; a new condition replaces them."""


def _opened(spec: PolicySpec, condition: Condition, num_envs: int) -> tuple[gym.Env[Any, Any], Policy]:
    """A policy with environments for it."""
    key = repr((condition.env_id, sorted(condition.env_options.items(), key=str)))
    if _kept.get("key") != key:
        for env in _kept.get("envs", {}).values():
            env.close()
        _kept.update(key=key, envs={}, policies={})
    envs: dict[tuple[int, bool], gym.Env[Any, Any]] = _kept["envs"]
    policies: dict[Any, tuple[gym.Env[Any, Any], Policy]] = _kept["policies"]

    colours = needs_colours(find_policy(spec.source))

    def make(count: int) -> tuple[gym.Env[Any, Any], Policy]:
        key = (count, colours)
        if key not in envs:
            envs[key] = make_env(condition.env_id, count, colours=colours, **condition.env_options)
        return envs[key], open_for(spec, envs[key], condition.contact_free)

    which = (spec, condition.contact_free, num_envs)
    if which not in policies:
        policies[which] = open_widest(make, num_envs)
    return policies[which]
