"""The calibration file: where the camera sits on the flange, and how that was measured."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.deploy.calibration.hand_eye import HandEyeResult
from maniskill_tomato.deploy.calibration.view_folder import RecordedView
from maniskill_tomato.deploy.deploy_errors import ProfileError
from maniskill_tomato.deploy.interface import Float64
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.files import write_atomically
from maniskill_tomato.robot.d435 import CameraIntrinsics
from maniskill_tomato.tables import read_table
from maniskill_tomato.text_files import read_json


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """How a camera's place on the flange was measured. What a file does not say is None or empty."""

    serial: str = ""
    """Of the camera."""
    arm_model: str = ""
    """Name of the arm whose kinematics told where the flange was."""
    taken: str | None = None
    """When the oldest view was taken, ISO 8601 with a time zone."""
    intrinsics: CameraIntrinsics | None = None
    """Of the views."""
    view_count: int | None = None
    """Views that were used."""
    rms_px: float | None = None
    """Root mean square distance of a seen corner from its prediction, in [px]."""
    board_position_rms: float | None = None
    """How far the board by each view alone lies from that by all, root mean square, in [m]."""
    board_turn_rms: float | None = None
    """The same of its orientation, in [rad]."""
    position_std: float | None = None
    """Standard deviation of the camera's position on the flange, in [m]."""
    rotation_std: float | None = None
    """The same of its orientation, in [rad]."""
    pictures: tuple[str, ...] = ()
    """`picture_id` of every view that the calculation was given."""


def picture_id(color: NDArray[np.uint8]) -> str:
    """The SHA-256 of a picture's pixels, whatever file they come from. Shape (H, W, 3)."""
    return hashlib.sha256(repr(color.shape).encode() + np.ascontiguousarray(color).tobytes()).hexdigest()


def write_calibration(
    path: Path,
    result: HandEyeResult,
    views: Sequence[RecordedView],
    intrinsics: CameraIntrinsics,
    serial: str = "",
) -> Calibration:
    """Writes a calibration file, whole or not at all.

    Args:
        path: The file; one that is there is replaced.
        result: What the views gave.
        views: All that the calculation was given.
        intrinsics: Of the pictures.
        serial: Of the camera, empty if unknown.

    Returns:
        What the file says beside the pose.

    Raises:
        CheckpointError: It cannot be written.
    """
    dates = [view.taken for view in views]
    calibration = Calibration(
        serial=serial,
        arm_model=views[0].model.name,
        taken=min(dates) if all(dates) else None,
        intrinsics=intrinsics,
        view_count=len(result.views),
        rms_px=result.rms_px,
        board_position_rms=result.board_position_rms,
        board_turn_rms=result.board_turn_rms,
        position_std=result.position_std,
        rotation_std=result.rotation_std,
        pictures=tuple(picture_id(view.color) for view in views),
    )
    content = {
        "T_flange_camera": result.T_flange_camera.tolist(),
        **asdict(calibration),
        "about": "T_flange_camera: the colour camera's optical frame (z forward, x right, y down) in the flange's "
        "frame link_ee (the plain flange face); metres, radians",
    }
    write_atomically(path, (json.dumps(content, indent=1) + "\n").encode())
    return calibration


def read_calibration(path: Path) -> tuple[Float64, Calibration]:
    """The camera's optical frame in `link_ee`, shape (4, 4), and how it was measured.

    Files of earlier versions say less. `calibration_limits` judges what a file says.

    Raises:
        ProfileError: There is none, it is broken, or a number in it is not finite; the message names file and key.
    """
    try:
        table = read_json(path)
    except (OSError, ValueError) as error:
        raise ProfileError(
            f"the calibration {path} cannot be used ({error}); `maniskill-tomato deploy calibrate` writes it"
        ) from error
    if not isinstance(table, dict) or "T_flange_camera" not in table:
        raise ProfileError(
            f"the calibration {path} cannot be used: it has no T_flange_camera; `maniskill-tomato deploy calibrate` "
            "writes it"
        )
    pose = rigid_pose(table["T_flange_camera"], f"T_flange_camera in {path}")
    known = {field.name for field in fields(Calibration)}
    try:
        facts = read_table(Calibration, {k: v for k, v in table.items() if k in known}, path)
    except InvalidInputError as error:
        raise ProfileError(f"the calibration cannot be used: {error}") from error
    return pose, facts


def rigid_pose(values: Any, where: str) -> Float64:
    """A camera's place on the flange from nested lists.

    Args:
        values: Four rows of four numbers, in [m].
        where: Names it in messages.

    Returns:
        Read-only. Shape (4, 4).

    Raises:
        ProfileError: They are no finite rigid transform, or the camera would not be on the flange.
    """
    try:
        T = np.array(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        T = np.zeros(0)
    if T.shape != (4, 4) or not np.isfinite(T).all() or not np.allclose(T[3], [0, 0, 0, 1]):
        raise ProfileError(f"{where} must be a 4 x 4 transform, got {values!r}")
    R = T[:3, :3]
    if not np.allclose(R @ R.T, np.eye(3), atol=1e-3) or np.linalg.det(R) < 0.0:
        raise ProfileError(f"{where} has no rotation in its upper left 3 x 3 entries")
    if np.linalg.norm(T[:3, 3]) > 0.5:
        raise ProfileError(f"{where} puts the camera more than 0.5 m from the flange; metres are expected")
    T.setflags(write=False)
    return T
