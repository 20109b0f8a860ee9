"""Training of the view-quality network by what the candidates really showed, and of its blend with the memory."""

import time
from collections.abc import Callable
from dataclasses import astuple
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from maniskill_tomato.learning.descent import descend
from maniskill_tomato.learning.view_quality.quality_config import FitConfig
from maniskill_tomato.learning.view_quality.quality_episodes import QualityData
from maniskill_tomato.policies.quality_blend import Blend, blend_terms
from maniskill_tomato.policies.quality_network import ViewQualityNetwork
from maniskill_tomato.policies.view_quality import new_network


class Losses(NamedTuple):
    """How wrong the network is in the mean."""

    cross_entropy: Tensor
    """Of full views, over the candidates that the arm reaches."""
    squared_error: Tensor
    """Of V_f, over the same."""
    touch_entropy: Tensor
    """Cross entropy of touches, over the moves that were made."""


def losses(
    network: ViewQualityNetwork, data: QualityData, rows: Tensor, threshold: float, flip: Tensor | None = None
) -> Losses:
    """How wrong a network is on some looks.

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
    full_logits, fraction, touch = network(maps, scalars)
    truth = data.visible_fraction[episode].float().view(fraction.shape)
    reachable = data.reachable[episode].float().view(fraction.shape)
    if flip is not None:
        truth = torch.where(flip[:, None, None, None], truth.flip(1), truth)
        reachable = torch.where(flip[:, None, None, None], reachable.flip(1), reachable)
        touch = torch.where(flip[:, None, None, None], touch.flip(1), touch)
    full = (truth > threshold).float()
    count = reachable.sum()
    entropy = functional.binary_cross_entropy_with_logits(
        full_logits, full, weight=reachable, reduction="sum"
    )
    came_to = data.came_to[rows]
    moved = (came_to >= 0).float()
    touch_entropy = functional.binary_cross_entropy_with_logits(
        touch.flatten(1).gather(1, came_to.clamp_min(0)[:, None])[:, 0],
        data.touched[rows].float(),
        weight=moved,
        reduction="sum",
    )
    return Losses(
        entropy / count,
        ((fraction - truth).square() * reachable).sum() / count,
        touch_entropy / moved.sum().clamp_min(1.0),
    )


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
        now = losses(network, data, rows, config.full_visibility, flip)
        latest.update({name: value.item() for name, value in now._asdict().items()})
        return (
            now.cross_entropy
            + config.fraction_weight * now.squared_error
            + config.touch_weight * now.touch_entropy
        )

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
    """`Losses` over up to `most` looks, evenly spread."""
    rows = torch.linspace(0, len(data.scalars) - 1, min(most, len(data.scalars))).long()
    network.eval()
    with torch.no_grad():
        judged = losses(network, data, rows, threshold)
    network.train()
    return {name: value.item() for name, value in judged._asdict().items()}


def fit_blend(network: ViewQualityNetwork, data: QualityData, threshold: float) -> Blend:
    """The weights of network and memory that explain best which candidates within reach were full views.

    Args:
        network: Judges.
        data: Looks at plants that the network has not learned from.
        threshold: V_f above which a view is full.
    """
    network.eval()
    terms, full = [], []
    with torch.no_grad():
        for rows in torch.split(torch.arange(len(data.scalars)), 256):
            maps, reachable = data.maps[rows].float(), data.reachable[data.episode[rows]]
            judged = network(maps, data.scalars[rows])
            terms.append(blend_terms(maps, judged.full)[reachable])
            full.append((data.visible_fraction[data.episode[rows]].float() > threshold)[reachable])
    network.train()
    weights = torch.tensor(astuple(Blend()), requires_grad=True)
    x, y = torch.cat(terms), torch.cat(full).float()
    optimiser = torch.optim.LBFGS([weights], max_iter=200, line_search_fn="strong_wolfe")

    def loss() -> Tensor:
        optimiser.zero_grad()
        entropy = functional.binary_cross_entropy_with_logits(x @ weights, y)
        # So small that it decides only where the looks do not, such as where all of them show the same.
        value: Tensor = entropy + 1e-4 * (weights - weights.new_tensor(astuple(Blend()))).square().sum()
        value.backward()  # type: ignore[no-untyped-call]
        return value

    optimiser.step(loss)  # type: ignore[no-untyped-call]
    return Blend(*(float(w) for w in weights.detach()))
