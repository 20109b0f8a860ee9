"""Training of the view-quality network by what the candidates really showed."""

import time
from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn import functional

from maniskill_tomato.learning.descent import descend
from maniskill_tomato.learning.view_quality.quality_config import FitConfig
from maniskill_tomato.learning.view_quality.quality_episodes import QualityData
from maniskill_tomato.policies.quality_network import ViewQualityNetwork
from maniskill_tomato.policies.view_quality import new_network


def losses(
    network: ViewQualityNetwork, data: QualityData, rows: Tensor, threshold: float, flip: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Mean cross entropy of full views and mean squared error of V_f, over the candidates that the arm reaches.

    Args:
        network: Judged.
        data: Looks and truth.
        rows: Which looks. Shape (B,).
        threshold: V_f above which a view is full.
        flip: Which of them to mirror. Shape (B,), bool.
    """
    maps, scalars = data.maps[rows].float(), data.scalars[rows]
    episode = data.episode[rows]
    if flip is not None:
        maps, scalars = mirrored(maps, scalars, flip)
    logits, fraction = network(maps, scalars)
    truth = data.visible_fraction[episode].float().view(fraction.shape)
    reachable = data.reachable[episode].float().view(fraction.shape)
    if flip is not None:
        truth = torch.where(flip[:, None, None, None], truth.flip(1), truth)
        reachable = torch.where(flip[:, None, None, None], reachable.flip(1), reachable)
    full = (truth > threshold).float()
    count = reachable.sum()
    entropy = functional.binary_cross_entropy_with_logits(logits, full, weight=reachable, reduction="sum")
    return entropy / count, ((fraction - truth).square() * reachable).sum() / count


def mirrored(maps: Tensor, scalars: Tensor, flip: Tensor) -> tuple[Tensor, Tensor]:
    """Features of the scene mirrored in the plane y = 0, where `flip` is set.

    Azimuth runs from one side to the other and y changes its sign; the arm and the rows have that symmetry.
    """
    sign = scalars.new_ones(scalars.shape[1])
    sign[[3, 6]] = -1.0
    return (
        torch.where(flip[:, None, None, None], maps.flip(2), maps),
        torch.where(flip[:, None], scalars * sign, scalars),
    )


def fit(
    data: QualityData,
    config: FitConfig | None = None,
    validation: QualityData | None = None,
    report: Callable[[int, dict[str, float]], None] = lambda step, values: None,
    network: ViewQualityNetwork | None = None,
) -> ViewQualityNetwork:
    """Trains a network, or goes on with one.

    Args:
        data: Looks and truth.
        config: How to train.
        validation: Looks in other episodes, judged now and then.
        report: Told the step and the losses about every 200 steps.
        network: To go on with; a fresh one if None.

    Raises:
        TrainingDivergedError: A loss is not finite.
    """
    config = config or FitConfig()
    torch.manual_seed(config.seed)
    generator = torch.Generator().manual_seed(config.seed)
    network = network or new_network(config.width, config.blocks)
    start = time.perf_counter()
    latest: dict[str, float] = {}

    def loss() -> Tensor:
        rows = torch.randint(len(data.scalars), (config.batch_size,), generator=generator)
        flip = torch.rand(config.batch_size, generator=generator) < 0.5 if config.mirror else None
        entropy, error = losses(network, data, rows, config.full_visibility, flip)
        latest.update(cross_entropy=entropy.item(), squared_error=error.item())
        return entropy + config.fraction_weight * error

    def tell(step: int, value: float) -> None:
        if step % 200 == 0 or step == config.steps:
            values = dict(latest)
            if validation is not None:
                judged = judge(network, validation, config.full_visibility)
                values |= {f"validation_{name}": value for name, value in judged.items()}
            report(step, {**values, "seconds": time.perf_counter() - start})

    descend(network, loss, config, tell)
    return network


def judge(
    network: ViewQualityNetwork, data: QualityData, threshold: float, most: int = 600
) -> dict[str, float]:
    """Cross entropy and squared error over up to `most` looks, evenly spread."""
    rows = torch.linspace(0, len(data.scalars) - 1, min(most, len(data.scalars))).long()
    network.eval()
    with torch.no_grad():
        entropy, error = losses(network, data, rows, threshold)
    network.train()
    return {"cross_entropy": entropy.item(), "squared_error": error.item()}
