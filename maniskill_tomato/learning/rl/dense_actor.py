"""A policy in the parts that its ONNX graph is written from, this package's own and those of other learners."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import nn

from maniskill_tomato.policies.actor import ObservationNormalizer
from maniskill_tomato.policies.image_encoder import ImageEncoder
from maniskill_tomato.sensing.image_layout import Sight


@dataclass(frozen=True, kw_only=True)
class DenseActor:
    """A chain of dense layers, after an encoder if it sees images."""

    act: Callable[[Any], torch.Tensor]
    """What the export is compared with: actions of shape (B, A) for observations of shape (B, D), or with images."""
    normalizer: ObservationNormalizer
    normalizer_kind: str
    """Where the normaliser comes from, see `PolicyDescription`."""
    layers: Sequence[nn.Module]
    """Linear layers, the first at the observations."""
    activation: Literal["Relu", "Tanh"]
    """What follows each of them but the last."""
    output: Literal["Tanh", "Clip"]
    """What brings the output of the last into [-1, 1]."""
    action_scale: torch.Tensor
    """The action that an output of 1 stands for, in the task's units. Shape (A,)."""
    action_low: torch.Tensor
    """The task's bounds. Shape (A,)."""
    action_high: torch.Tensor
    """Shape (A,)."""
    env_id: str
    """The task that it was trained on."""
    env_options: dict[str, Any] | None
    """The options of the task in the training; empty if there were none, None if that is not known."""
    package_version: str
    """The version of this package in the training."""
    algorithm: str
    counters: dict[str, Any]
    """Steps, episodes and seed of the training; what is missing becomes null."""
    config: dict[str, Any]
    """Every training option, as JSON can hold them."""
    encoder: ImageEncoder | None = None
    """What turns images into features, which join the normalised observations; None without images."""
    sight: Sight | None = None
    """The images that it observes; None if it observes none."""
