"""The plant's surface as the camera saw it: a point cloud that the arm keeps clear of."""

import math
from typing import Final

import numpy as np
import torch

from maniskill_tomato.deploy.interface import Float64, Frame
from maniskill_tomato.deploy.motion_bounds import chord_error, lever_arms, motion, straight_line
from maniskill_tomato.robot.arm_model import ArmModel
from maniskill_tomato.robot.d435 import T_flange_camera_color_optical
from maniskill_tomato.robot.iiwa14 import IIWA14
from maniskill_tomato.robot.kinematics import link_transforms
from maniskill_tomato.robot.spheres import sphere_table

CELL: Final = 0.015
"""Points are kept one to a cube of this size, in [m]."""

STRIDE: Final = 2
"""Every second row and column of the depth image is taken."""

REACH: Final = 0.9
"""What is farther from the camera is left for a later view, in [m]: depth noise grows with the square."""

NEAREST: Final = 0.12
"""What is nearer is left out, in [m]: at the edge of what the D435 measures there are false points."""

SELF_MARGIN: Final = 0.03
"""Points within this distance of the arm's own spheres are the arm, in [m]."""

JUMP_SHARE: Final = 0.03
"""Where neighbouring depths differ by more than this share, the pixels between them are of neither surface."""

COARSE_STEP: Final = 0.1
"""Spheres move less than this between two postures at which a move is first looked at, in [m]."""

FINE_STEP: Final = 0.01
"""The same near points, in [m]: what a sphere touches in between is less than 1 mm inside it."""


class PlantPoints:
    """A cloud of occupied cells in the base frame that grows with every view."""

    def __init__(
        self,
        T_flange_camera: Float64 = T_flange_camera_color_optical,
        cell: float = CELL,
        model: ArmModel = IIWA14,
    ) -> None:
        """Begins with nothing.

        Args:
            T_flange_camera: The camera's optical frame in `link_ee`. Shape (4, 4).
            cell: Edge of a cell, in [m].
            model: Of the arm.
        """
        self._model = model
        self._T_flange_camera = T_flange_camera
        self._cell = cell
        self._cells: dict[tuple[int, int, int], None] = {}
        self._points: Float64 | None = None

    def __len__(self) -> int:
        return len(self._cells)

    @property
    def points_w(self) -> Float64:
        """Centres of the occupied cells, in [m]. Shape (N, 3)."""
        if self._points is None:
            cells = np.array(list(self._cells), dtype=np.float64).reshape(-1, 3)
            self._points = (cells + 0.5) * self._cell
        return self._points

    def add(self, frame: Frame, T_world_camera: Float64, joint_positions: Float64) -> int:
        """Takes in a view.

        Args:
            frame: Its depth is used.
            T_world_camera: Pose of the optical frame. Shape (4, 4).
            joint_positions: The arm's, in [rad], to leave its own links out. Shape (7,).

        Returns:
            How many points are new.
        """
        points = depth_points(frame, T_world_camera)
        if len(points):
            distances = sphere_distances(joint_positions[None], points, self._T_flange_camera, self._model)
            points = points[distances[0] > SELF_MARGIN]
        before = len(self._cells)
        for x, y, z in np.unique(np.floor(points / self._cell).astype(np.int64), axis=0).tolist():
            self._cells[x, y, z] = None
        self._points = None
        return len(self._cells) - before


def depth_points(frame: Frame, T_world_camera: Float64) -> Float64:
    """The points of a depth image in the base frame, those at edges between surfaces left out. Shape (N, 3)."""
    depth = frame.depth.astype(np.float64)
    smooth = np.ones(depth.shape, dtype=np.bool_)
    for axis in (0, 1):
        jump = np.abs(np.diff(depth, axis=axis)) > JUMP_SHARE * depth.max(initial=0.0, where=depth < REACH)
        first = [slice(None), slice(None)]
        second = [slice(None), slice(None)]
        first[axis], second[axis] = slice(0, -1), slice(1, None)
        smooth[tuple(first)] &= ~jump
        smooth[tuple(second)] &= ~jump
    taken = (depth > NEAREST) & (depth < REACH) & np.isfinite(depth) & smooth
    chosen = np.zeros_like(taken)
    chosen[::STRIDE, ::STRIDE] = taken[::STRIDE, ::STRIDE]
    rows, columns = np.nonzero(chosen)
    pixels = np.stack([columns + 0.5, rows + 0.5], axis=-1)
    points_c = frame.intrinsics.ray_directions(pixels) * depth[rows, columns, None]
    points: Float64 = points_c @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
    return points


