"""What a calibration must be before a real arm moves by it: whose, how good, how old, and a place that can be.

`docs/hardware.md` has the table.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Final

import numpy as np

from maniskill_tomato.deploy.calibration.calibration_file import Calibration
from maniskill_tomato.deploy.interface import Float64
from maniskill_tomato.deploy.rigid import difference
from maniskill_tomato.robot.d435 import CameraIntrinsics

AGAIN: Final = "calibrate again with `maniskill-tomato deploy calibrate`"


@dataclass(frozen=True)
class Ceiling:
    """The most that an error of a calibration may be."""

    key: str
    """Its name in the file."""
    most: float
    """In the unit of the file."""
    scale: float
    """From there to `unit`."""
    unit: str
    """For people."""
    reason: str
    """Why not more."""


CEILINGS: Final = (
    Ceiling("rms_px", 1.0, 1.0, "px", "an arm that is 0.7 mm and 0.05 deg off gives 0.9 px"),
    Ceiling(
        "board_position_rms",
        0.003,
        1e3,
        "mm",
        "the same arm gives up to 1.9 mm; the spheres around the arm are 6 mm larger than its links at least",
    ),
    Ceiling(
        "board_turn_rms", math.radians(1.5), math.degrees(1.0), "deg", "the same arm gives up to 1.1 deg"
    ),
    Ceiling("position_std", 0.001, 1e3, "mm", "more comes from views that are too much alike"),
    Ceiling("rotation_std", math.radians(0.5), math.degrees(1.0), "deg", "the same"),
)
"""Of the residuals."""

LEAST_VIEWS: Final = 10
"""Of fewer the residuals are small whatever the camera's place: with 5 views of an arm that is 0.3 mm and 0.02 degrees
off they were 0.31 px in the median, and the place up to 5.3 mm off; with 10 it was up to 1.6 mm."""

OLD_DAYS: Final = 30
"""After so many days a start warns."""

OLDEST_DAYS: Final = 180
"""After so many days a start is refused: a season's knocks, warmth and screws are in the bracket."""

CLOCK_SLACK: Final = timedelta(minutes=5)
"""The clocks of two computers may differ by this much; a calibration from farther in the future is refused."""

FARTHEST_FROM_DRAWING: Final = 0.040
"""In [m]: less than half of the housing's long side (45 mm), beyond which it is on another bracket."""

LARGEST_TURN_FROM_DRAWING: Final = math.radians(15.0)
"""In [rad]: a camera that is tilted by more is seen with the eye."""

LARGEST_SHIFT_PX: Final = 1.0
"""So far may other intrinsics move a corner of the picture, in [px]: as much as the residuals may be."""


def residual_problems(errors: Mapping[str, float | None]) -> Iterator[str]:
    """Which residuals are beyond their ceilings.

    Args:
        errors: By the keys of `CEILINGS`; those that are missing are not judged.

    Yields:
        A sentence each, with value, limit and reason.
    """
    for ceiling in CEILINGS:
        if ceiling.key not in errors:
            continue
        value = errors[ceiling.key]
        most = f"{ceiling.scale * ceiling.most:g} {ceiling.unit}"
        if value is None:
            yield f"it does not say {ceiling.key}, which may be {most} at most; {AGAIN}"
        elif not 0.0 <= value <= ceiling.most:
            yield (
                f"{ceiling.key} is {ceiling.scale * value:.3g} {ceiling.unit}, {most} at most is allowed "
                f"({ceiling.reason}); {AGAIN}"
            )


def file_problems(
    pose: Float64,
    calibration: Calibration,
    drawing: Float64,
    arm_model: str,
    now: datetime | None = None,
) -> Iterator[str]:
    """What speaks against moving a real arm by a calibration, as far as its file tells.

    Args:
        pose: The camera's optical frame in `link_ee`, as calibrated. Shape (4, 4).
        calibration: What the file says beside.
        drawing: The same frame by the mount's drawing. Shape (4, 4).
        arm_model: Name of the arm's model.
        now: The date; None for the computer's.

    Yields:
        A sentence each, with value, limit and what to do.
    """
    yield from pose_problems(pose, drawing)
    if calibration.arm_model != arm_model:
        yield (
            f"it is of an arm {calibration.arm_model or 'without a name'}, this one is {arm_model} and has other "
            f"kinematics; {AGAIN}"
        )
    yield from residual_problems({c.key: getattr(calibration, c.key) for c in CEILINGS})
    views = calibration.view_count
    if views is None or views < LEAST_VIEWS:
        told = "no number of views" if views is None else f"{views} views"
        yield (
            f"it tells of {told}, {LEAST_VIEWS} are needed (of fewer the residuals say little); take more with "
            "`maniskill-tomato deploy calibrate --count 15`"
        )
    yield from _date_problems(calibration.taken, now or datetime.now(UTC))


