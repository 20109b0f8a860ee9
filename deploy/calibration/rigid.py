"""Rotation vectors and rigid transforms in NumPy."""

import numpy as np

from maniskill_tomato.deploy.interface import Float64


def rotation_from_vector(vector: Float64) -> Float64:
    """The rotation about an axis by the vector's length, in [rad] (Rodrigues). Shape (3,) to (3, 3)."""
    angle = float(np.linalg.norm(vector))
    x, y, z = vector
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    if angle < 1e-9:
        return np.asarray(np.eye(3) + cross)
    return np.asarray(
        np.eye(3) + np.sin(angle) / angle * cross + (1.0 - np.cos(angle)) / angle**2 * (cross @ cross)
    )


def vector_from_rotation(rotation: Float64) -> Float64:
    """The rotation vector of a rotation, of a length in [0, pi], in [rad]. Shape (3, 3) to (3,)."""
    skew = np.array(
        [
            rotation[2, 1] - rotation[1, 2],
            rotation[0, 2] - rotation[2, 0],
            rotation[1, 0] - rotation[0, 1],
        ]
    )
    sine, cosine = np.linalg.norm(skew) / 2.0, (np.trace(rotation) - 1.0) / 2.0
    angle = float(np.arctan2(sine, cosine))
    if sine > 1e-6:
        return np.asarray(skew / (2.0 * sine) * angle)
    if cosine > 0.0:
        return np.asarray(skew / 2.0)
    # Half a turn: the axis is the column of R + 1 with the largest diagonal.
    column = int(np.argmax(np.diag(rotation)))
    axis = (rotation + np.eye(3))[:, column]
    return np.asarray(axis / np.linalg.norm(axis) * angle)


def nearest_rotation(matrix: Float64) -> Float64:
    """The rotation nearest to a matrix in the Frobenius norm. Shape (3, 3)."""
    u, _, v = np.linalg.svd(matrix)
    return np.asarray(u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v)


def transform(rotation: Float64, translation: Float64) -> Float64:
    """The homogeneous transform. Shapes (3, 3) and (3,) to (4, 4)."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, translation
    return pose


def inverse(pose: Float64) -> Float64:
    """The inverse of rigid transforms. Shape (..., 4, 4)."""
    result = np.zeros_like(pose)
    rotation = np.swapaxes(pose[..., :3, :3], -1, -2)
    result[..., :3, :3] = rotation
    result[..., :3, 3] = -(rotation @ pose[..., :3, 3:])[..., 0]
    result[..., 3, 3] = 1.0
    return result


def difference(a: Float64, b: Float64) -> tuple[float, float]:
    """How far two poses are apart, in [m] and [rad]."""
    turn = vector_from_rotation(a[:3, :3].T @ b[:3, :3])
    return float(np.linalg.norm(a[:3, 3] - b[:3, 3])), float(np.linalg.norm(turn))
