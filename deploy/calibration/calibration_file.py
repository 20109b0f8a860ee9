"""The calibration as a JSON file, which a profile names in `calibration.file`."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from maniskill_tomato.deploy.calibration.hand_eye import CalibrationError, HandEyeResult
from maniskill_tomato.deploy.calibration.rigid import nearest_rotation
from maniskill_tomato.deploy.interface import Float64
from maniskill_tomato.files import write_atomically
from maniskill_tomato.robot.d435 import CameraIntrinsics

LARGEST_LEVER: Final = 0.5
"""A camera farther from the flange than this is taken for a mistake of units, in [m]."""


@dataclass(frozen=True, eq=False, kw_only=True)
class HandEyeCalibration:
    """What the loop needs of a calibration, and what tells whether it fits."""

    T_flange_camera: Float64
    """The colour camera's optical frame (z forward, x right, y down) in `link_ee`. Shape (4, 4)."""
    color_size: tuple[int, int]
    """Width and height of the pictures that it was made with, in [px]."""
    color_focal: tuple[float, float]
    """fx, fy of these pictures, in [px]."""
    serial: str
    """Serial number of the camera, empty if unknown."""
    rms_px: float
    """Root mean square distance of a seen corner from its prediction, in [px]."""
    position_std: float
    """Standard deviation of the camera's position, in [m]."""
    rotation_std: float
    """The same of its orientation, in [rad]."""
    view_count: int
    """Views used."""


def write_calibration(
    path: Path, result: HandEyeResult, intrinsics: CameraIntrinsics, serial: str = ""
) -> HandEyeCalibration:
    """Writes a calibration file, whole or not at all.

    Args:
        path: The file; one that is there is replaced.
        result: What the views gave.
        intrinsics: Of the pictures.
        serial: Of the camera.

    Returns:
        What the file holds.

    Raises:
        CheckpointError: It cannot be written.
    """
    calibration = HandEyeCalibration(
        T_flange_camera=result.T_flange_camera,
        color_size=(intrinsics.width, intrinsics.height),
        color_focal=(intrinsics.fx, intrinsics.fy),
        serial=serial,
        rms_px=result.rms_px,
        position_std=result.position_std,
        rotation_std=result.rotation_std,
        view_count=len(result.views),
    )
    content = asdict(calibration) | {
        "T_flange_camera": result.T_flange_camera.tolist(),
        "about": "T_flange_camera: the colour camera's optical frame (z forward, x right, y down) in the flange's "
        "frame link_ee (the plain flange face); metres, radians",
    }
    write_atomically(path, (json.dumps(content, indent=1) + "\n").encode())
    return calibration


def read_calibration(path: Path) -> HandEyeCalibration:
    """Reads a calibration file.

    Raises:
        CalibrationError: It is missing, or a value is missing or cannot be; the message names it.
    """
    try:
        table = json.loads(path.read_text())
    except FileNotFoundError as error:
        raise CalibrationError(
            f"no calibration at {path}; `maniskill-tomato deploy calibrate` writes one"
        ) from error
    except (OSError, ValueError, RecursionError) as error:
        raise CalibrationError(f"{path} cannot be read: {error}") from error
    if not isinstance(table, dict):
        raise CalibrationError(f"{path} must hold a JSON object")
    pose = _numbers(table, "T_flange_camera", (4, 4), path)
    off = np.abs(pose[:3, :3] - nearest_rotation(pose[:3, :3])).max()
    if off > 1e-6 or not np.array_equal(pose[3], [0.0, 0.0, 0.0, 1.0]):
        raise CalibrationError(
            f"{path}: T_flange_camera must be a rotation and a translation, last row 0 0 0 1"
        )
    if np.linalg.norm(pose[:3, 3]) > LARGEST_LEVER:
        raise CalibrationError(
            f"{path}: T_flange_camera puts the camera {np.linalg.norm(pose[:3, 3]):.2f} m from the flange; "
            f"{LARGEST_LEVER} m at most are taken (is it in metres?)"
        )
    size = _numbers(table, "color_size", (2,), path)
    focal = _numbers(table, "color_focal", (2,), path)
    spreads = [float(_numbers(table, name, (), path)) for name in ("rms_px", "position_std", "rotation_std")]
    count = int(_numbers(table, "view_count", (), path))
    if np.any(size < 1) or np.any(focal <= 0.0) or min(spreads) < 0.0 or count < 1:
        raise CalibrationError(f"{path}: sizes, focal lengths, deviations and counts must be positive")
    serial = table.get("serial", "")
    if not isinstance(serial, str):
        raise CalibrationError(f"{path}: serial must be a string, got {serial!r}")
    return HandEyeCalibration(
        T_flange_camera=pose,
        color_size=(int(size[0]), int(size[1])),
        color_focal=(float(focal[0]), float(focal[1])),
        serial=serial,
        rms_px=spreads[0],
        position_std=spreads[1],
        rotation_std=spreads[2],
        view_count=count,
    )


def _numbers(table: dict[str, Any], name: str, shape: tuple[int, ...], path: Path) -> Float64:
    if name not in table:
        raise CalibrationError(f"{path}: {name} is missing")
    try:
        values = np.array(table[name], dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise CalibrationError(f"{path}: {name} must be numbers, got {table[name]!r}") from error
    if values.shape != shape or not np.all(np.isfinite(values)):
        raise CalibrationError(f"{path}: {name} must be finite numbers of shape {shape}, got {table[name]!r}")
    values.setflags(write=False)
    return values
