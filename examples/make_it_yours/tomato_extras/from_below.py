"""A task: the camera starts below the leaves, and a full view counts from near only.

maniskill-tomato train TomatoFromBelow-v1
"""

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from maniskill_tomato.tasks import register_task
from maniskill_tomato.tasks.own_rules import Moved

NEAR = 0.4
"""In [m]."""


def distance(moved: Moved) -> Tensor:
    """From the camera to the tomato, in [m]. Shape (N,)."""
    metres: Tensor = (moved.camera_position - moved.target_position).norm(dim=-1)
    return metres


def success(moved: Moved) -> Tensor:
    """Whether most of the tomato is seen from near. Shape (N,), bool."""
    return (moved.visible_fraction > 0.7) & (distance(moved) < NEAR)


def reward(moved: Moved) -> Tensor:
    """What the move has gained in V_f, 1 for a success, and a cost for every metre beyond `NEAR`. Shape (N,)."""
    gain = moved.visible_fraction - moved.previous_fraction
    too_far = (distance(moved) - NEAR).clamp(min=0.0)
    return gain + success(moved).float() - 0.1 * too_far


def starts(
    rng: np.random.RandomState, count: int, target_position: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Positions of the camera before and below the tomato, world frame, in [m]. Shape (count, 3)."""
    return target_position + rng.uniform((-0.6, -0.3, -0.4), (-0.3, 0.3, -0.15), (count, 3))


TASK = register_task(
    "TomatoFromBelow-v1",
    base="TomatoViewpoint-v1",
    settings={"plant": {"leaf_density": (0.8, 1.2)}},
    reward=reward,
    largest_reward=2.0,
    starts=starts,
    success=success,
    max_episode_steps=15,
)
