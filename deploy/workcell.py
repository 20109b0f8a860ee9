"""The devices of a profile, and what connects them to the policy."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from maniskill_tomato.deploy.calibration.calibration_limits import (
    age_warning,
    camera_problems,
    file_problems,
    pose_problems,
)
from maniskill_tomato.deploy.clock import CheckedClock, Clock, MonotonicClock, SimulatedClock
from maniskill_tomato.deploy.deploy_errors import ProfileError, RecordingError
from maniskill_tomato.deploy.drivers import DriverContext, make_arm, make_camera
from maniskill_tomato.deploy.guarded_arm import GuardedArm
from maniskill_tomato.deploy.interface import Arm, Camera, Float64
from maniskill_tomato.deploy.profile import Profile
from maniskill_tomato.deploy.profile_bounds import BOUNDS, check_bounds
from maniskill_tomato.deploy.robot_perception import Perception, open_perception
from maniskill_tomato.deploy.safety import Safety
from maniskill_tomato.deploy.stops import Stops
from maniskill_tomato.errors import InvalidInputError

_logger = logging.getLogger(__name__)

TWIN_START = 1_000.0
"""What the twin's clock shows at first, in [s]."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Workcell:
    """Devices, not connected yet, and what belongs to them."""

    profile: Profile
    clock: Clock
    arm: Arm
    camera: Camera
    guarded_arm: GuardedArm
    perception: Perception
    calibrates: bool = False
    """Whether the run is there to calibrate the camera."""

    def __post_init__(self) -> None:
        if self.camera.simulated and not self.arm.simulated:
            raise ProfileError(
                "a simulated camera, or a recording of one, cannot guide a real arm; use the mock driver for both, or "
                "take camera.recording out of the profile"
            )

    @property
    def simulated(self) -> bool:
        """Whether nothing real moves."""
        return self.arm.simulated

    def calibration_problems(self) -> list[str]:
        """What speaks against moving a real arm by the profile's calibration, a sentence each; more once the camera is
        connected. Nothing speaks against it where nothing real moves."""
        return [] if self.simulated else _problems(self.profile, self.arm, self.camera, self.calibrates)

    def check_calibration(self) -> None:
        """Accepts a calibration by which the arm may move.

        Raises:
            ProfileError: Something speaks against it; all of it is told.
        """
        problems = self.calibration_problems()
        if problems:
            raise ProfileError(in_words(problems))

    def target_position(self) -> Float64 | None:
        """Where the profile says that the target is, world frame, in [m]; None to look for it. Shape (3,).

        Raises:
            ProfileError: It names the twin's target, and there is no twin.
        """
        target = self.profile.target
        if target.source == "given":
            assert target.position is not None
            return np.array(target.position)
        if target.source == "twin":
            world = self.twin()
            if world is None:
                raise ProfileError("target.source = 'twin' goes with the camera driver mock only")
            position: Float64 = world.episode.target_position.double().numpy()
            return position
        return None

    def twin(self) -> Any:
        """The `TwinWorld` that a simulated camera looks at; None for a real one."""
        return getattr(self.camera, "_world", None)

    def listen(self, out: Path, keyboard: bool) -> Stops:
        """Makes an output folder and listens for everything that stops a run there, once it is entered.

        Args:
            out: The folder; the file that stopped an earlier run in it is taken away.
            keyboard: Whether keys in a terminal stop the run.

        Raises:
            RecordingError: The folder cannot be made or written to.
        """
        stop_file = out / self.profile.stop.file
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise RecordingError(
                f"cannot use the folder {out}: {error.strerror or error}; choose another --out"
            ) from error
        try:
            stop_file.unlink(missing_ok=True)
        except OSError as error:
            raise RecordingError(
                f"cannot take {stop_file} away, which stops every run: {error.strerror or error}; remove it, or choose "
                "another --out"
            ) from error
        return Stops(
            stop_file=stop_file,
            keyboard=keyboard,
            heartbeat_s=self.profile.stop.heartbeat,
            on_lost_heartbeat=self.guarded_arm.stop,
        )


