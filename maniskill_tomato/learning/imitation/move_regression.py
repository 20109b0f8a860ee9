"""Training of `deep_3dmts`: a network regresses the moves of 3D Move To See from single views."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.policies.deep_move_to_see import MoveNetwork


@dataclass(frozen=True, eq=False)
class MoveToSeeData:
    """Views and the moves that 3D Move To See made from them."""

    pictures: Tensor
    """As `view_picture` gives them. Shape (N, 4, 16, 16)."""
    distance: Tensor
    """Camera to target, in [m]. Shape (N,)."""
    moves: Tensor
    """(right, up, forward) as shares of a full move. Shape (N, 3)."""


@dataclass(frozen=True, kw_only=True)
class RegressionConfig:
    """How the network is trained."""

    epochs: int = 15
    """Passes over the data; theirs: 50."""
    batch_size: int = 64
    """As theirs."""
    learning_rate: float = 1e-3
    """Of Adam; theirs fine-tune by SGD with momentum at 1e-5."""
    validation_share: float = 0.1
    """Share of the data, its last part, by whose loss the epoch is chosen."""
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("epochs", "batch_size"):
            if getattr(self, name) < 1:
                raise InvalidInputError(f"{name} must be at least 1, got {getattr(self, name)}")
        if not 0.0 < self.validation_share < 1.0:
            raise InvalidInputError(f"validation_share must lie in (0, 1), got {self.validation_share}")
        if not self.learning_rate > 0.0:
            raise InvalidInputError(f"learning_rate must be positive, got {self.learning_rate}")


def train_move_network(
    data: MoveToSeeData,
    config: RegressionConfig | None = None,
    report: Callable[[int, float, float], None] = lambda epoch, loss, validation: None,
) -> MoveNetwork:
    """Fits the network to the moves by their squared error, and keeps the epoch with the lowest validation loss.

    Args:
        data: From `scripts/train_deep_move_to_see.py`, in the order of the episodes.
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
