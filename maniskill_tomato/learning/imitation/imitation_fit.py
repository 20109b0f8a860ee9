"""Fitting a student to the teacher's moves."""

from collections import deque
from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils.rnn import pack_padded_sequence, pad_packed_sequence

from maniskill_tomato.learning.descent import descend
from maniskill_tomato.learning.imitation.imitation_config import ImitationFitConfig
from maniskill_tomato.learning.imitation.teacher_episodes import ImitationData

MAGNITUDE_WEIGHT = 0.2
"""Weight of the error in the length of a move beside that of its direction."""

MOVE_MIN = 1e-3
"""A move of the teacher shorter than this has no direction."""


def direction_loss(moves: Tensor, wanted: Tensor) -> Tensor:
    """Mean of 1 - cos of the angle to the teacher's move, plus `MAGNITUDE_WEIGHT` times the squared error in length.

    Where the teacher is of two minds, left or right, the squared error of the moves themselves is smallest between
    them: short moves that lead nowhere. The angle has no such middle, and the length is learned by itself.

    Args:
        moves: Shape (N, 3).
        wanted: The teacher's. Shape (N, 3).
    """
    length = wanted.norm(dim=-1)
    cosine = functional.cosine_similarity(moves, wanted, dim=-1, eps=1e-6)
    turned = (1.0 - cosine) * (length > MOVE_MIN)
    loss: Tensor = (turned + MAGNITUDE_WEIGHT * (moves.norm(dim=-1) - length).square()).mean()
    return loss


def fit_actor(
    actor: nn.Module,
    data: ImitationData,
    config: ImitationFitConfig,
    report: Callable[[int, float], None] = lambda step, loss: None,
) -> float:
    """Fits an actor of single observations.

    Args:
        actor: Observations (B, D) to moves (B, 3).
        data: What it learns from.
        config: How.
        report: Told the step and the mean loss about every 500 steps.

    Returns:
        The mean loss of the last 500 steps.

    Raises:
        TrainingDivergedError: A loss is not finite.
    """
    generator = torch.Generator().manual_seed(config.seed)

    def loss() -> Tensor:
        rows = torch.randint(len(data.actions), (config.batch_size,), generator=generator)
        return direction_loss(actor(data.observations[rows].float()), data.actions[rows])

    return _descend(actor, loss, config, report)


def fit_recurrent(
    actor: nn.Module,
    data: ImitationData,
    config: ImitationFitConfig,
    report: Callable[[int, float], None] = lambda step, loss: None,
) -> float:
    """Fits an actor of sequences: (B, T, D) packed to moves (B, T, 3); see `fit_actor`."""
    generator = torch.Generator().manual_seed(config.seed)
    starts = data.lengths.cumsum(0) - data.lengths
    count = max(config.batch_size // 8, 1)

    def loss() -> Tensor:
        chosen = torch.randint(len(data.lengths), (count,), generator=generator)
        lengths = data.lengths[chosen]
        # Rows of each episode side by side; those after its end are never read.
        rows = starts[chosen][:, None] + torch.arange(int(lengths.max()))
        rows = rows.clamp_max(len(data.actions) - 1)
        packed = pack_padded_sequence(
            data.observations[rows].float(), lengths, batch_first=True, enforce_sorted=False
        )
        moves, _ = pad_packed_sequence(actor(packed), batch_first=True)
        held = torch.arange(moves.shape[1]) < lengths[:, None]
        return direction_loss(moves[held], data.actions[rows][held])

    return _descend(actor, loss, config, report)


def _descend(
    actor: nn.Module,
    loss: Callable[[], Tensor],
    config: ImitationFitConfig,
    report: Callable[[int, float], None],
) -> float:
    recent: deque[float] = deque(maxlen=500)

    def tell(step: int, value: float) -> None:
        recent.append(value)
        if step % 500 == 0 or step == config.steps:
            report(step, sum(recent) / len(recent))

    descend(actor, loss, config, tell)
    return sum(recent) / len(recent)
