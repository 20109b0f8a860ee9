"""From nothing to an imitated policy: rounds of episodes and fits, kept in a folder and continued from there."""

import dataclasses
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import maniskill_tomato
from maniskill_tomato.files import write_atomically, write_tensors
from maniskill_tomato.folder_lock import only_writer
from maniskill_tomato.learning.blocks import Block, begin_training, run_blocks
from maniskill_tomato.learning.imitation.imitation_config import ImitationConfig
from maniskill_tomato.learning.imitation.imitation_fit import fit_actor, fit_recurrent
from maniskill_tomato.learning.imitation.teacher_episodes import ImitationData, collect_demonstrations
from maniskill_tomato.learning.rl.agent import make_agent
from maniskill_tomato.learning.rl.checkpoint import make_checkpoint
from maniskill_tomato.learning.rl.envs import make_env
from maniskill_tomato.learning.rl.presets import get_preset
from maniskill_tomato.policies.opening import open_policy
from maniskill_tomato.policies.recurrent import (
    RecurrentActor,
    RecurrentPolicy,
    columns_of,
    save_recurrent,
)
from maniskill_tomato.sensing.observation import ObservationLayout

ENV_ID = "TomatoViewpoint-v1"


def train_imitation(
    out: Path,
    config: ImitationConfig | None = None,
    jobs: int = 1,
    env_options: dict[str, Any] | None = None,
    report: Callable[[str], None] = lambda line: None,
) -> Path:
    """Trains, or goes on with the training in a folder.

    Args:
        out: Folder of the data and the policies.
        config: How; the folder's own on a training that goes on.
        jobs: Processes that run episodes.
        env_options: Options of the task beside its plants' split.
        report: Told one line after every block and every 500 batches.

    Returns:
        File of the last round's policy, `policy.pt`; `round-0.pt` is the behaviour-cloned one.

    Raises:
        InvalidInputError: The folder holds a training with another configuration.
        TrainingDivergedError: A loss is not finite.
        CheckpointError: Another process trains in the folder, or a file cannot be written.
    """
    with only_writer(out, "trains"):
        return _train(out, config or ImitationConfig(), jobs, env_options or {}, report)


def _train(
    out: Path,
    config: ImitationConfig,
    jobs: int,
    options: dict[str, Any],
    report: Callable[[str], None],
) -> Path:
    begin_training(out, {"config": asdict(config), "env_options": options})
    blocks: list[Block] = []
    path = out / "round-0.pt"
    for number, episodes in enumerate(config.rounds):
        student = None if number == 0 else path
        path = out / f"round-{number}.pt"
        # Far from the seeds of other trainings on the same plants.
        first = 500_000_000 + (config.seed * len(config.rounds) + number) * 100_000
        for b in range(-(-episodes // config.block)):
            # A quarter of the blocks meets new plants only.
            pool = None if b % 4 == 3 else config.pool
            seeds = first + b * config.block, min(config.block, episodes - b * config.block)
            arguments = (*seeds, pool, options, student, config.student_share)
            blocks.append(Block(path=out / f"train-{number}-{b}.pt", make=_collect, arguments=arguments))
        if path.is_file():
            continue
        run_blocks(blocks, jobs, report)
        data = ImitationData.join([ImitationData(**block.read()) for block in blocks])
        report(f"round {number}: {len(data.actions)} moves in {len(data.lengths)} episodes")
        _fit(config, data, path, report)
    final = out / "policy.pt"
    write_atomically(final, path.read_bytes())
    return final


def _fit(config: ImitationConfig, data: ImitationData, path: Path, report: Callable[[str], None]) -> None:
    torch.manual_seed(config.fit.seed)
    facts = {"episodes": len(data.lengths), "steps": len(data.actions), "seed": config.seed}

    def tell(step: int, loss: float) -> None:
        report(f"batch {step}: loss {loss:.4f}")

    if config.student == "recurrent":
        parts = ObservationLayout.without_memory().parts
        columns = columns_of(parts)
        recurrent = RecurrentActor(len(columns))
        seen = dataclasses.replace(data, observations=data.observations[:, columns])
        fit_recurrent(recurrent, seen, config.fit, tell)
        about = {**facts, "env_id": ENV_ID, "package_version": maniskill_tomato.__version__}
        save_recurrent(path, RecurrentPolicy(recurrent, parts, about))
        return
    agent = make_agent(get_preset("general-td3"), data.observations.shape[1], 3)
    fit_actor(agent.actor, data, config.fit, tell)
    bounds = -torch.ones(3), torch.ones(3)
    checkpoint = make_checkpoint(agent, ENV_ID, bounds, {**facts}, with_training_state=False, env_options={})
    write_tensors(path, checkpoint)


def _collect(
    first: int,
    episodes: int,
    pool: int | None,
    options: dict[str, Any],
    student: Path | None,
    student_share: float,
) -> dict[str, Tensor]:
    """Episodes of seeds from `first` on, in whatever process this is."""
    plant = {"seed": "train", "pool": pool, **dict(options.get("plant", {}))}
    env = make_env(ENV_ID, **{**options, "plant": plant})
    try:
        led_by = None if student is None else open_policy(student)
        data = collect_demonstrations(env, range(first, first + episodes), led_by, student_share)
    finally:
        env.close()
    return {f.name: getattr(data, f.name) for f in dataclasses.fields(ImitationData)}
