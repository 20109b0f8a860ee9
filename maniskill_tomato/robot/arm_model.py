"""What is known of an arm: its joints, limits, geometry, and spheres that cover it. Its driver declares it.

The kinematics serve arms that are spherical-rotational-spherical, as an iiwa is: with all joints at 0 the arm stands
straight up on the z axis of its base, joints 1, 3, 5 and 7 turn about that axis, and joints 2, 4 and 6 about lines
along y that meet it in the shoulder, the elbow and the wrist. Lengths, limits and the senses of the joints may be any.
What such an arm cannot be built from is refused, with the reason.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from maniskill_tomato.errors import InvalidInputError

Float64 = npt.NDArray[np.float64]

Sphere = tuple[float, float, float, float]
"""Centre x, y, z in the link's frame and radius, in [m]."""

NUM_JOINTS: Final = 7

CHAIN_SIGNS: Final = (1.0, 1.0, 1.0, -1.0, 1.0, 1.0, 1.0)
"""Senses of the joints about z, y, z, y, z, y, z that the kernels of the kinematics have; the iiwa's."""

CENTRE_TOLERANCE: Final = 1e-6
"""How far axes that meet may be apart, in [m]; directions likewise, as sines."""

LARGEST_ANGLE: Final = 2.0 * math.pi
"""No joint limit lies farther from 0, in [rad]: more is the wrong unit."""

LIMIT_RANGES: Final = {
    "velocity_limits": (0.01, 20.0),
    "acceleration_limits": (0.01, 1000.0),
    "torque_limits": (0.01, 10_000.0),
}
"""Of joints, in [rad/s], [rad/s^2] and [N m]: beyond them is the wrong unit, or a check that checks nothing."""

LARGEST_SPHERE: Final = 0.3
"""Radius, in [m]."""

