"""Hand-eye calibration: the camera's pose on the flange from views of one fixed board.

With A the flange in the base, X the camera on the flange, B the board before the camera and Z the board in the base,
every view has A X B = Z. A first X follows in closed form from pairs of views (Park and Martin, "Robot sensor
calibration: solving AX = XB on the Euclidean group", IEEE Transactions on Robotics and Automation 10, 1994); then X
and Z are moved until the board's corners are where the pictures show them (least squares, Levenberg-Marquardt),
because errors are equal in pixels and not in poses. OpenCV has closed forms of this too, but its Python module lacks
them from 5.0.0 on.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.deploy.calibration.board import CharucoBoard
from maniskill_tomato.deploy.calibration.rigid import (
    difference,
    inverse,
    nearest_rotation,
    rotation_from_vector,
    transform,
    vector_from_rotation,
)
from maniskill_tomato.deploy.deploy_errors import DeployError
from maniskill_tomato.deploy.interface import Float64
from maniskill_tomato.robot.d435 import CameraIntrinsics

MIN_VIEWS: Final = 5
"""Fewer views are not taken; 15 are usual."""

MIN_CORNERS: Final = 8
"""Corners that a picture must show."""

MIN_TURN: Final = 0.15
"""How much the views must turn about a second axis, as the singular value of their rotations, in [rad]."""

OUTLIER_PX: Final = 2.0
"""A view whose corners are off by more than this (root mean square) is left out, in [px]."""


class CalibrationError(DeployError):
    """Views, a board or a calibration file cannot be used."""

    reason = "calibration"


@dataclass(frozen=True, eq=False, kw_only=True)
class BoardView:
    """One picture of the board."""

    name: str
    """Of the picture, for messages."""
    T_base_flange: Float64
    """Where `link_ee` was. Shape (4, 4)."""
    corner_ids: NDArray[np.int64]
    """Which corners of the board are seen. Shape (M,)."""
    corners_px: Float64
    """Where, in continuous image coordinates, in [px]. Shape (M, 2)."""


@dataclass(frozen=True, eq=False, kw_only=True)
class HandEyeResult:
    """The camera on the flange, and how well the views agree about it."""

    T_flange_camera: Float64
    """The colour camera's optical frame in `link_ee`. Shape (4, 4)."""
    T_base_board: Float64
    """The board in the base frame. Shape (4, 4)."""
    views: tuple[BoardView, ...]
    """Those that were used."""
    left_out: tuple[str, ...]
    """Names of those that were not, with the reason."""
    residuals_px: tuple[Float64, ...]
    """Seen less predicted corner of each used view, in [px]. Shapes (M, 2)."""
    position_std: float
    """Standard deviation of the camera's position on the flange, from the residuals, in [m]."""
    rotation_std: float
    """The same of its orientation, in [rad]."""
    board_offsets: Float64
    """Position of the board by each view alone less that by all, base frame, in [m]. Shape (V, 3)."""
    board_turns: Float64
    """The same for its orientation, in [rad]. Shape (V,)."""

    @property
    def rms_px(self) -> float:
        """Root mean square distance of a seen corner from its prediction, in [px]."""
        return float(np.sqrt(np.mean(np.sum(np.concatenate(self.residuals_px) ** 2, axis=1))))


def board_pose(board: CharucoBoard, view: BoardView, intrinsics: CameraIntrinsics) -> Float64:
    """The board before the camera, by one view alone.

    Returns:
        T_camera_board of the colour camera's optical frame. Shape (4, 4).

    Raises:
        CalibrationError: The corners allow no pose.
    """
    points = np.ascontiguousarray(board.corners[view.corner_ids])
    pixels = np.ascontiguousarray(view.corners_px).reshape(-1, 1, 2)
    # A plane has two poses that look alike; IPPE gives both, the better one first.
    try:
        found, turns, shifts, _ = cv2.solvePnPGeneric(
            points, pixels, intrinsics.matrix, None, flags=cv2.SOLVEPNP_IPPE
        )
    except cv2.error as error:
        raise CalibrationError(f"{view.name}: no pose of the board fits its corners ({error.err})") from error
    if found < 1 or not np.all(np.isfinite(turns[0])) or not np.all(np.isfinite(shifts[0])):
        raise CalibrationError(f"{view.name}: no pose of the board fits its corners")
    return transform(
        rotation_from_vector(np.asarray(turns[0], np.float64).reshape(3)),
        np.asarray(shifts[0], np.float64).reshape(3),
    )


