"""Observation of learners: state vectors, or dictionaries of a state and images."""

from collections.abc import Callable, Mapping
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.learning.rl.train_config import TrainConfig
from maniskill_tomato.sensing.image_layout import ImageLayout
from maniskill_tomato.sensing.image_observation import STATE, Observation, state_of
from maniskill_tomato.tasks.observed_world import LearnerEyes


def eyes_of(config: TrainConfig) -> LearnerEyes | None:
    """What a configuration sees; None for state vectors."""
    images = ImageLayout.parse(config.obs_mode, config.image_size)
    if images is None:
        return None
    return LearnerEyes(
        images=images,
        frames=config.frame_stack,
        state_parts=config.state_parts,
        privileged=config.asymmetric_critic,
    )


def mapped(observations: Observation, change: Callable[[Tensor], Tensor]) -> Observation:
    """Every tensor of observations changed alike."""
    if isinstance(observations, Tensor):
        return change(observations)
    return {name: change(value) for name, value in observations.items()}


def device_of(observations: Observation) -> torch.device:
    """Where they are."""
    return state_of(observations).device


def columns_of(space: gym.Space[Any]) -> dict[str, tuple[tuple[int, ...], torch.dtype]]:
    """Shape and type of every tensor of one environment's observation; a state vector is called ``.

    Raises:
        InvalidInputError: Nothing here can learn on such a space.
    """
    if isinstance(space, gym.spaces.Box) and len(space.shape) == 1:
        return {"": (space.shape, torch.float32)}
    if isinstance(space, gym.spaces.Dict) and STATE in space.spaces:
        types: Mapping[Any, torch.dtype] = {
            np.dtype(np.float32): torch.float32,
            np.dtype(np.uint8): torch.uint8,
            np.dtype(np.int16): torch.int16,
        }
        boxes = {name: box for name, box in space.spaces.items() if isinstance(box, gym.spaces.Box)}
        if len(boxes) == len(space.spaces) and all(box.dtype in types for box in boxes.values()):
            return {name: (box.shape, types[box.dtype]) for name, box in boxes.items()}
    raise InvalidInputError(f"training needs a vector, or a dictionary of state and images; got {space}")
