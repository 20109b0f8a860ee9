"""Trains the network of `deep_3dmts`: regresses the moves of 3D Move To See from single views of training plants.

Episodes follow 3D Move To See's own moves half of the time and random ones otherwise, so that the views are not only
those of its own ways.

Usage:
    python scripts/train_deep_move_to_see.py --episodes 1000 --out assets/policies/deep_3dmts.pt
"""

import logging
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from torch import Tensor

from maniskill_tomato.errors import TomatoError
from maniskill_tomato.learning.imitation.move_regression import (
    MoveToSeeData,
    RegressionConfig,
    train_move_network,
)
from maniskill_tomato.learning.rl.envs import make_env
from maniskill_tomato.policies.baselines import RandomStep
from maniskill_tomato.policies.deep_move_to_see import DeepMoveToSee, network_input, save_deep_move_to_see
from maniskill_tomato.policies.move_to_see import MoveToSee

logger = logging.getLogger("train_deep_move_to_see")


@dataclass(frozen=True, kw_only=True)
class Args:
    """Options."""

    out: Path
    """File of the network."""
    episodes: int = 1000
    """Episodes whose views are learned from."""
    moves: int = 10
    """Views of each episode."""
    seed: int = 0
    """Of the episodes and of the training."""
    training: RegressionConfig = RegressionConfig()
    """How the network is trained."""


def collect(episodes: int, moves: int, seed: int) -> MoveToSeeData:
    """Views of training plants with the moves that 3D Move To See makes from them."""
    env: Any = make_env("TomatoViewpoint-v1")
    world = env.unwrapped
    teacher, wanderer = MoveToSee(world.ground_truth, world.device), RandomStep(seed)
    coin = torch.Generator().manual_seed(seed)
    pictures: list[Tensor] = []
    distances: list[Tensor] = []
    wanted: list[Tensor] = []
    for episode in range(episodes):
        env.reset(seed=seed + episode)
        for _ in range(moves):
            picture, distance = network_input(world.belief)
            move = teacher.act(world.belief)
            pictures.append(picture.cpu())
            distances.append(distance.cpu())
            wanted.append(move.cpu())
            follows = bool(move.norm() > 0.0) and float(torch.rand(1, generator=coin)) < 0.5
            _, _, terminated, truncated, _ = env.step(move if follows else wanderer.act(world.belief))
            if bool(terminated) or bool(truncated):
                break
        if (episode + 1) % 100 == 0:
            logger.info("%d of %d episodes, %d views", episode + 1, episodes, len(wanted))
    env.close()
    return MoveToSeeData(torch.cat(pictures), torch.cat(distances), torch.cat(wanted))


def main(args: Args) -> None:
    """Collects, trains and writes."""
    start = time.monotonic()
    data = collect(args.episodes, args.moves, args.seed)
    logger.info("%d views in %.0f s", len(data.moves), time.monotonic() - start)
    scale = float((data.moves - data.moves.mean(dim=0)).square().mean())
    network = train_move_network(
        data,
        args.training,
        lambda epoch, loss, held: logger.info(
            "epoch %d: loss %.4f, validation %.4f (variance of the moves %.4f)", epoch + 1, loss, held, scale
        ),
    )
    save_deep_move_to_see(args.out, DeepMoveToSee(network))
    print(f"{args.out}, {time.monotonic() - start:.0f} s")


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    try:
        main(tyro.cli(Args, description=__doc__))
    except TomatoError as error:
        sys.exit(f"error: {error}")