def calibrate_hand_eye(
    board: CharucoBoard, views: Sequence[BoardView], intrinsics: CameraIntrinsics
) -> HandEyeResult:
    """The camera on the flange from views of a board that stood still.

    Args:
        board: As measured on the print.
        views: From different places, turned about different axes.
        intrinsics: Of the colour pictures.

    Raises:
        CalibrationError: Too few views, too few corners, or turns about one axis only.
    """
    left_out = [f"{v.name}: {len(v.corner_ids)} corners" for v in views if len(v.corner_ids) < MIN_CORNERS]
    used = [v for v in views if len(v.corner_ids) >= MIN_CORNERS]
    while True:
        if len(used) < MIN_VIEWS:
            detail = f" (left out: {'; '.join(left_out)})" if left_out else ""
            raise CalibrationError(
                f"{len(used)} usable views, {MIN_VIEWS} are needed{detail}; take more with the whole board in "
                "the picture"
            )
        flanges = np.stack([v.T_base_flange for v in used])
        boards = np.stack([board_pose(board, v, intrinsics) for v in used])
        start = _closed_form(flanges, boards)
        about = _mean_pose(flanges @ start @ boards)
        pose, about, covariance, residuals = _refine(board, used, intrinsics, start, about)
        rms = np.array([np.sqrt(np.mean(np.sum(r**2, axis=1))) for r in residuals])
        worst = int(np.argmax(rms))
        if rms[worst] <= OUTLIER_PX:
            break
        left_out.append(f"{used[worst].name}: {rms[worst]:.1f} px off")
        del used[worst]
    alone = flanges @ pose @ boards
    return HandEyeResult(
        T_flange_camera=pose,
        T_base_board=about,
        views=tuple(used),
        left_out=tuple(left_out),
        residuals_px=tuple(residuals),
        position_std=float(np.sqrt(np.trace(covariance[3:6, 3:6]))),
        rotation_std=float(np.sqrt(np.trace(covariance[:3, :3]))),
        board_offsets=alone[:, :3, 3] - about[:3, 3],
        board_turns=np.array([difference(about, pose)[1] for pose in alone]),
    )


def _closed_form(flanges: Float64, boards: Float64) -> Float64:
    """X of A X = X B over all pairs of views, A and B the motions of flange and camera (Park and Martin, 1994)."""
    alphas, betas, rows = [], [], []
    pairs = [(i, j) for i in range(len(flanges)) for j in range(i + 1, len(flanges))]
    for i, j in pairs:
        a = inverse(flanges[j]) @ flanges[i]
        b = boards[j] @ inverse(boards[i])
        alphas.append(vector_from_rotation(a[:3, :3]))
        betas.append(vector_from_rotation(b[:3, :3]))
        rows.append((a[:3, :3], a[:3, 3], b[:3, 3]))
    turns = np.array(alphas)
    spread = np.linalg.svd(turns / np.sqrt(len(turns)), compute_uv=False)
    if spread[1] < MIN_TURN:
        raise CalibrationError(
            f"the views hardly turn about a second axis ({np.degrees(spread[1]):.1f} degrees, "
            f"{np.degrees(MIN_TURN):.1f} are needed): tilt the camera and roll it between views"
        )
    rotation = nearest_rotation(turns.T @ np.array(betas))
    matrix = np.concatenate([r - np.eye(3) for r, _, _ in rows])
    right = np.concatenate([rotation @ tb - ta for _, ta, tb in rows])
    translation = np.linalg.lstsq(matrix, right, rcond=None)[0]
    return transform(rotation, translation)


def _mean_pose(poses: Float64) -> Float64:
    return transform(nearest_rotation(poses[:, :3, :3].mean(axis=0)), np.median(poses[:, :3, 3], axis=0))


def _refine(
    board: CharucoBoard,
    views: Sequence[BoardView],
    intrinsics: CameraIntrinsics,
    T_flange_camera: Float64,
    T_base_board: Float64,
) -> tuple[Float64, Float64, Float64, list[Float64]]:
    """X, Z, the covariance of X (rotation, then translation) and each view's residuals at the smallest squares."""
    corners = board.corners
    points = [corners[v.corner_ids] for v in views]
    seen = np.concatenate([v.corners_px for v in views])
    to_flange = np.stack([inverse(v.T_base_flange) for v in views])
    of_view = np.repeat(np.arange(len(views)), [len(p) for p in points])
    stacked = np.concatenate(points)

    def moved(pose: Float64, step: Float64) -> Float64:
        return pose @ transform(rotation_from_vector(step[:3]), step[3:])

    def residual(pose: Float64, about: Float64) -> Float64:
        chains = (inverse(pose) @ to_flange @ about)[of_view]
        in_camera = (chains[:, :3, :3] @ stacked[:, :, None])[..., 0] + chains[:, :3, 3]
        return np.nan_to_num((seen - intrinsics.project(in_camera)).ravel(), nan=1e4)

    pose, about = T_flange_camera, T_base_board
    error = residual(pose, about)
    damping, small = 1e-3, 1e-6
    jacobian, normal = np.zeros((len(error), 12)), np.zeros((12, 12))
    for _ in range(100):
        for k in range(12):
            step = np.zeros(12)
            step[k] = small
            ahead = residual(moved(pose, step[:6]), moved(about, step[6:]))
            behind = residual(moved(pose, -step[:6]), moved(about, -step[6:]))
            jacobian[:, k] = (ahead - behind) / (2.0 * small)
        normal, slope = jacobian.T @ jacobian, -(jacobian.T @ error)
        for _ in range(20):
            lifted = normal + damping * np.diag(np.diag(normal) + 1e-12)
            change = np.asarray(np.linalg.solve(lifted, slope), np.float64)
            trial = moved(pose, change[:6]), moved(about, change[6:])
            trial_error = residual(*trial)
            if trial_error @ trial_error <= error @ error:
                damping = max(damping / 10.0, 1e-12)
                break
            damping *= 10.0
        else:
            break
        pose, about = trial
        gain = error @ error - trial_error @ trial_error
        error = trial_error
        if np.linalg.norm(change) < 1e-10 or gain < 1e-12 * (error @ error):
            break
    variance = float(error @ error) / max(1, len(error) - 12)
    covariance = np.asarray(variance * np.linalg.pinv(normal), np.float64)
    ends = np.cumsum([len(p) for p in points])[:-1]
    return pose, about, covariance, [np.asarray(r) for r in np.split(error.reshape(-1, 2), ends)]