def pose_problems(pose: Float64, drawing: Float64) -> Iterator[str]:
    """What is impossible about a camera's place on its mount; arguments as of `file_problems`."""
    if np.allclose(pose, np.eye(4), atol=1e-6):
        yield f"T_flange_camera is the identity, in which no camera can sit; {AGAIN}"
        return
    distance, turn = difference(drawing, pose)
    what = (
        "look at the bracket and the board's measures; for another bracket give its drawing as "
        "calibration.T_flange_camera in the profile, then calibrate again"
    )
    if not distance <= FARTHEST_FROM_DRAWING:
        yield (
            f"it puts the camera {1e3 * distance:.0f} mm from where the mount's drawing has it, "
            f"{1e3 * FARTHEST_FROM_DRAWING:.0f} mm at most are allowed (farther off is another bracket); {what}"
        )
    if not turn <= LARGEST_TURN_FROM_DRAWING:
        yield (
            f"it turns the camera by {math.degrees(turn):.0f} deg from the mount's drawing, "
            f"{math.degrees(LARGEST_TURN_FROM_DRAWING):.0f} deg at most are allowed (more is seen with the eye); {what}"
        )


def camera_problems(calibration: Calibration, serial: str, intrinsics: CameraIntrinsics) -> Iterator[str]:
    """What speaks against a calibration for a camera, or for pictures.

    Args:
        calibration: What its file says.
        serial: The camera's number.
        intrinsics: Of its colour pictures.

    Yields:
        A sentence each, with value, limit and what to do.
    """
    if not calibration.serial:
        yield f"it does not say of which camera it is; the connected one is {serial or 'without a number'}; {AGAIN}"
    elif calibration.serial != serial:
        yield (
            f"it is of camera {calibration.serial}, the connected one is {serial or 'without a number'}; connect that "
            f"camera, or {AGAIN}"
        )
    used = calibration.intrinsics
    if used is None:
        yield f"it does not say the intrinsics of its pictures; {AGAIN}"
        return
    if (used.width, used.height) != (intrinsics.width, intrinsics.height):
        yield (
            f"its pictures are {used.width} x {used.height} px, those of the camera {intrinsics.width} x "
            f"{intrinsics.height}; set camera.color_size to that, or {AGAIN}"
        )
        return
    corners = np.array([[0, 0], [used.width, 0], [0, used.height], [used.width, used.height]], np.float64)
    shift = float(np.linalg.norm(intrinsics.project(used.ray_directions(corners)) - corners, axis=1).max())
    if not shift <= LARGEST_SHIFT_PX:
        yield (
            f"its intrinsics and the camera's differ by {shift:.1f} px at a corner of the picture, "
            f"{LARGEST_SHIFT_PX:g} px at most are allowed (as much as its residuals may be); {AGAIN}"
        )


def age_warning(calibration: Calibration, now: datetime | None = None) -> str | None:
    """A sentence on a calibration that is old but may still be used, or None."""
    taken = _date(calibration.taken)
    if taken is None:
        return None
    days = ((now or datetime.now(UTC)) - taken).days
    if not OLD_DAYS < days <= OLDEST_DAYS:
        return None
    return (
        f"the calibration is {days} days old; after {OLDEST_DAYS} it is refused; measure it with "
        "`maniskill-tomato deploy calibrate --evaluate`, and after every knock against the camera"
    )


def _date_problems(taken: str | None, now: datetime) -> Iterator[str]:
    date = _date(taken)
    if date is None:
        yield (
            f"it has no date with a time zone when its views were taken, got {taken!r}; {AGAIN}, or give every view of "
            "its views.json `taken`"
        )
    elif date - now > CLOCK_SLACK:
        yield (
            f"its views were taken at {taken}, which is in the future (it is {now.isoformat(timespec='seconds')}); set "
            f"the clock of this computer, or {AGAIN}"
        )
    elif (now - date).days > OLDEST_DAYS:
        yield (
            f"its views are {(now - date).days} days old, {OLDEST_DAYS} at most are allowed (brackets give way in "
            f"time); {AGAIN}"
        )


def _date(text: str | None) -> datetime | None:
    try:
        date = None if text is None else datetime.fromisoformat(text)
        return None if date is None or date.tzinfo is None else date.astimezone(UTC)
    except (ValueError, OverflowError):
        return None
