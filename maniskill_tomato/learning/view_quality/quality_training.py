"""From nothing to a view-quality policy: rounds of episodes and fits, kept in a folder and continued from there."""

import hashlib
import json
import time
from collections.abc import Callable
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from torch import Tensor

import maniskill_tomato
from maniskill_tomato.errors import CheckpointError
from maniskill_tomato.files import write_atomically
from maniskill_tomato.learning.blocks import Block, begin_training, run_blocks
from maniskill_tomato.learning.rl.envs import make_env
from maniskill_tomato.learning.view_quality.quality_config import VALIDATION_SEED, QualityTrainConfig
from maniskill_tomato.learning.view_quality.quality_episodes import QualityData, collect_episodes
from maniskill_tomato.learning.view_quality.quality_fit import fit
from maniskill_tomato.policies.quality_network import ViewQualityNetwork
from maniskill_tomato.policies.view_quality import ViewQuality, load_view_quality, save_view_quality

ENV_ID = "TomatoViewpoint-v1"


def train_view_quality(
    out: Path,
    config: QualityTrainConfig | None = None,
    jobs: int = 1,
    env_options: dict[str, Any] | None = None,
    report: Callable[[str], None] = lambda line: None,
    start_from: Path | None = None,
) -> Path:
    """Trains, or goes on with the training in a folder.

    Args:
        out: Folder of the data, the log and the networks.
        config: How; the folder's own on a training that goes on.
        jobs: Processes that run episodes.
        env_options: Options of the task beside its plants' split.
        report: Told one line after every block and every 200 batches.
        start_from: A policy whose network leads the first round too, and that the first fit goes on from.

    Returns:
        File of the last round's policy, `policy.pt`.

    Raises:
        InvalidInputError: The folder holds a training with another configuration.
        CheckpointError: `start_from` cannot be read.
    """
    config = config or QualityTrainConfig()
    network: ViewQualityNetwork | None = None
    settings: dict[str, Any] = {"config": asdict(config), "env_options": env_options or {}}
    if start_from is not None:
        network = load_view_quality(start_from).network
        settings["start_from"] = hashlib.sha256(start_from.read_bytes()).hexdigest()
    begin_training(out, settings)
    start = time.perf_counter()
    options = env_options or {}
    count = -(-config.validation_episodes // config.block)
    validation_plan = [
        _block(
            out / f"validation-{b}.pt",
            VALIDATION_SEED + b * config.block,
            config.block,
            "validation",
            None,
            options,
        )
        for b in range(count)
    ]
    plan: list[Block] = []
    for number, episodes in enumerate(config.rounds):
        policy_path = out / f"round-{number}.pt"
        before = start_from if number == 0 else out / f"round-{number - 1}.pt"
        first = (config.seed * len(config.rounds) + number) * max(config.rounds)
        plan += [
            _block(
                out / f"train-{number}-{b}.pt",
                first + b * config.block,
                config.block,
                "train",
                # A quarter of the blocks meets new plants only.
                None if b % 4 == 3 else config.pool,
                options,
                before,
            )
            for b in range(-(-episodes // config.block))
        ]
        if policy_path.is_file():
            network = load_view_quality(policy_path).network
            continue
        run_blocks([*validation_plan, *plan], jobs, report)
        data, validation = _load(plan), _load(validation_plan)
        report(f"round {number}: {len(data.scalars)} looks in {len(data.reachable)} episodes")
        network = fit(
            data,
            config.fit,
            validation,
            lambda step, values: report(
                f"batch {step}: " + ", ".join(f"{name} {value:.4g}" for name, value in values.items())
            ),
            network,
        )
        facts = {
            "env_id": ENV_ID,
            "env_options": json.dumps(env_options or {}),
            "package_version": maniskill_tomato.__version__,
            "looks": len(data.scalars),
            "episodes": len(data.reachable),
            "seconds": round(time.perf_counter() - start, 1),
            "seed": config.seed,
        }
        save_view_quality(policy_path, ViewQuality(network, facts=facts))
    path = out / "policy.pt"
    write_atomically(path, (out / f"round-{len(config.rounds) - 1}.pt").read_bytes())
    return path


def _block(
    path: Path,
    first: int,
    episodes: int,
    split: str,
    pool: int | None,
    options: dict[str, Any],
    policy: Path | None = None,
) -> Block:
    return Block(path=path, make=_collect, arguments=(first, episodes, split, pool, options, policy))


def _collect(
    first: int, episodes: int, split: str, pool: int | None, options: dict[str, Any], policy: Path | None
) -> dict[str, Tensor]:
    """Episodes of seeds from `first` on, in whatever process this is."""
    network = None if policy is None else load_view_quality(policy).network
    plant = {"seed": split, "pool": pool, **dict(options.get("plant", {}))}
    env = make_env(ENV_ID, **{**options, "plant": plant})
    try:
        data = collect_episodes(env, range(first, first + episodes), network)
    finally:
        env.close()
    return {f.name: getattr(data, f.name) for f in fields(QualityData)}


def _load(blocks: list[Block]) -> QualityData:
    parts = []
    for block in blocks:
        try:
            parts.append(QualityData(**block.read()))
        except TypeError as error:
            raise CheckpointError(f"{block.path} holds no looks: {error}; delete it and go on") from error
    return QualityData.join(parts)
