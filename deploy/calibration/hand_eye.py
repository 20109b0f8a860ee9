"""Hand-eye calibration: the camera's pose on the flange from views of one fixed board.

With A the flange in the base, X the camera on the flange, B the board before the camera and Z the board in the base,
every view has A X B = Z. A first X follows in closed form from pairs of views (Park and Martin, "Robot sensor
calibration: solving AX = XB on the Euclidean group", IEEE Transactions on Robotics and Automation 10, 1994); then X
and Z are moved until the board's corners are where the pictures show them (least squares), because errors are equal in
pixels and not in poses. OpenCV has closed forms of this too, but its Python module lacks
them from 5.0.0 on.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from maniskill_tomato.deploy.calibration.board import CharucoBoard
from maniskill_tomato.deploy.deploy_errors import DeployError
from maniskill_tomato.deploy.interface import Float64
from maniskill_tomato.deploy.rigid import difference, transform
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
class Agreement:
    """How well views of one fixed board agree about where the camera sits on the flange."""

    T_flange_camera: Float64
    """The colour camera's optical frame in `link_ee`. Shape (4, 4)."""
    T_base_board: Float64
    """The board in the base frame, where all views together put it. Shape (4, 4)."""
    views: tuple[BoardView, ...]
    """Those that were used."""
    left_out: tuple[str, ...]
    """Names of those that were not, with the reason."""
    residuals_px: tuple[Float64, ...]
    """Seen less predicted corner of each used view, in [px]. Shapes (M, 2)."""
    board_offsets: Float64
    """Position of the board by each view alone less that by all, base frame, in [m]. Shape (V, 3)."""
    board_turns: Float64
    """The same for its orientation, in [rad]. Shape (V,)."""

    @property
    def rms_px(self) -> float:
        """Root mean square distance of a seen corner from its prediction, in [px]."""
        return rms(np.concatenate(self.residuals_px))

    @property
    def board_position_rms(self) -> float:
        """Root mean square length of `board_offsets`, in [m]."""
        return rms(self.board_offsets)

    @property
    def board_turn_rms(self) -> float:
        """Root mean square of `board_turns`, in [rad]."""
        return rms(self.board_turns[:, None])


@dataclass(frozen=True, eq=False, kw_only=True)
class HandEyeResult(Agreement):
    """The camera on the flange, moved until the views agreed best about it."""

    position_std: float
    """Standard deviation of the camera's position on the flange, from the residuals, in [m]."""
    rotation_std: float
    """The same of its orientation, in [rad]."""


def rms(vectors: Float64) -> float:
    """Root mean square length. Shape (N, D)."""
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=1))))


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
    return transform(Rotation.from_rotvec(np.ravel(turns[0])), np.ravel(shifts[0]))


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
    used, left_out = usable_views(views)
    while True:
        flanges = np.stack([v.T_base_flange for v in used])
        boards = np.stack([board_pose(board, v, intrinsics) for v in used])
        check_turns(flanges)
        start = _closed_form(flanges, boards)
        about = _mean_pose(flanges @ start @ boards)
        pose, about, covariance, residuals = _refine(board, used, intrinsics, start, about)
        errors = np.array([rms(r) for r in residuals])
        worst = int(np.argmax(errors))
        if errors[worst] <= OUTLIER_PX:
            break
        left_out.append(f"{used[worst].name}: {errors[worst]:.1f} px off")
        del used[worst]
        _check_count(used, left_out)
    offsets, turns = _boards_alone(flanges @ pose @ boards, about)
    return HandEyeResult(
        T_flange_camera=pose,
        T_base_board=about,
        views=tuple(used),
        left_out=tuple(left_out),
        residuals_px=tuple(residuals),
        position_std=float(np.sqrt(np.trace(covariance[3:6, 3:6]))),
        rotation_std=float(np.sqrt(np.trace(covariance[:3, :3]))),
        board_offsets=offsets,
        board_turns=turns,
    )


def agreement_about(
    board: CharucoBoard, views: Sequence[BoardView], intrinsics: CameraIntrinsics, T_flange_camera: Float64
) -> Agreement:
    """How well views agree about a camera whose place on the flange is given.

    Only the board's place is fitted. No view is left out because it does not agree.

    Args:
        board: As measured on the print.
        views: From different places, turned about different axes.
        intrinsics: Of the colour pictures.
        T_flange_camera: The colour camera's optical frame in `link_ee`. Shape (4, 4).

    Raises:
        CalibrationError: Too few views, too few corners, or turns about one axis only.
    """
    used, left_out = usable_views(views)
    flanges = np.stack([v.T_base_flange for v in used])
    boards = np.stack([board_pose(board, v, intrinsics) for v in used])
    check_turns(flanges)
    pose = np.asarray(T_flange_camera, np.float64)
    about = _mean_pose(flanges @ pose @ boards)
    _, about, _, residuals = _refine(board, used, intrinsics, pose, about, is_camera_fixed=True)
    offsets, turns = _boards_alone(flanges @ pose @ boards, about)
    return Agreement(
        T_flange_camera=pose,
        T_base_board=about,
        views=tuple(used),
        left_out=tuple(left_out),
        residuals_px=tuple(residuals),
        board_offsets=offsets,
        board_turns=turns,
    )


