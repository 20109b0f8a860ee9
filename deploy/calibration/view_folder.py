"""A folder of views: pictures of the board, `views.json` with the joint angles and the camera's intrinsics."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from maniskill_tomato.deploy.calibration.board import CharucoBoard
from maniskill_tomato.deploy.calibration.hand_eye import BoardView, CalibrationError
from maniskill_tomato.deploy.deploy_errors import ProfileError
from maniskill_tomato.deploy.drivers import arm_model
from maniskill_tomato.deploy.interface import Float64
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.files import write_atomically
from maniskill_tomato.robot.arm_model import NUM_JOINTS, ArmModel
from maniskill_tomato.robot.d435 import CameraIntrinsics
from maniskill_tomato.robot.iiwa14 import IIWA14
from maniskill_tomato.robot.kinematics import forward_kinematics
from maniskill_tomato.segmentation.datasets.picture_files import read_picture
from maniskill_tomato.text_files import read_json

INDEX_NAME: Final = "views.json"

LARGEST_INDEX_BYTES: Final = 1_000_000


@dataclass(frozen=True, eq=False, kw_only=True)
class RecordedView:
    """One picture and where the arm was."""

    name: str
    """File name of the picture."""
    color: NDArray[np.uint8]
    """RGB. Shape (H, W, 3)."""
    joint_positions: Float64
    """In [rad]. Shape (7,)."""
    taken: str = ""
    """When, in UTC as ISO 8601; empty if that is not known."""
    model: ArmModel = IIWA14
    """Of the arm."""


def flange_pose(joint_positions: Float64, model: ArmModel = IIWA14) -> Float64:
    """The flange in the base frame at joint angles in [rad]. Shape (7,) to (4, 4)."""
    return np.asarray(
        forward_kinematics(torch.from_numpy(np.array(joint_positions)), model).numpy(), np.float64
    )


def board_view(board: CharucoBoard, view: RecordedView) -> BoardView:
    """What a picture shows of the board."""
    ids, pixels = board.find(view.color)
    return BoardView(
        name=view.name,
        T_base_flange=flange_pose(view.joint_positions, view.model),
        corner_ids=ids,
        corners_px=pixels,
    )


def write_views(
    folder: Path, views: Sequence[RecordedView], intrinsics: CameraIntrinsics, serial: str = ""
) -> None:
    """Writes pictures and index; called again with one view more, it writes what is new.

    Raises:
        CheckpointError: The folder cannot be written.
    """
    for view in views:
        path = folder / view.name
        if not path.exists():
            _, png = cv2.imencode(".png", cv2.cvtColor(view.color, cv2.COLOR_RGB2BGR))
            write_atomically(path, png.tobytes())
    index = {
        "serial": serial,
        "arm_model": views[0].model.name if views else IIWA14.name,
        "intrinsics": asdict(intrinsics),
        "views": [
            {"image": v.name, "joint_positions": v.joint_positions.tolist(), "taken": v.taken} for v in views
        ],
    }
    write_atomically(folder / INDEX_NAME, json.dumps(index, indent=1).encode())


def read_views(folder: Path) -> tuple[list[RecordedView], CameraIntrinsics, str]:
    """Views, intrinsics and the camera's serial number.

    Raises:
        CalibrationError: A file is missing or broken; the message names it and its key.
    """
    path = folder / INDEX_NAME
    try:
        if path.stat().st_size > LARGEST_INDEX_BYTES:
            raise CalibrationError(f"{path} is larger than {LARGEST_INDEX_BYTES} bytes")
        index = read_json(path)
    except FileNotFoundError as error:
        raise CalibrationError(
            f"no {INDEX_NAME} in {folder}; it holds intrinsics and, for each picture, image and joint_positions"
        ) from error
    except (OSError, ValueError) as error:
        raise CalibrationError(f"{path} cannot be read: {error}") from error
    if not isinstance(index, dict) or not isinstance(index.get("views"), list):
        raise CalibrationError(f"{path} must hold a table with a list `views`")
    try:
        intrinsics = CameraIntrinsics(**index["intrinsics"])
    except (KeyError, TypeError, InvalidInputError) as error:
        raise CalibrationError(
            f"{path}: intrinsics must have width, height, fx, fy, cx, cy ({error})"
        ) from error
    try:
        model = arm_model(str(index.get("arm_model", IIWA14.name)))
    except ProfileError as error:
        raise CalibrationError(f"{path}: arm_model: {error}") from error
    views = [_read_view(folder, entry, k, intrinsics, model) for k, entry in enumerate(index["views"])]
    return views, intrinsics, str(index.get("serial", ""))


def _read_view(
    folder: Path, entry: Any, k: int, intrinsics: CameraIntrinsics, model: ArmModel
) -> RecordedView:
    where = f"{folder / INDEX_NAME}: views[{k}]"
    if not isinstance(entry, dict) or not isinstance(entry.get("image"), str):
        raise CalibrationError(f"{where} must have a string `image` and `joint_positions`")
    try:
        joints = np.array(entry["joint_positions"], dtype=np.float64)
    except (KeyError, TypeError, ValueError) as error:
        raise CalibrationError(f"{where}.joint_positions must be {NUM_JOINTS} numbers") from error
    low, high = model.joint_lower - 0.02, model.joint_upper + 0.02
    if joints.shape != (NUM_JOINTS,) or not np.all((joints >= low) & (joints <= high)):
        raise CalibrationError(
            f"{where}.joint_positions must be {NUM_JOINTS} angles within the joint limits, in radians; got "
            f"{entry['joint_positions']}"
        )
    taken = _utc(entry.get("taken", ""), where)
    name = entry["image"]
    if Path(name).name != name:
        raise CalibrationError(f"{where}.image must be a file of this folder, got {name!r}")
    try:
        picture = read_picture(folder / name)
    except InvalidInputError as error:
        raise CalibrationError(f"{where}.image: {error}") from error
    if picture.shape[:2] != (intrinsics.height, intrinsics.width):
        raise CalibrationError(
            f"{where}.image is {picture.shape[1]} x {picture.shape[0]} px, the intrinsics are of "
            f"{intrinsics.width} x {intrinsics.height}"
        )
    return RecordedView(name=name, color=picture, joint_positions=joints, taken=taken, model=model)


def _utc(text: Any, where: str) -> str:
    if text == "":
        return ""
    try:
        date = datetime.fromisoformat(text)
        if date.tzinfo is None:
            raise ValueError("it has no time zone")
        return date.astimezone(UTC).isoformat(timespec="seconds")
    except (TypeError, ValueError, OverflowError) as error:
        raise CalibrationError(
            f"{where}.taken must be a date such as 2026-11-29T12:00:00+00:00, got {text!r} ({error})"
        ) from error
