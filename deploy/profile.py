"""Profiles: TOML files that name the devices, the camera's pose on the flange, the safety limits and the end of a run.

Errors name the key."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from maniskill_tomato.deploy.calibration.calibration_file import Calibration, read_calibration, rigid_pose
from maniskill_tomato.deploy.capture import CaptureConfig
from maniskill_tomato.deploy.deploy_errors import ProfileError
from maniskill_tomato.deploy.interface import Float64
from maniskill_tomato.deploy.profile_bounds import BOUNDS, check_bounds, relaxed, with_base_zone
from maniskill_tomato.deploy.profile_files import profile_names, profile_path
from maniskill_tomato.deploy.robot_perception import TRUE_MASKS, Sight
from maniskill_tomato.deploy.run_records import LoopConfig
from maniskill_tomato.deploy.safety_config import SafetyConfig
from maniskill_tomato.deploy.toml_tables import parse_table
from maniskill_tomato.errors import InvalidInputError, check_ranges
from maniskill_tomato.robot.d435 import T_flange_camera_color_optical
from maniskill_tomato.text_files import parse_toml

TABLES: Final = (
    "description",
    "arm",
    "camera",
    "twin",
    "calibration",
    "perception",
    "target",
    "safety",
    "loop",
    "capture",
    "stop",
)
"""What a profile may have."""


WRITTEN: Final = (".html", ".json", ".mcap", ".png")
"""Endings of the files that the commands write."""

FARTHEST_TARGET: Final = 1.6
"""An arm that reaches 0.82 m cannot look closely at what is farther from its base, in [m]."""


@dataclass(frozen=True, kw_only=True)
class PerceptionConfig:
    """What turns pictures into views."""

    segmenter: str = "light"
    """`ground_truth` (perfect masks, simulated cameras only), a segmenter's name (`maniskill-tomato list segmenters`),
    or its weights."""
    sight: Sight = "images"
    """`images`: masks and depth, as on a robot; `rays`: the twin's exact rays, as in the simulated task."""

    def __post_init__(self) -> None:
        if self.sight == "rays" and self.segmenter != TRUE_MASKS:
            raise InvalidInputError(
                f"sight = 'rays' goes with segmenter = '{TRUE_MASKS}' only, got {self.segmenter!r}"
            )


@dataclass(frozen=True, kw_only=True)
class TargetConfig:
    """Which fruit to look for."""

    source: Literal["seen", "given", "twin"] = "seen"
    """The largest sure ripe fruit that the first picture does not show fully, as with `target="any"` in the simulated
    task; `position`; or the fruit of the twin's episode."""
    position: tuple[float, float, float] | None = None
    """With `given`: its centre in the base frame, in [m]."""

    def __post_init__(self) -> None:
        if (self.source == "given") != (self.position is not None):
            raise InvalidInputError("position goes with source = 'given', and only with it")
        if self.position is not None and not np.linalg.norm(self.position) <= FARTHEST_TARGET:
            raise InvalidInputError(
                f"position must lie within {FARTHEST_TARGET} m of the base, where the arm can look at it; got "
                f"{self.position}, in metres"
            )


@dataclass(frozen=True, kw_only=True)
class StopConfig:
    """Ways to stop beside Ctrl-C and SIGTERM."""

    file: str = "STOP"
    """A run stops when this file appears in its output folder."""
    heartbeat: float = 60.0
    """The arm is stopped when the loop stands still for so long, in [s]."""

    def __post_init__(self) -> None:
        check_ranges(self, heartbeat=(1.0, 3600.0))
        if Path(self.file).name != self.file or self.file in ("", "..") or not self.file.isprintable():
            raise InvalidInputError(f"file must be a plain file name, got {self.file!r}")
        if Path(self.file).suffix.lower() in WRITTEN:
            raise InvalidInputError(
                f"file must not end in {', '.join(WRITTEN)}, as what a run writes does; got {self.file!r}"
            )


@dataclass(frozen=True, kw_only=True, eq=False)
class Profile:
    """A checked profile."""

    name: str
    """Its file's name without the ending."""
    text: str
    """Its content, for the recording."""
    description: str
    """One line."""
    arm_driver: str
    arm_options: dict[str, Any]
    """Options of the arm's driver."""
    camera_driver: str
    camera_options: dict[str, Any]
    """Options of the camera's driver."""
    T_flange_camera: Float64
    """The colour camera's optical frame in `link_ee`, as calibrated or else by the drawing. Shape (4, 4)."""
    T_drawing: Float64
    """The same by the mount's drawing. Shape (4, 4)."""
    calibration: Calibration | None = None
    """How `T_flange_camera` was measured; None if it is the drawing's."""
    perception: PerceptionConfig = field(default_factory=PerceptionConfig)
    target: TargetConfig = field(default_factory=TargetConfig)
    safety: SafetyConfig = field(default_factory=SafetyConfig)
    loop: LoopConfig = field(default_factory=LoopConfig)
    capture: CaptureConfig = field(default_factory=CaptureConfig)
    stop: StopConfig = field(default_factory=StopConfig)

    def relaxations(self) -> tuple[str, ...]:
        """What it relaxes against the defaults, in words; the arm's options aside."""
        return tuple(line for table in BOUNDS for line in relaxed(table, getattr(self, table)))