def sphere_distances(
    joint_positions: Float64,
    points_w: Float64,
    T_flange_camera: Float64 = T_flange_camera_color_optical,
    model: ArmModel = IIWA14,
) -> Float64:
    """Distances between points and the nearest of the arm's spheres (`robot.spheres`).

    Args:
        joint_positions: In [rad]. Shape (N, 7).
        points_w: In the base frame, in [m]. Shape (P, 3).
        T_flange_camera: The camera's optical frame in `link_ee`. Shape (4, 4).
        model: Of the arm.

    Returns:
        In [m], negative inside a sphere. Shape (N, P).
    """
    radii = sphere_table(T_flange_camera, model)[1][:, 3].astype(np.float64)
    return _distances(_centres(joint_positions, T_flange_camera, model), radii, points_w)


def swept_distances(
    start: Float64,
    goal: Float64,
    points_w: Float64,
    limit: float,
    T_flange_camera: Float64,
    model: ArmModel = IIWA14,
) -> Float64:
    """The same at the nearest posture of a straight line in joint space.

    Args:
        start: Where the line begins, in [rad]. Shape (7,).
        goal: Where it ends, in [rad]. Shape (7,).
        points_w: In the base frame, in [m]. Shape (P, 3).
        limit: What is farther away need not be known exactly, in [m].
        T_flange_camera: The camera's optical frame in `link_ee`. Shape (4, 4).
        model: Of the arm.

    Returns:
        In [m], below the limit wherever the true one is 1 mm below it, and never too small. Shape (P,).
    """
    links, spheres = sphere_table(T_flange_camera, model)
    radii = spheres[:, 3].astype(np.float64)
    last = spheres[links == links.max(), :3].astype(np.float64)
    turn = goal - start
    beyond = abs(model.flange_height) + float(np.linalg.norm(last, axis=1).max())
    levers = lever_arms(model.joint_origins, beyond)
    pieces = max(1, math.ceil(motion(turn, levers) / COARSE_STEP))
    line = straight_line(start, goal, pieces)
    centres = _centres(line, T_flange_camera, model)
    coarse = _distances(centres, radii, points_w)
    nearest: Float64 = coarse.min(axis=0)
    error = chord_error(turn, levers, pieces)
    chords = np.linalg.norm(np.diff(centres, axis=0), axis=-1).max(axis=-1)
    within = np.minimum(coarse[:-1], coarse[1:]) < limit + error + chords[:, None] / 2.0
    for k in np.flatnonzero(within.any(axis=1)):
        # A smooth curve is at most four errors of its chord faster than the chord.
        fine = straight_line(line[k], line[k + 1], math.ceil((chords[k] + 4.0 * error) / FINE_STEP) or 1)
        found = sphere_distances(fine, points_w[within[k]], T_flange_camera, model).min(axis=0)
        nearest[within[k]] = np.minimum(nearest[within[k]], found)
    return nearest


def _centres(joint_positions: Float64, T_flange_camera: Float64, model: ArmModel) -> Float64:
    """Of the spheres, base frame, in [m]. Shape (N, S, 3)."""
    links, spheres = sphere_table(T_flange_camera, model)
    T = link_transforms(torch.as_tensor(np.array(joint_positions), dtype=torch.float64), model).numpy()
    centres_l = np.concatenate([spheres[:, :3], np.ones((len(spheres), 1))], axis=1).astype(np.float64)
    centres: Float64 = np.einsum("nsij,sj->nsi", T[:, links], centres_l)[..., :3]
    return centres


def _distances(centres: Float64, radii: Float64, points_w: Float64) -> Float64:
    distances = np.full((len(centres), len(points_w)), np.inf)
    squares = (points_w**2).sum(-1)
    for k, radius in enumerate(radii):
        c = centres[:, k]
        square = (c**2).sum(-1)[:, None] + squares[None] - 2.0 * c @ points_w.T
        np.minimum(distances, np.sqrt(np.maximum(square, 0.0)) - radius, out=distances)
    return distances
