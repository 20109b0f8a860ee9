"""How good a calibration is on views that it was not made from."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from maniskill_tomato.deploy.calibration.board import CharucoBoard
from maniskill_tomato.deploy.calibration.calibration_file import Calibration, picture_id
from maniskill_tomato.deploy.calibration.calibration_limits import (
    CEILINGS,
    camera_problems,
    residual_problems,
)
from maniskill_tomato.deploy.calibration.hand_eye import Agreement, CalibrationError, agreement_about, rms
from maniskill_tomato.deploy.calibration.view_folder import RecordedView, board_view
from maniskill_tomato.deploy.interface import Float64
from maniskill_tomato.files import write_atomically
from maniskill_tomato.robot.d435 import CameraIntrinsics


@dataclass(frozen=True, eq=False, kw_only=True)
class Evaluation:
    """What new views say of a calibration."""

    agreement: Agreement
    """With the camera where the calibration has it."""

    @property
    def errors(self) -> dict[str, float]:
        """By the keys of `CEILINGS`, in their units."""
        found = self.agreement
        return {
            "rms_px": found.rms_px,
            "board_position_rms": found.board_position_rms,
            "board_turn_rms": found.board_turn_rms,
        }

    @property
    def problems(self) -> tuple[str, ...]:
        """What is beyond its ceiling, in words; empty if it passes."""
        return tuple(residual_problems(self.errors))


def evaluate(
    board: CharucoBoard,
    pose: Float64,
    calibration: Calibration,
    views: Sequence[RecordedView],
    intrinsics: CameraIntrinsics,
    serial: str,
) -> Evaluation:
    """Measures a calibration on views of a board that stood still. Only the board's place is fitted.

    Args:
        board: As measured on the print.
        pose: The camera's optical frame in `link_ee`, as calibrated. Shape (4, 4).
        calibration: What its file says beside.
        views: New ones, from different places.
        intrinsics: Of their pictures.
        serial: Of their camera.

    Raises:
        CalibrationError: They are of another camera or size, some were used for the calibration, or they are too few
            or too much alike to tell anything.
    """
    problems = list(camera_problems(calibration, serial, intrinsics))
    models = {view.model.name for view in views} - {calibration.arm_model}
    if models:
        problems.append(
            f"it is of an arm {calibration.arm_model or 'without a name'}, these are of {', '.join(models)}"
        )
    if problems:
        raise CalibrationError(f"the calibration does not go with these views: {'; '.join(problems)}")
    if not calibration.pictures:
        raise CalibrationError(
            "the calibration does not say from which pictures it was made, so that nobody knows which are new; "
            "calculate it again with `maniskill-tomato deploy calibrate --views FOLDER`"
        )
    known = set(calibration.pictures)
    used = [view.name for view in views if picture_id(view.color) in known]
    if used:
        raise CalibrationError(
            f"{len(used)} of {len(views)} views were used for this calibration ({', '.join(used[:5])}"
            f"{', ...' if len(used) > 5 else ''}) and say nothing new; take others"
        )
    seen = [board_view(board, view) for view in views]
    return Evaluation(agreement=agreement_about(board, seen, intrinsics, pose))


def write_evaluation(path: Path, file: Path, evaluation: Evaluation) -> None:
    """Writes the numbers as JSON.

    Args:
        path: Where to.
        file: The calibration.
        evaluation: What was found.

    Raises:
        CheckpointError: It cannot be written.
    """
    found = evaluation.agreement
    content = {
        "calibration": str(file),
        "evaluated": datetime.now(UTC).isoformat(timespec="seconds"),
        "passed": not evaluation.problems,
        "problems": evaluation.problems,
        "view_count": len(found.views),
        **evaluation.errors,
        "at_most": {c.key: c.most for c in CEILINGS if c.key in evaluation.errors},
        "left_out": found.left_out,
        "views": [
            {
                "name": view.name,
                "rms_px": rms(residuals),
                "board_offset": offset.tolist(),
                "board_turn": float(turn),
            }
            for view, residuals, offset, turn in zip(
                found.views, found.residuals_px, found.board_offsets, found.board_turns, strict=True
            )
        ],
        "about": "metres, radians, pixels; offsets in the base frame",
    }
    write_atomically(path, (json.dumps(content, indent=1) + "\n").encode())
