"""Drivers by name: ours, loaded when they are asked for, and those of other packages.

A driver is a callable `(options, context)` that makes an `Arm` or a `Camera` without touching any device;
`options` is its table of the profile, and `parse_table` checks it. Another package adds one by an entry point:

    [project.entry-points."maniskill_tomato.drivers"]
    "arm.franka" = "my_package.franka:make_arm"
    "camera.zed" = "my_package.zed:make_camera"
"""

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from typing import Any, Final, Literal, TypeVar

from maniskill_tomato.deploy.clock import Clock
from maniskill_tomato.deploy.deploy_errors import ProfileError
from maniskill_tomato.deploy.interface import Arm, Camera

Kind = Literal["arm", "camera"]
T = TypeVar("T")

ENTRY_POINT_GROUP: Final = "maniskill_tomato.drivers"

BUILT_IN: Final[dict[Kind, dict[str, str]]] = {
    "arm": {
        "libiiwa": "maniskill_tomato.deploy.libiiwa.libiiwa_arm:make_arm",
        "mock": "maniskill_tomato.deploy.mock.mock_arm:make_arm",
        "sunrise": "maniskill_tomato.deploy.sunrise.sunrise_arm:make_arm",
    },
    "camera": {
        "mock": "maniskill_tomato.deploy.mock.mock_camera:make_camera",
        "realsense": "maniskill_tomato.deploy.realsense.realsense_camera:make_camera",
    },
}
"""Module and callable of each driver of this package."""


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
    prefix = f"{kind}."
    others = (e.name for e in entry_points(group=ENTRY_POINT_GROUP) if e.name.startswith(prefix))
    return (*BUILT_IN[kind], *sorted(name.removeprefix(prefix) for name in others))


def make_arm(name: str, options: Mapping[str, Any], context: DriverContext) -> Arm:
    """An arm's driver, not connected.

    Raises:
        ProfileError: There is no such driver, it cannot be loaded, or an option is wrong.
    """
    return _made("arm", Arm, name, options, context)  # type: ignore[type-abstract]


def make_camera(name: str, options: Mapping[str, Any], context: DriverContext) -> Camera:
    """A camera's driver, not connected.

    Raises:
        ProfileError: As for `make_arm`.
    """
    return _made("camera", Camera, name, options, context)  # type: ignore[type-abstract]


def _made(kind: Kind, device: type[T], name: str, options: Mapping[str, Any], context: DriverContext) -> T:
    made = _load(kind, name)(options, context)
    if not isinstance(made, device):
        raise ProfileError(
            f"the driver {kind}.{name} made {type(made).__name__}, which is no {device.__name__}"
        )
    return made


def _load(kind: Kind, name: str) -> Callable[[Mapping[str, Any], DriverContext], object]:
    make: Callable[[Mapping[str, Any], DriverContext], object]
    try:
        if name in BUILT_IN[kind]:
            module, _, attribute = BUILT_IN[kind][name].partition(":")
            make = getattr(importlib.import_module(module), attribute)
            return make
        for entry in entry_points(group=ENTRY_POINT_GROUP, name=f"{kind}.{name}"):
            make = entry.load()
            return make
    except (ImportError, AttributeError) as error:
        raise ProfileError(
            f"the driver {kind}.{name} cannot be loaded: {error}; is its package installed?"
        ) from error
    names = ", ".join(driver_names(kind))
    raise ProfileError(f"{kind}.driver must be one of {names}; got {name!r}")
