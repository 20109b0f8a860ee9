"""How far two float32 evaluations of one policy may differ: PyTorch's and ONNX Runtime's on any processor."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from maniskill_tomato.learning.rl.dense_actor import DenseActor
from maniskill_tomato.policies.image_encoder import ImageEncoder

FLOAT32_UNIT_ROUNDOFF = 2.0**-24
"""Largest relative error of one rounding to float32."""

ROUNDING_SIGMAS = 10.0
"""Standard deviations of independent roundings that an encoder's features may differ by."""


def rounding_tolerance(
    actor: DenseActor, observations: NDArray[np.float32], images: Mapping[str, NDArray[Any]] | None = None
) -> NDArray[np.float64]:
    """The bound for every action of a policy.

    Processors sum a layer's products in different orders, and an actor with large weights multiplies the rounding
    of its first layers. A fixed tolerance therefore either refuses correct exports of such actors on some machine or
    accepts wrong weights of all others. Here the error is carried through the layers in float64: a sum of n products
    rounds by about sqrt(n) units of the sum of their sizes (Higham and Mary, 2019), a layer multiplies the error of
    its input by the sizes of its weights, and an activation changes it as it changes the ends of the interval.

    Args:
        actor: The policy.
        observations: World frame, in [m] and [rad]. Shape (B, D).
        images: Those that it sees beside them, by kind, each of shape (B, H, W, C).

    Returns:
        In the task's units. Shape (B, A).
    """
    functions: dict[str, Callable[[torch.Tensor], torch.Tensor]] = {
        "Relu": torch.relu,
        "Tanh": torch.tanh,
        "Clip": lambda z: z.clamp(-1.0, 1.0),
    }
    activations = [actor.activation] * (len(actor.layers) - 1) + [actor.output]
    unit = FLOAT32_UNIT_ROUNDOFF
    x = (
        torch.from_numpy(observations).double() - actor.normalizer.centre.cpu().double()
    ) / actor.normalizer.half_range.cpu().double()
    error = 2.0 * unit * x.abs()
    if actor.encoder is not None:
        features, feature_error = _encoder_errors(actor.encoder, images or {})
        x, error = torch.cat((x, features), dim=-1), torch.cat((error, feature_error), dim=-1)
    layers: Sequence[Any] = actor.layers  # To mypy a module's weight may be a module.
    for layer, activation in zip(layers, activations, strict=True):
        weight, bias = (p.detach().cpu().double() for p in (layer.weight, layer.bias))
        terms = x.abs() @ weight.abs().T + bias.abs()
        error = error @ weight.abs().T + unit * (weight.shape[1] + 1) ** 0.5 * terms
        z, function = x @ weight.T + bias, functions[activation]
        x = function(z)
        # The last term is for the activation itself, which libraries approximate to a few units.
        error = torch.maximum(function(z + error) - x, x - function(z - error)) + 4.0 * unit * x.abs()
    scale = actor.action_scale.cpu().double().abs()
    tolerance: NDArray[np.float64] = (2.0 * (error + unit * x.abs()) * scale).numpy()
    return tolerance


def _encoder_errors(
    encoder: ImageEncoder, images: Mapping[str, NDArray[Any]]
) -> tuple[torch.Tensor, torch.Tensor]:
    """Features of images in float64, and how far two float32 evaluations of them may differ. Each (B, features).

    Through many layers the bound by sizes grows without end, so independent roundings are added as variances here, and
    `ROUNDING_SIGMAS` standard deviations are allowed.
    """
    unit, conv = FLOAT32_UNIT_ROUNDOFF, torch.nn.functional.conv2d
    with torch.no_grad():
        x = encoder.scaled({kind: torch.from_numpy(image) for kind, image in images.items()}).double()
        variance = (2.0 * unit * x).square()
        for layer in encoder.convolutions:
            if not isinstance(layer, nn.Conv2d):
                continue
            assert layer.bias is not None
            weight, bias, stride = layer.weight.double(), layer.bias.double(), layer.stride
            products = weight[0].numel()
            spread = variance + products * (unit * x).square()
            variance = conv(spread, weight.square(), (unit * bias).square(), stride)
            x = conv(x, weight, bias, stride).relu()
        x, variance = x.flatten(1), variance.flatten(1)
        weight, bias = encoder.trunk.weight.double(), encoder.trunk.bias.double()
        variance = (variance + weight.shape[1] * (unit * x).square()) @ weight.square().T
        x = x @ weight.T + bias
        # The derivative of z = (x - mean) / scale is (dx - mean(dx) - z mean(z dx)) / scale.
        scale = (x.var(dim=-1, unbiased=False, keepdim=True) + encoder.norm.eps).sqrt()
        z = (x - x.mean(dim=-1, keepdim=True)) / scale
        error = ROUNDING_SIGMAS * variance.sqrt()
        error = (
            error + error.mean(-1, keepdim=True) + z.abs() * (z.abs() * error).mean(-1, keepdim=True)
        ) / scale
        error = error + 8.0 * unit * (z.abs() + x.abs().amax(dim=-1, keepdim=True) / scale)
        gain = encoder.norm.weight.double()
        x, error = z * gain + encoder.norm.bias.double(), error * gain.abs() + 2.0 * unit * z.abs()
        ends = torch.maximum(torch.tanh(x + error) - torch.tanh(x), torch.tanh(x) - torch.tanh(x - error))
        return torch.tanh(x), ends + 4.0 * unit
