"""Rigid transforms as matrices, with SciPy's rotations."""

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from maniskill_tomato.deploy.interface import Float64


def transform(rotation: Rotation, translation: npt.ArrayLike) -> Float64:
    """The homogeneous transform of one rotation and a translation of shape (3,). Shape (4, 4)."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.as_matrix(), translation
    return pose


def difference(a: Float64, b: Float64) -> tuple[float, float]:
    """How far two poses are apart, in [m] and [rad]."""
    turn = Rotation.from_matrix(a[:3, :3].T @ b[:3, :3]).magnitude()
    return float(np.linalg.norm(a[:3, 3] - b[:3, 3])), float(turn)