COVERED_LINKS: Final = 4
"""The last so many links, which come near to the plant with the camera, need a sphere each."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ArmModel:
    """An arm that the kinematics can serve; making one checks that.

    `arm_urdf.read_arm_model` makes one from a URDF.
    """

    name: str
    """By which profiles and recordings name it."""
    urdf: Path
    """The URDF, whose collision shapes the arm is held clear by."""
    joint_names: tuple[str, ...]
    """Of the seven joints in the URDF, base to flange."""
    link_names: tuple[str, ...]
    """In the URDF: the base, what each joint turns, and the flange, which is fixed to the last of these."""
    joint_lower: Float64
    """In [rad]. Shape (7,)."""
    joint_upper: Float64
    """In [rad]. Shape (7,)."""
    velocity_limits: Float64
    """Largest joint speeds, in [rad/s]. Shape (7,)."""
    acceleration_limits: Float64
    """Largest joint accelerations, in [rad/s^2]. Shape (7,)."""
    torque_limits: Float64
    """Largest joint torques, in [N m]. Shape (7,)."""
    joint_origins: Float64
    """Origin of each joint's link in the link before it, both standing as the base does when all joints are 0, in [m].
    Shape (7, 3)."""
    joint_axes: Float64
    """Unit axis of each joint in the base frame when all joints are 0. Shape (7, 3)."""
    flange_height: float
    """From the last joint's origin along its axis to the flange, in [m]."""
    link_turns: Float64 | None = None
    """How the URDF's link frames stand in the base frame when all joints are 0, as rotations; None if all stand as the
    base does. Shape (9, 3, 3)."""
    spheres: Mapping[str, tuple[Sphere, ...]]
    """Spheres that cover the last links, flange and what holds the camera included, the camera itself not. By link."""
    ready_qpos: Float64
    """A posture in front of the plant from which the arm comes in to any view, in [rad]. Shape (7,)."""

    def __post_init__(self) -> None:
        for name in ("joint_lower", "joint_upper", "velocity_limits", "acceleration_limits", "torque_limits"):
            self._freeze(name, (NUM_JOINTS,))
        self._freeze("ready_qpos", (NUM_JOINTS,))
        self._freeze("joint_origins", (NUM_JOINTS, 3))
        self._freeze("joint_axes", (NUM_JOINTS, 3))
        if self.link_turns is not None:
            self._freeze("link_turns", (NUM_JOINTS + 2, 3, 3))
        for what in (
            *self._wrong_names(),
            *self._wrong_limits(),
            *self._wrong_geometry(),
            *self._wrong_spheres(),
        ):
            raise InvalidInputError(f"the arm model {self.name!r} cannot be served: {what}")

    # ------------------------------------------------------------------ geometry

    @property
    def flange_link(self) -> str:
        """The last of `link_names`, which carries the camera."""
        return self.link_names[-1]

    @cached_property
    def axis_signs(self) -> Float64:
        """Sense of each joint about z, y, z, y, z, y, z. Shape (7,)."""
        return np.asarray(np.sign(self.joint_axes.sum(axis=1)), dtype=np.float64)

    @cached_property
    def flips(self) -> Float64 | None:
        """Joint angles of the arm over those of a chain with `CHAIN_SIGNS`; None where all are 1. Shape (7,)."""
        flips = self.axis_signs * np.array(CHAIN_SIGNS)
        return None if (flips == 1.0).all() else flips

    @cached_property
    def symmetric_limits(self) -> Float64:
        """How far the inverse kinematics turn joints to either side: the nearer limit, in [rad]. Shape (7,)."""
        return np.minimum(np.minimum(-self.joint_lower, self.joint_upper), math.pi)

    @cached_property
    def base_to_shoulder(self) -> float:
        """In [m]; likewise below."""
        return self._height(0, 2)

    @cached_property
    def shoulder_to_elbow(self) -> float:
        return self._height(2, 4)

    @cached_property
    def elbow_to_wrist(self) -> float:
        return self._height(4, 6)

    @cached_property
    def wrist_to_flange(self) -> float:
        return round(self._height(6, 7) + self.flange_height, 9)

    def _height(self, first: int, end: int) -> float:
        return round(float(self.joint_origins[first:end, 2].sum()), 9)

    # ------------------------------------------------------------------ checks

    def _freeze(self, name: str, shape: tuple[int, ...]) -> None:
        try:
            array = np.array(getattr(self, name), dtype=np.float64)
        except (TypeError, ValueError):
            array = np.zeros(0)
        if array.shape != shape or not np.isfinite(array).all():
            raise InvalidInputError(
                f"the arm model {self.name!r} cannot be served: {name} must be finite numbers of shape {shape}, got "
                f"{getattr(self, name)!r}"
            )
        array.setflags(write=False)
        object.__setattr__(self, name, array)

    def _wrong_names(self) -> Iterator[str]:
        for what, names, count in (
            ("joints", self.joint_names, NUM_JOINTS),
            ("links", self.link_names, NUM_JOINTS + 2),
        ):
            if len(names) != count or len(set(names)) != count:
                yield f"it must have {count} {what}, each of another name; got {len(names)}: {', '.join(names)}"

    def _wrong_limits(self) -> Iterator[str]:
        for j, name in enumerate(self.joint_names):
            low, high = self.joint_lower[j], self.joint_upper[j]
            if not -LARGEST_ANGLE <= low < -0.1 or not 0.1 < high <= LARGEST_ANGLE:
                yield (
                    f"{name} has the limits {low:g} and {high:g} rad; the lower must lie from -6.28 to -0.1, the upper "
                    "from 0.1 to 6.28"
                )
            if abs(self.ready_qpos[j]) > self.symmetric_limits[j]:
                yield (
                    f"ready_qpos has {name} at {self.ready_qpos[j]:g} rad, but the kinematics turn it by at most "
                    f"{self.symmetric_limits[j]:g} rad to either side, the nearer of its limits"
                )
            for kind in LIMIT_RANGES:
                value = getattr(self, kind)[j]
                low, high = LIMIT_RANGES[kind]
                if not low <= value <= high:
                    yield f"{kind} of {name} must be from {low:g} to {high:g}, got {value:g}"

    def _wrong_geometry(self) -> Iterator[str]:
        origins = self.joint_origins.cumsum(axis=0)
        for j, name in enumerate(self.joint_names):
            x, y, _ = origins[j]
            along = self.joint_axes[j].copy()
            wanted, off = (2, math.hypot(x, y)) if j % 2 == 0 else (1, abs(x))
            along[wanted] = 0.0
            if (
                np.linalg.norm(along) > CENTRE_TOLERANCE
                or abs(np.linalg.norm(self.joint_axes[j]) - 1.0) > 1e-6
            ):
                yield (
                    f"{name} must turn about the {'xyz'[wanted]} axis of the base when all joints are 0, not about "
                    f"{self.joint_axes[j].round(6).tolist()}; {_SERVED}"
                )
            if off > CENTRE_TOLERANCE:
                yield f"the axis of {name} passes the z axis of the base at {off * 1e3:.3f} mm; {_SERVED}"
        for name in ("base_to_shoulder", "shoulder_to_elbow", "elbow_to_wrist", "wrist_to_flange"):
            if not 0.01 <= getattr(self, name) <= 2.0:
                yield f"{name} must be from 0.01 to 2 m, got {getattr(self, name):g}; {_SERVED}"
        if self.link_turns is not None and not np.allclose(self.link_turns[[0, -1]], np.eye(3), atol=1e-6):
            yield (
                f"{self.link_names[0]} and {self.flange_link} must stand as the base does when all joints are 0; add a "
                "fixed link that does"
            )

    def _wrong_spheres(self) -> Iterator[str]:
        if not isinstance(self.spheres, Mapping):
            yield f"spheres must name links, got {self.spheres!r}"
            return
        unknown = [link for link in self.spheres if link not in self.link_names]
        if unknown:
            yield f"spheres names links that it has not: {', '.join(unknown)}; it has {', '.join(self.link_names)}"
        bare = [link for link in self.link_names[-COVERED_LINKS:] if not self.spheres.get(link)]
        if bare:
            yield (
                f"no spheres cover {', '.join(bare)}; spheres must cover the last {COVERED_LINKS} links, or nothing "
                "would keep them off the plant"
            )
        for link, spheres in self.spheres.items():
            for sphere in spheres:
                if not _is_sphere(sphere):
                    yield (
                        f"spheres of {link} must be (x, y, z, radius) in metres, the radius above 0 and at most "
                        f"{LARGEST_SPHERE}, got {sphere!r}"
                    )


_SERVED: Final = (
    "only arms are served that are spherical-rotational-spherical and stand straight up when all joints are 0, as an "
    "iiwa does"
)


def _is_sphere(sphere: Any) -> bool:
    try:
        values = np.array(sphere, dtype=np.float64)
    except (TypeError, ValueError):
        return False
    return bool(values.shape == (4,) and np.isfinite(values).all() and 0.0 < values[3] <= LARGEST_SPHERE)