def load_profile(name_or_file: str) -> Profile:
    """Reads and checks a profile.

    Args:
        name_or_file: One of `profile_names`, or the path of a TOML file.

    Raises:
        ProfileError: There is none, or something in it is wrong.
    """
    path = profile_path(name_or_file)
    try:
        text = path.read_text(encoding="utf-8")
    except (FileNotFoundError, IsADirectoryError) as error:
        raise ProfileError(
            f"no profile {name_or_file!r}: give the path of a TOML file or one of {', '.join(profile_names())}"
        ) from error
    except (OSError, ValueError) as error:  # A name with a null byte, for one.
        raise ProfileError(f"the profile {name_or_file!r} cannot be read as text: {error}") from error
    return parse_profile(text, path)


def parse_profile(text: str, path: Path, T_flange_camera: Any = None) -> Profile:
    """The profile that a text describes.

    Args:
        text: As TOML.
        path: Names it in messages, and is where relative paths in it begin.
        T_flange_camera: What was read from the calibration file that it names, as nested lists; None to read that.

    Raises:
        ProfileError: Something in it is wrong.
    """
    try:
        data = parse_toml(text)
    except InvalidInputError as error:
        raise ProfileError(f"{path} is no TOML: {error}") from error
    for key in data:
        if key not in TABLES:
            raise ProfileError(f"{path}: {key} is unknown; a profile may have {', '.join(TABLES)}")
    where = path.name
    twin = _table(data, "twin", where)
    arm, camera = _table(data, "arm", where), _table(data, "camera", where)
    drivers = []
    for key, table in (("arm", arm), ("camera", camera)):
        driver = table.pop("driver", None)
        if not isinstance(driver, str):
            raise ProfileError(f"{where}: {key}.driver is missing; name a driver, such as mock")
        drivers.append(driver)
    calibration = _table(data, "calibration", where)
    if "file" in calibration and T_flange_camera is not None:
        calibration = {"T_flange_camera": T_flange_camera}
    drawing, mount, measured = _calibration(calibration, path)

    def read(key: str, kind: Any) -> Any:
        config = parse_table(kind, _table(data, key, where), f"{where}: {key}")
        try:
            if key in BOUNDS:
                check_bounds(key, config)
        except InvalidInputError as error:
            raise ProfileError(f"{where}: {error}") from error
        return config

    return Profile(
        name=path.stem,
        text=text,
        description=str(data.get("description", "")),
        arm_driver=drivers[0],
        arm_options=twin if drivers[0] == "mock" else arm,
        camera_driver=drivers[1],
        camera_options=twin if drivers[1] == "mock" else camera,
        T_flange_camera=mount,
        T_drawing=drawing,
        calibration=measured,
        perception=read("perception", PerceptionConfig),
        target=read("target", TargetConfig),
        safety=with_base_zone(read("safety", SafetyConfig)),
        loop=read("loop", LoopConfig),
        capture=read("capture", CaptureConfig),
        stop=read("stop", StopConfig),
    )


def _table(data: Mapping[str, Any], key: str, where: str) -> dict[str, Any]:
    table = data.get(key, {})
    if not isinstance(table, Mapping):
        raise ProfileError(f"{where}: {key} must be a table, got {table!r}")
    return dict(table)


def _calibration(table: Mapping[str, Any], path: Path) -> tuple[Float64, Float64, Calibration | None]:
    """T_flange_camera by the drawing, by the file if one is named, and what that says beside."""
    for key in table:
        if key not in ("T_flange_camera", "file"):
            raise ProfileError(
                f"{path.name}: calibration.{key} is unknown; allowed are T_flange_camera and file"
            )
    drawing = T_flange_camera_color_optical
    if "T_flange_camera" in table:
        drawing = rigid_pose(table["T_flange_camera"], f"{path.name}: calibration.T_flange_camera")
    if "file" not in table:
        return drawing, drawing, None
    try:
        mount, measured = read_calibration(path.parent / str(table["file"]))
    except ProfileError as error:
        raise ProfileError(f"{path.name}: calibration.file: {error}") from error
    return drawing, mount, measured
