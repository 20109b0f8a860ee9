"""Roll, pitch and yaw of rotation matrices, in torch.

Roll, pitch and yaw are fixed-axis angles: R = Rz(yaw) Ry(pitch) Rx(roll). At pitch = pi/2, the nominal
viewing direction of the tasks, only roll - yaw is defined by R, so the angles need a reference.
"""

import math
from typing import Final

import numpy as np
import torch

from maniskill_tomato.errors import InvalidInputError

FORWARD_RPY: Final = (0.0, math.pi / 2, 0.0)
"""Of the flange when the camera looks along +x with its picture upright, in [rad]; a first view's are near to these."""

SINGULAR_COS_PITCH_FLOAT64 = 1e-6
"""Below this |cos(pitch)| a double-precision matrix counts as singular in `matrix_to_rpy`."""

SINGULAR_COS_PITCH_FLOAT32 = 1e-3
"""The same for lower precision, whose rounding (1e-7) would turn into a noise of roll of 1e-4 rad here."""


def require_trailing(name: str, tensor: torch.Tensor, trailing: tuple[int, ...]) -> None:
    """Accepts a floating-point tensor whose last dimensions have these sizes.

    Raises:
        InvalidInputError: It is another one.
    """
    if tuple(tensor.shape[-len(trailing) :]) != trailing or not tensor.is_floating_point():
        wanted = ", ".join(["...", *map(str, trailing)])
        raise InvalidInputError(
            f"{name} must be a floating-point tensor of shape ({wanted}); "
            f"got {tensor.dtype} of shape {tuple(tensor.shape)}"
        )


def matrix_to_rpy(matrix: torch.Tensor, reference_rpy: torch.Tensor) -> torch.Tensor:
    """Roll, pitch and yaw of a rotation, the ones nearest to a reference.

    Two triples, (r, p, y) and (r + pi, pi - p, y + pi), give the same matrix, each up to full turns; the
    one at the smaller Euclidean distance from the reference is returned, with the full turns that bring
    each angle within pi of it. Pitch may therefore lie beyond pi/2, as in the start ranges of the tasks.

    Where |cos(pitch)| is below 1e-6 (1e-3 for types other than float64) roll is taken from the reference
    and yaw carries the rest. The matrix of the result then differs from the given one by at most
    2 asin(|cos(pitch)|) |sin(d / 2)| rad, where d is the difference between the reference's roll and the
    exact one: never more than 2.0e-6 rad (2.0e-3 rad).

    Args:
        matrix: Rotation matrices. Shape (..., 3, 3).
        reference_rpy: Angles to be near to, in [rad]; broadcast against `matrix`. Shape (..., 3).

    Returns:
        Fixed-axis roll, pitch and yaw, in [rad]. Shape (..., 3).

    Raises:
        InvalidInputError: A shape does not fit, or a tensor is not floating point.
    """
    require_trailing("matrix", matrix, (3, 3))
    require_trailing("reference_rpy", reference_rpy, (3,))
    batch = np.broadcast_shapes(matrix.shape[:-2], reference_rpy.shape[:-1])
    matrix = matrix.expand(*batch, 3, 3)
    reference = reference_rpy.to(dtype=matrix.dtype, device=matrix.device).expand(*batch, 3)
    threshold = SINGULAR_COS_PITCH_FLOAT64 if matrix.dtype == torch.float64 else SINGULAR_COS_PITCH_FLOAT32
    sin_pitch = -matrix[..., 2, 0]
    cos_pitch = torch.hypot(matrix[..., 2, 1], matrix[..., 2, 2])
    near = cos_pitch < threshold
    reference_roll = reference[..., 0]

    pitch = torch.atan2(sin_pitch, cos_pitch)
    # At the upper pole the matrix holds roll - yaw, at the lower pole roll + yaw.
    sign = torch.where(sin_pitch >= 0, 1.0, -1.0).to(matrix.dtype)
    difference = torch.atan2(sign * matrix[..., 0, 1], matrix[..., 1, 1])
    polar_yaw = sign * (reference_roll - difference)

    def branch(flip: float) -> torch.Tensor:
        roll = torch.atan2(flip * matrix[..., 2, 1], flip * matrix[..., 2, 2])
        yaw = torch.atan2(flip * matrix[..., 1, 0], flip * matrix[..., 0, 0])
        roll = torch.where(near, reference_roll, roll)
        yaw = torch.where(near, polar_yaw, yaw)
        angles = torch.stack([roll, pitch if flip > 0 else math.pi - pitch, yaw], dim=-1)
        turns = torch.round((reference - angles) / (2.0 * math.pi))
        return angles + 2.0 * math.pi * turns

    first, second = branch(1.0), branch(-1.0)
    nearer = (first - reference).square().sum(-1) <= (second - reference).square().sum(-1)
    return torch.where(nearer[..., None], first, second)