NOT_CALIBRATED = (
    "the camera's place on the flange is not calibrated: run `maniskill-tomato deploy calibrate` and name its file in "
    "calibration.file; without it only a dry run is allowed"
)
"""Why a real arm with a camera does not move by a drawing."""

NOT_CONNECTED = (
    "the camera is not connected, and nobody knows whether it is the calibrated one; connect it first"
)
"""Why a real arm does not move without its camera."""


def _problems(profile: Profile, arm: Arm, camera: Camera, calibrates: bool) -> list[str]:
    if calibrates:
        return [*pose_problems(profile.T_flange_camera, profile.T_drawing)]
    if profile.calibration is None:
        return [NOT_CALIBRATED]
    problems = [
        *file_problems(profile.T_flange_camera, profile.calibration, profile.T_drawing, arm.model.name)
    ]
    if camera.is_connected:
        problems += camera_problems(profile.calibration, camera.serial, camera.intrinsics)
    return problems


def _check_bounds(profile: Profile) -> None:
    """Accepts a profile that a program made, as if it had been read from a file.

    Raises:
        ProfileError: A number is outside its bounds.
    """
    try:
        for table in BOUNDS:
            check_bounds(table, getattr(profile, table))
    except InvalidInputError as error:
        raise ProfileError(f"{profile.name}: {error}") from error


def in_words(problems: Sequence[str]) -> str:
    """What speaks against a calibration, as one message."""
    return (
        problems[0] if problems == [NOT_CALIBRATED] else f"the calibration is refused: {'; '.join(problems)}"
    )


def make_workcell(
    profile: Profile, seed: int = 0, clock: Clock | None = None, *, calibrates: bool = False
) -> Workcell:
    """Makes the devices of a profile without touching any.

    Args:
        profile: Which.
        seed: Of simulated devices: the twin's episode.
        clock: Another clock than the machine's, or than a simulated one where both devices are simulated.
        calibrates: Whether the run is there to calibrate the camera: it may move a real arm by the drawing. Every
            other one needs a calibration of the camera that is connected.

    Raises:
        ProfileError: A driver or an option is wrong, a number of a real arm's profile is outside its bounds, or a
            simulated camera would guide a real arm.
    """
    if clock is None:
        # A recording that plays by the simulated clock loses no picture to a busy machine.
        is_played = profile.camera_driver == "mock" or bool(profile.camera_options.get("recording"))
        is_simulated = profile.arm_driver == "mock" and is_played
        in_real_time = bool(profile.arm_options.get("real_time", False))
        clock = SimulatedClock(TWIN_START) if is_simulated and not in_real_time else MonotonicClock()
    checked = CheckedClock(clock)
    context = DriverContext(clock=checked, seed=seed)
    arm = make_arm(profile.arm_driver, profile.arm_options, context)
    camera = make_camera(profile.camera_driver, profile.camera_options, context)
    if not arm.simulated:
        _check_bounds(profile)
    for line in (*profile.relaxations(), *arm.relaxations()):
        _logger.warning("the profile relaxes %s", line)
    if not arm.simulated and profile.calibration is not None:
        warning = age_warning(profile.calibration)
        if warning is not None:
            _logger.warning("%s", warning)

    def why_forbidden() -> str | None:
        if arm.simulated:
            return None
        problems = _problems(profile, arm, camera, calibrates)
        if not problems and not camera.is_connected:
            return NOT_CONNECTED
        return in_words(problems) if problems else None

    safety = Safety(profile.safety, profile.T_flange_camera, arm.model)
    return Workcell(
        profile=profile,
        clock=checked,
        arm=arm,
        camera=camera,
        guarded_arm=GuardedArm(arm, safety, checked, why_forbidden),
        perception=open_perception(profile.perception.sight, profile.perception.segmenter),
        calibrates=calibrates,
    )
