"""How far what the arm carries can move between two postures of a straight line in joint space.

A point turns about each joint's axis with a radius that the segments between bound, whatever the posture. So its speed
along the line is at most the sum of turn times lever arm, and its acceleration is bounded likewise. The checks of a
move rest on this: what lies between the postures that they look at is known too.
"""

import math

import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.deploy.interface import Float64


def lever_arms(origins: Float64, beyond: float) -> Float64:
    """Bounds of the distance of a point of the last link from each joint's axis, in [m].

    Args:
        origins: Of each joint in the frame of the link before it, in [m]. Shape (n, 3).
        beyond: How far the point is from the last origin, in [m].

    Returns:
        Shape (n,).
    """
    segments = np.append(np.linalg.norm(origins[1:], axis=1), beyond)
    arms: Float64 = np.cumsum(segments[::-1])[::-1]
    return arms


def straight_line(start: Float64, end: Float64, pieces: int) -> Float64:
    """Joint positions on the straight line from `start` to `end` at equal steps. Shape (pieces + 1, 7)."""
    line: Float64 = start + np.linspace(0.0, 1.0, pieces + 1)[:, None] * (end - start)
    return line


def joint_path(start: Float64, end: Float64, step: float) -> Float64:
    """Joint positions on the straight line from `start` to `end`, both included, at most `step` [rad] apart.

    Shape (N, 7), N at least 2.
    """
    return straight_line(start, end, max(1, math.ceil(float(np.abs(end - start).max()) / step)))


def motion(turn: Float64, levers: Float64) -> float:
    """How far a point moves at most along a line, in [m].

    Args:
        turn: How far each joint turns, in [rad]. Shape (n,).
        levers: From `lever_arms`, in [m]. Shape (n,).
    """
    return float(np.abs(turn) @ levers)


def chord_error(turn: Float64, levers: Float64, pieces: int) -> float:
    """How far a point is at most from the chords between equally spaced postures of a line, in [m].

    Args:
        turn: How far each joint turns, in [rad]. Shape (n,).
        levers: From `lever_arms`, in [m]. Shape (n,).
        pieces: Of the line.
    """
    # The second derivative of a point by joints i <= j is at most its distance from axis j.
    turns = np.abs(turn)
    before = np.cumsum(turns) - turns
    acceleration = float((levers * turns * (turns + 2.0 * before)).sum())
    return acceleration / (8.0 * pieces**2)


def pieces_for(turn: Float64, levers: Float64, error: float) -> int:
    """So many equal pieces of a line keep `chord_error` below an error in [m]."""
    return max(1, math.ceil(math.sqrt(chord_error(turn, levers, 1) / error)))


def chords_meet(points: Float64, low: Float64, high: Float64) -> NDArray[np.bool_]:
    """Whether each chord of a chain of points has something in common with an axis-aligned box.

    Args:
        points: In [m]. Shape (N + 1, 3).
        low: Lower corner, in [m]. Shape (3,).
        high: Upper corner, in [m]. Shape (3,).

    Returns:
        Shape (N,).
    """
    start, way = points[:-1], np.diff(points, axis=0)
    way = np.where(np.abs(way) < 1e-12, 1e-12, way)
    first, second = (low - start) / way, (high - start) / way
    enters = np.minimum(first, second).max(-1)
    leaves = np.maximum(first, second).min(-1)
    return np.asarray(np.maximum(enters, 0.0) <= np.minimum(leaves, 1.0))
