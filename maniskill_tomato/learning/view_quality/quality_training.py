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
from maniskill_tomato.errors import CheckpointError, InvalidInputError
from maniskill_tomato.files import write_atomically
from maniskill_tomato.folder_lock import only_writer
from maniskill_tomato.learning.blocks import Block, begin_training, run_blocks
from maniskill_tomato.learning.rl.envs import make_env
from maniskill_tomato.learning.view_quality.quality_config import (
    SEEDS_A_PLANT,
    VALIDATION_SEED,
    QualityTrainConfig,
)
from maniskill_tomato.learning.view_quality.quality_episodes import QualityData, collect_episodes
from maniskill_tomato.learning.view_quality.quality_fit import fit, fit_blend
from maniskill_tomato.plants.seed_splits import SEED_SPLITS
from maniskill_tomato.policies.quality_network import ViewQualityNetwork
from maniskill_tomato.policies.view_quality import (
    ViewQuality,
    ViewQualityConfig,
    load_view_quality,
    save_view_quality,
)

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
        CheckpointError: `start_from` cannot be read, or another process trains in the folder.
    """
    with only_writer(out, "trains"):
        return _train(out, config or QualityTrainConfig(), jobs, env_options or {}, report, start_from)


def _train(
    out: Path,
    config: QualityTrainConfig,
    jobs: int,
    options: dict[str, Any],
    report: Callable[[str], None],
    start_from: Path | None,
) -> Path:
    network: ViewQualityNetwork | None = None
    settings: dict[str, Any] = {"config": asdict(config), "env_options": options}
    if start_from is not None:
        network = load_view_quality(start_from).network
        settings["start_from"] = hashlib.sha256(start_from.read_bytes()).hexdigest()
    begin_training(out, settings)
    start = time.perf_counter()
    validation_plan = _blocks(
        out / "validation", config, 0, config.validation_episodes, "validation", _of_other_kind(options)
    )
    plan: list[Block] = []
    for number, episodes in enumerate(config.rounds):
        policy_path = out / f"round-{number}.pt"
        before = start_from if number == 0 else out / f"round-{number - 1}.pt"
        first = (config.seed * len(config.rounds) + number) * config.plants(max(config.rounds))
        plan += _blocks(out / f"train-{number}", config, first, episodes, "train", options, before)
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
            "env_options": json.dumps(options),
            "package_version": maniskill_tomato.__version__,
            "looks": len(data.scalars),
            "episodes": len(data.reachable),
            "seconds": round(time.perf_counter() - start, 1),
            "seed": config.seed,
        }
        blend = fit_blend(network, validation, config.fit.full_visibility)
        report(f"round {number}: {blend}")
        save_view_quality(policy_path, ViewQuality(network, ViewQualityConfig(blend=blend), facts))
    path = out / "policy.pt"
    write_atomically(path, (out / f"round-{len(config.rounds) - 1}.pt").read_bytes())
    return path


def _of_other_kind(options: dict[str, Any]) -> dict[str, Any]:
    """The same task with plants of other kinds than those that are learned from; meshes stay what they are."""
    plant = dict(options.get("plant", {}))
    return options if "mesh" in plant else {**options, "plant": {**plant, "preset": "other_kind"}}


def _blocks(
    path: Path,
    config: QualityTrainConfig,
    first: int,
    episodes: int,
    split: str,
    options: dict[str, Any],
    policy: Path | None = None,
) -> list[Block]:
    """Episodes on the plants of a split from its `first` on, in files that begin with `path`."""
    plants = config.block // config.episodes_a_plant
    return [
        Block(
            path=path.with_name(f"{path.name}-{b}.pt"),
            make=_collect,
            arguments=(first + b * plants, plants, config.episodes_a_plant, split, options, policy),
        )
        for b in range(config.plants(episodes) // plants)
    ]


def _collect(
    first: int,
    plants: int,
    episodes_a_plant: int,
    split: str,
    options: dict[str, Any],
    policy: Path | None,
) -> dict[str, Tensor]:
    """Episodes on plants from the `first` of their split on, in whatever process this is."""
    network = None if policy is None else load_view_quality(policy).network
    start = VALIDATION_SEED if split == "validation" else 0
    parts: list[QualityData] = []
    hopeless: InvalidInputError | None = None
    for number in range(first, first + plants):
        plant = {**dict(options.get("plant", {})), "seed": SEED_SPLITS[split][0] + number}
        env = make_env(ENV_ID, **{**options, "plant": plant})
        seed = start + SEEDS_A_PLANT * number
        try:
            for k in range(seed, seed + episodes_a_plant):
                parts.append(collect_episodes(env, range(k, k + 1), network))
        except InvalidInputError as error:
            hopeless = error  # The arm reaches none of its ripe fruits where it stands.
        finally:
            env.close()
    if hopeless is not None and not parts:
        raise hopeless
    data = QualityData.join(parts)
    return {f.name: getattr(data, f.name) for f in fields(QualityData)}


def _load(blocks: list[Block]) -> QualityData:
    parts = []
    for block in blocks:
        try:
            parts.append(QualityData(**block.read()))
        except TypeError as error:
            raise CheckpointError(f"{block.path} holds no looks: {error}; delete it and go on") from error
    return QualityData.join(parts)
