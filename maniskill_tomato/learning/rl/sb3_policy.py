"""A model that learned in `make_gymnasium_env`, such as Stable-Baselines3's, as a policy for every command."""

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from maniskill_tomato.learning.rl.gymnasium_env import normalize_observation
from maniskill_tomato.learning.rl.presets import default_preset, get_preset
from maniskill_tomato.policies.adapters import ObservationPolicy
from maniskill_tomato.task_registry import find_task


class Predictor(Protocol):
    """What Stable-Baselines3's models have."""

    def predict(self, observation: Any, *, deterministic: bool = ...) -> tuple[Any, Any]:
        """Actions in [-1, 1] for normalised observations. Shapes (B, A) and (B, D)."""
        ...


class _PredictedActions:
    def __init__(self, model: Predictor, scale: Sequence[float]) -> None:
        self._model, self._scale = model, np.array(scale, np.float32)

    def act(self, observations: Tensor) -> Tensor:
        seen = normalize_observation(observations.detach().cpu().numpy())
        actions, _ = self._model.predict(seen, deterministic=True)
        return torch.from_numpy(np.clip(actions, -1.0, 1.0) * self._scale).to(observations)


def sb3_policy(
    model: Predictor, env_id: str, action_scale: Sequence[float] | None = None
) -> ObservationPolicy:
    """A policy that asks a model with `predict`, without exploration.

    Args:
        model: Learned from state vectors in `make_gymnasium_env(env_id)`.
        env_id: The task.
        action_scale: What the model's environment had, if it was not the default.

    Raises:
        InvalidInputError: There is no such task.
    """
    find_task(env_id)
    scale = get_preset(default_preset(env_id)).action_scale if action_scale is None else action_scale
    return ObservationPolicy(_PredictedActions(model, scale), name=type(model).__name__.lower())