def usable_views(views: Sequence[BoardView]) -> tuple[list[BoardView], list[str]]:
    """Those with enough corners, and the others' names with the reason.

    Raises:
        CalibrationError: Too few are left.
    """
    left_out = [f"{v.name}: {len(v.corner_ids)} corners" for v in views if len(v.corner_ids) < MIN_CORNERS]
    used = [v for v in views if len(v.corner_ids) >= MIN_CORNERS]
    _check_count(used, left_out)
    return used, left_out


def _check_count(used: Sequence[BoardView], left_out: Sequence[str]) -> None:
    if len(used) < MIN_VIEWS:
        detail = f" (left out: {'; '.join(left_out)})" if left_out else ""
        raise CalibrationError(
            f"{len(used)} usable views, {MIN_VIEWS} are needed{detail}; take more with the whole board in "
            "the picture"
        )


def check_turns(flanges: Float64) -> None:
    """Accepts views that turn about more than one axis; others do not tell where the camera is. Shape (V, 4, 4).

    Raises:
        CalibrationError: They do not.
    """
    i, j = np.triu_indices(len(flanges), k=1)
    turns = Rotation.from_matrix((np.linalg.inv(flanges[j]) @ flanges[i])[:, :3, :3]).as_rotvec()
    spread = np.linalg.svd(turns / np.sqrt(len(turns)), compute_uv=False)
    if spread[1] < MIN_TURN:
        raise CalibrationError(
            f"the views hardly turn about a second axis ({np.degrees(spread[1]):.1f} degrees, "
            f"{np.degrees(MIN_TURN):.1f} are needed): tilt the camera and roll it between views"
        )


def _closed_form(flanges: Float64, boards: Float64) -> Float64:
    """X of A X = X B over all pairs of views, A and B the motions of flange and camera (Park and Martin, 1994)."""
    i, j = np.triu_indices(len(flanges), k=1)
    a, b = np.linalg.inv(flanges[j]) @ flanges[i], boards[j] @ np.linalg.inv(boards[i])
    turns = Rotation.from_matrix(a[:, :3, :3]).as_rotvec()
    rotation = Rotation.align_vectors(turns, Rotation.from_matrix(b[:, :3, :3]).as_rotvec())[0]
    matrix = np.concatenate(a[:, :3, :3] - np.eye(3))
    right = np.concatenate(rotation.apply(b[:, :3, 3]) - a[:, :3, 3])
    return transform(rotation, np.linalg.lstsq(matrix, right, rcond=None)[0])


def _boards_alone(boards: Float64, about: Float64) -> tuple[Float64, Float64]:
    """How far the board by each view lies from that by all, in [m] and [rad]. Shapes (V, 3) and (V,)."""
    return boards[:, :3, 3] - about[:3, 3], np.array([difference(about, pose)[1] for pose in boards])


def _mean_pose(poses: Float64) -> Float64:
    return transform(Rotation.from_matrix(poses[:, :3, :3]).mean(), np.median(poses[:, :3, 3], axis=0))


def _refine(
    board: CharucoBoard,
    views: Sequence[BoardView],
    intrinsics: CameraIntrinsics,
    T_flange_camera: Float64,
    T_base_board: Float64,
    is_camera_fixed: bool = False,
) -> tuple[Float64, Float64, Float64, list[Float64]]:
    """X, Z, the covariance of X (rotation, then translation) and each view's residuals at the smallest squares.

    With the camera fixed only Z is moved, and the covariance is that of Z.
    """
    corners = board.corners
    points = [corners[v.corner_ids] for v in views]
    seen = np.concatenate([v.corners_px for v in views])
    to_flange = np.linalg.inv(np.stack([v.T_base_flange for v in views]))
    of_view = np.repeat(np.arange(len(views)), [len(p) for p in points])
    stacked = np.concatenate(points)

    def moved(pose: Float64, step: Float64) -> Float64:
        return pose @ transform(Rotation.from_rotvec(step[:3]), step[3:])

    pose, about = T_flange_camera, T_base_board

    def stepped(steps: Float64) -> tuple[Float64, Float64]:
        return pose if is_camera_fixed else moved(pose, steps[:6]), moved(about, steps[-6:])

    def residual(steps: Float64) -> Float64:
        camera, print_ = stepped(steps)
        chains = (np.linalg.inv(camera) @ to_flange @ print_)[of_view]
        in_camera = (chains[:, :3, :3] @ stacked[:, :, None])[..., 0] + chains[:, :3, 3]
        return np.nan_to_num((seen - intrinsics.project(in_camera)).ravel(), nan=1e4)

    def fit() -> Any:
        return least_squares(residual, np.zeros(count), "3-point", x_scale="jac", ftol=1e-12, xtol=1e-12)

    count = 6 if is_camera_fixed else 12
    found = fit()
    # Once more from the solution, where the Jacobian is wanted for the covariance.
    pose, about = stepped(found.x)
    found = fit()
    pose, about = stepped(found.x)
    error = found.fun
    variance = float(error @ error) / max(1, len(error) - count)
    covariance = np.asarray(variance * np.linalg.pinv(found.jac.T @ found.jac), np.float64)
    ends = np.cumsum([len(p) for p in points])[:-1]
    return pose, about, covariance, [np.asarray(r) for r in np.split(error.reshape(-1, 2), ends)]
