"""Fitting a network by AdamW along half a cosine."""

from collections.abc import Callable

from torch import Tensor, nn, optim

from maniskill_tomato.errors import TrainingDivergedError
from maniskill_tomato.learning.round_config import DescentConfig


def descend(
    network: nn.Module,
    loss: Callable[[], Tensor],
    config: DescentConfig,
    report: Callable[[int, float], None],
) -> None:
    """Fits a network, which afterwards is frozen and in evaluation mode.

    Args:
        network: Changed in place.
        loss: The loss of the next batch, a scalar.
        config: How.
        report: Told every step, from 1, and its loss.

    Raises:
        TrainingDivergedError: A loss is not finite.
    """
    network.train().requires_grad_(True)
    optimizer = optim.AdamW(
        network.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay, fused=True
    )
    schedule = optim.lr_scheduler.CosineAnnealingLR(optimizer, config.steps)
    for step in range(1, config.steps + 1):
        value = loss()
        if not bool(value.isfinite()):
            raise TrainingDivergedError(f"the loss of step {step} is not finite; lower learning_rate")
        optimizer.zero_grad()
        value.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        schedule.step()
        report(step, value.item())
    network.eval().requires_grad_(False)
