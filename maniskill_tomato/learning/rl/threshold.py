"""A success threshold that rises while a run goes on: a curriculum for targets that are hard to see fully.

The threshold is no part of the observation, so that a value learned for an old threshold would be wrong for the
present one. Nothing is therefore stored with a threshold: the transitions keep their V_f, and every batch is labelled
when it is drawn, with the threshold of that moment. All of the replay buffer then describes one task, which moves
slowly to the real one and becomes it before the schedule ends.
"""

import torch

from maniskill_tomato.learning.rl.replay import Batch


def success_threshold(start: float, step: int, steps: int) -> float:
    """The threshold of V_f at a step: from `start` linearly to 1, which is reached after `steps`.

    Above the task's own threshold it changes nothing.
    """
    return start + (1.0 - start) * min(step / steps, 1.0)


def label_successes(batch: Batch, threshold: float, gamma: float) -> Batch:
    """The batch as if V_f above `threshold` were a success, with the potential reward.

    A transition that now ends its episode gets the 1 of a success and loses the potential gamma V_f that
    `potential_reward` gave for going on. Those that ended already stay as they are.

    Args:
        batch: Transitions over one step with their V_f.
        threshold: V_f above which the target counts as fully visible.
        gamma: Discount factor.
    """
    assert batch.visible_fractions is not None
    visible = batch.visible_fractions
    ends = (visible > threshold) & (batch.terminations < 0.5)
    return batch._replace(
        rewards=torch.where(ends, batch.rewards + 1.0 - gamma * visible, batch.rewards),
        terminations=torch.where(ends, 1.0, batch.terminations),
    )
