"""Rotations as matrices, fixed-axis roll-pitch-yaw and quaternions, in torch.

Roll, pitch and yaw are fixed-axis angles: R = Rz(yaw) Ry(pitch) Rx(roll). At pitch = pi/2, the nominal
viewing direction of the tasks, only roll - yaw is defined by R, so the way back needs a reference.
Every function takes any number of leading dimensions and keeps dtype and device.
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


def _require_trailing(name: str, tensor: torch.Tensor, trailing: tuple[int, ...]) -> None:
    if tuple(tensor.shape[-len(trailing) :]) != trailing or not tensor.is_floating_point():
        wanted = ", ".join(["...", *map(str, trailing)])
        raise InvalidInputError(
            f"{name} must be a floating-point tensor of shape ({wanted}); "
            f"got {tensor.dtype} of shape {tuple(tensor.shape)}"
        )


def rpy_to_matrix(rpy: torch.Tensor) -> torch.Tensor:
    """The rotation matrix Rz(yaw) Ry(pitch) Rx(roll).

    Args:
        rpy: Roll, pitch and yaw about the fixed x, y and z axes, in [rad]. Shape (..., 3).

    Returns:
        Rotation matrices. Shape (..., 3, 3).

    Raises:
        InvalidInputError: The last dimension is not 3, or the tensor is not floating point.
    """
    _require_trailing("rpy", rpy, (3,))
    cr, cp, cy = torch.cos(rpy).unbind(-1)
    sr, sp, sy = torch.sin(rpy).unbind(-1)
    elements = (
        (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
        (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
        (-sp, cp * sr, cp * cr),
    )
    return torch.stack([torch.stack(row, dim=-1) for row in elements], dim=-2)


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
    _require_trailing("matrix", matrix, (3, 3))
    _require_trailing("reference_rpy", reference_rpy, (3,))
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


def quat_wxyz_to_matrix(quat_wxyz: torch.Tensor) -> torch.Tensor:
    """The rotation matrix of a quaternion, which is normalised first.

    Args:
        quat_wxyz: Quaternions, scalar first, of any length other than zero. Shape (..., 4).

    Returns:
        Rotation matrices. Shape (..., 3, 3).

    Raises:
        InvalidInputError: The last dimension is not 4, or the tensor is not floating point.
    """
    _require_trailing("quat_wxyz", quat_wxyz, (4,))
    w, x, y, z = (quat_wxyz / quat_wxyz.norm(dim=-1, keepdim=True)).unbind(-1)
    elements = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, dim=-1) for row in elements], dim=-2)


def matrix_to_quat_wxyz(matrix: torch.Tensor) -> torch.Tensor:
    """The unit quaternion of a rotation, scalar first and not negative.

    Args:
        matrix: Rotation matrices. Shape (..., 3, 3).

    Returns:
        Quaternions with w >= 0. Shape (..., 4).

    Raises:
        InvalidInputError: The last dimensions are not 3 x 3, or the tensor is not floating point.
    """
    _require_trailing("matrix", matrix, (3, 3))
    m00, m11, m22 = matrix.diagonal(dim1=-2, dim2=-1).unbind(-1)
    xw = matrix[..., 2, 1] - matrix[..., 1, 2]
    yw = matrix[..., 0, 2] - matrix[..., 2, 0]
    zw = matrix[..., 1, 0] - matrix[..., 0, 1]
    xy = matrix[..., 0, 1] + matrix[..., 1, 0]
    xz = matrix[..., 0, 2] + matrix[..., 2, 0]
    yz = matrix[..., 1, 2] + matrix[..., 2, 1]
    # Row i is 4 q_i q; the row with the largest q_i loses no digits to cancellation.
    rows = torch.stack(
        [
            torch.stack([1 + m00 + m11 + m22, xw, yw, zw], dim=-1),
            torch.stack([xw, 1 + m00 - m11 - m22, xy, xz], dim=-1),
            torch.stack([yw, xy, 1 - m00 + m11 - m22, yz], dim=-1),
            torch.stack([zw, xz, yz, 1 - m00 - m11 + m22], dim=-1),
        ],
        dim=-2,
    )
    largest = rows.diagonal(dim1=-2, dim2=-1).argmax(dim=-1)
    index = largest[..., None, None].expand(*largest.shape, 1, 4)
    quat = rows.gather(-2, index).squeeze(-2)
    quat = quat / quat.norm(dim=-1, keepdim=True)
    return torch.where(quat[..., :1] < 0, -quat, quat)


def rotation_angle_between(matrix_a: torch.Tensor, matrix_b: torch.Tensor) -> torch.Tensor:
    """The angle of the rotation that takes one orientation to another, exact for small angles too.

    Args:
        matrix_a: Rotation matrices. Shape (..., 3, 3).
        matrix_b: Rotation matrices, broadcast against `matrix_a`. Shape (..., 3, 3).

    Returns:
        Angles in [0, pi], in [rad]. Shape (...).

    Raises:
        InvalidInputError: The last dimensions are not 3 x 3, or a tensor is not floating point.
    """
    _require_trailing("matrix_a", matrix_a, (3, 3))
    _require_trailing("matrix_b", matrix_b, (3, 3))
    # The Frobenius norm |A - B| is sqrt(8) sin(angle / 2), and the trace of A^T B is 4 cos(angle / 2)^2 - 1.
    sine = torch.linalg.matrix_norm(matrix_a - matrix_b) / math.sqrt(8.0)
    trace = (matrix_a * matrix_b).sum(dim=(-2, -1))
    cosine = torch.sqrt(torch.clamp((trace + 1.0) / 4.0, min=0.0))
    return 2.0 * torch.atan2(sine, cosine)
