"""Drivers and arm models by name: ours, loaded when they are asked for, and those of other packages.

A driver is a callable `(options, context)` that makes an `Arm` or a `Camera` without touching any device;
`options` is its table of the profile, and `parse_table` checks it. Another package adds one by an entry point, and the
model of its arm by another, by which the twin and recordings find it:

    [project.entry-points."maniskill_tomato.drivers"]
    "arm.iiwa7" = "my_package.iiwa7:make_arm"
    "model.iiwa7" = "my_package.iiwa7:MODEL"
    "camera.zed" = "my_package.zed:make_camera"
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final, Literal, TypeVar

from maniskill_tomato.deploy.arm_shapes import check_arm_shapes
from maniskill_tomato.deploy.clock import Clock
from maniskill_tomato.deploy.deploy_errors import ProfileError
from maniskill_tomato.deploy.interface import Arm, Camera, declared_model
from maniskill_tomato.errors import InvalidInputError, did_you_mean
from maniskill_tomato.extension_points import ExtensionPoint
from maniskill_tomato.robot.arm_model import ArmModel

Kind = Literal["arm", "camera", "model"]
T = TypeVar("T")

ENTRY_POINT_GROUP: Final = "maniskill_tomato.drivers"

DRIVERS: Final[dict[Kind, ExtensionPoint]] = {
    "arm": ExtensionPoint(
        "driver of an arm",
        ENTRY_POINT_GROUP,
        {
            "libiiwa": "maniskill_tomato.deploy.libiiwa.libiiwa_arm:make_arm",
            "mock": "maniskill_tomato.deploy.mock.mock_arm:make_arm",
            "sunrise": "maniskill_tomato.deploy.sunrise.sunrise_arm:make_arm",
        },
        prefix="arm.",
    ),
    "camera": ExtensionPoint(
        "driver of a camera",
        ENTRY_POINT_GROUP,
        {
            "mock": "maniskill_tomato.deploy.mock.mock_camera:make_camera",
            "realsense": "maniskill_tomato.deploy.realsense.realsense_camera:make_camera",
        },
        prefix="camera.",
    ),
    "model": ExtensionPoint(
        "model of an arm",
        ENTRY_POINT_GROUP,
        {"iiwa14": "maniskill_tomato.robot.iiwa14:IIWA14"},
        prefix="model.",
    ),
}
"""Drivers, and models of arms, by name."""


@dataclass(frozen=True, kw_only=True)
class DriverContext:
    """What the drivers of one run share."""

    clock: Clock
    """Where their time stamps come from."""
    seed: int = 0
    """Of what simulated devices draw."""
    _shared: dict[str, Any] = field(default_factory=dict)

    def shared(self, key: str, make: Callable[[], T]) -> T:
        """One object for several drivers of the run, made when the first asks: the twin's arm and camera share one."""
        if key not in self._shared:
            self._shared[key] = make()
        found: T = self._shared[key]
        return found


def driver_names(kind: Kind) -> tuple[str, ...]:
    """All names that a profile may give, ours first."""
    return DRIVERS[kind].names()


def make_arm(name: str, options: Mapping[str, Any], context: DriverContext) -> Arm:
    """An arm's driver, not connected.

    Raises:
        ProfileError: There is no such driver, it cannot be loaded, an option is wrong, or it declares no model of its
            arm, or one that cannot be served.
    """
    arm = _made("arm", Arm, name, options, context)  # type: ignore[type-abstract]
    try:
        check_arm_shapes(declared_model(arm))
    except InvalidInputError as error:
        raise ProfileError(f"the driver arm.{name} cannot be used: {error}") from error
    return arm


def make_camera(name: str, options: Mapping[str, Any], context: DriverContext) -> Camera:
    """A camera's driver, not connected.

    Raises:
        ProfileError: As for `make_arm`.
    """
    return _made("camera", Camera, name, options, context)  # type: ignore[type-abstract]


def arm_model(name: str) -> ArmModel:
    """A registered model of an arm.

    Raises:
        ProfileError: There is none of this name, or it cannot be loaded.
    """
    model = _load("model", name)
    if not isinstance(model, ArmModel) or model.name != name:
        found = f"the model {model.name!r}" if isinstance(model, ArmModel) else f"a {type(model).__name__}"
        raise ProfileError(
            f"the entry point model.{name} must name an ArmModel called {name!r}, it names {found}"
        )
    return model


def _made(kind: Kind, device: type[T], name: str, options: Mapping[str, Any], context: DriverContext) -> T:
    try:
        made = _load(kind, name)(options, context)
    except InvalidInputError as error:
        raise ProfileError(f"the driver {kind}.{name} cannot be used: {error}") from error
    if not isinstance(made, device):
        raise ProfileError(
            f"the driver {kind}.{name} made {type(made).__name__}, which is no {device.__name__}"
        )
    return made


def _load(kind: Kind, name: str) -> Any:
    what = f"the entry point {kind}.{name}" if kind == "model" else f"the driver {kind}.{name}"
    if not DRIVERS[kind].has(name):
        names = ", ".join(driver_names(kind))
        if kind == "model":
            raise ProfileError(f"no package registers a model of the arm {name!r}; there are {names}")
        raise ProfileError(
            f"{kind}.driver must be one of {names}; got {name!r}{did_you_mean(name, driver_names(kind))}"
        )
    try:
        DRIVERS[kind].check_recorded(name, "the profile or recording", "")
        return DRIVERS[kind].load(name)
    except InvalidInputError as error:
        raise ProfileError(f"{what} cannot be used: {error}") from error
