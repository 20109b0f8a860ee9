"""Training of the network of `deep_3dmts`: the moves of 3D Move To See are regressed from single views."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.learning.imitation.imitation_config import RegressionConfig
from maniskill_tomato.learning.rl.envs import make_env
from maniskill_tomato.policies.baselines import RandomStep
from maniskill_tomato.policies.deep_move_to_see import (
    DeepMoveToSee,
    MoveNetwork,
    network_input,
    save_deep_move_to_see,
)
from maniskill_tomato.policies.move_to_see import MoveToSee

FOLLOWED = 0.5
"""Share of the moves that are those of 3D Move To See; the others are random, so that the views are not only those of
its own ways."""


@dataclass(frozen=True, eq=False)
class MoveToSeeData:
    """Views and the moves that 3D Move To See made from them."""

    pictures: Tensor
    """As `view_picture` gives them. Shape (N, 4, 16, 16)."""
    distance: Tensor
    """Camera to target, in [m]. Shape (N,)."""
    moves: Tensor
    """(right, up, forward) as shares of a full move. Shape (N, 3)."""


def train_move_to_see(
    out: Path,
    config: RegressionConfig,
    episodes: int = 1000,
    moves: int = 10,
    report: Callable[[str], None] = lambda line: None,
) -> Path:
    """Collects views, trains the network and writes its file.

    Args:
        out: The file.
        config: How to train; its seed is that of the episodes too.
        episodes: How many.
        moves: Views of each.
        report: Told a line now and then.

    Returns:
        The file.
    """
    data = collect_views(episodes, moves, config.seed, report)
    variance = float((data.moves - data.moves.mean(dim=0)).square().mean())
    network = train_move_network(
        data,
        config,
        lambda epoch, loss, validation: report(
            f"epoch {epoch + 1}: loss {loss:.4f}, validation {validation:.4f} (variance of the moves {variance:.4f})"
        ),
    )
    save_deep_move_to_see(out, DeepMoveToSee(network))
    return out


def collect_views(
    episodes: int, moves: int, seed: int, report: Callable[[str], None] = lambda line: None
) -> MoveToSeeData:
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
            follows = bool(move.norm() > 0.0) and float(torch.rand(1, generator=coin)) < FOLLOWED
            _, _, terminated, truncated, _ = env.step(move if follows else wanderer.act(world.belief))
            if bool(terminated) or bool(truncated):
                break
        if (episode + 1) % 100 == 0:
            report(f"{episode + 1} of {episodes} episodes, {len(wanted)} views")
    env.close()
    return MoveToSeeData(torch.cat(pictures), torch.cat(distances), torch.cat(wanted))


def train_move_network(
    data: MoveToSeeData,
    config: RegressionConfig | None = None,
    report: Callable[[int, float, float], None] = lambda epoch, loss, validation: None,
) -> MoveNetwork:
    """Fits the network to the moves by their squared error, and keeps the epoch with the lowest validation loss.

    Args:
        data: In the order of the episodes.
        config: How to train.
        report: Told the epoch, its mean loss and the validation loss.

    Raises:
        InvalidInputError: There are too few views.
    """
    config = config or RegressionConfig()
    count = len(data.moves)
    held_back = int(count * config.validation_share)
    if held_back < 1 or count - held_back < config.batch_size:
        raise InvalidInputError(f"{count} views are too few for batches of {config.batch_size}")
    generator = torch.Generator().manual_seed(config.seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        network = MoveNetwork()
    optimizer = torch.optim.Adam(network.parameters(), lr=config.learning_rate)
    last = count - held_back
    best, weights = float("inf"), network.state_dict()
    for epoch in range(config.epochs):
        losses = []
        for rows in torch.split(torch.randperm(last, generator=generator), config.batch_size):
            loss = _loss(network, data, rows)
            optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            optimizer.step()
            losses.append(float(loss.detach()))
        with torch.no_grad():
            validation = float(_loss(network, data, torch.arange(last, count)))
        if validation < best:
            best = validation
            weights = {name: value.clone() for name, value in network.state_dict().items()}
        report(epoch, sum(losses) / len(losses), validation)
    network.load_state_dict(weights)
    return network.eval().requires_grad_(False)


def _loss(network: MoveNetwork, data: MoveToSeeData, rows: Tensor) -> Tensor:
    moves = network(data.pictures[rows], data.distance[rows])
    return nn.functional.mse_loss(moves, data.moves[rows])
