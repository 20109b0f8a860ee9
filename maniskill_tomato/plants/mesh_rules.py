"""How a mesh file becomes a plant: which object is what, how ripe a fruit is, and unit, axes and place of the file."""

import math
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Final, Literal, get_args

import numpy as np

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.plants.meshing import Float64
from maniskill_tomato.plants.organs import Ripeness

FEWEST_TRIANGLES: Final = 500
"""The smallest budget for a plant."""

OrganKind = Literal["leaf", "stem", "fruit", "ignore"]
Unit = Literal["m", "cm", "mm", "in"]
Axis = Literal["x", "y", "z", "-x", "-y", "-z"]

METRES: Final[dict[Unit, float]] = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}

Y_UP_SUFFIXES: Final = (".glb", ".gltf")
"""Files of formats whose standard says that y is up; in the others z is, unless the rules say otherwise."""

_AXES: Final[dict[Axis, list[list[float]]]] = {
    "z": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "-z": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
    "y": [[1, 0, 0], [0, 0, -1], [0, 1, 0]],  # As Blender reads glTF.
    "-y": [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
    "x": [[0, 0, -1], [0, 1, 0], [1, 0, 0]],
    "-x": [[0, 0, 1], [0, 1, 0], [-1, 0, 0]],
}
"""The shortest rotations that turn an axis up."""


@dataclass(frozen=True, kw_only=True)
class MeshRules:
    """What a user may say about mesh files. Patterns have `*` and `?`, and capitals do not count."""

    ignore: tuple[str, ...] = ()
    """Objects or materials that are left out."""
    leaf: tuple[str, ...] = ("*leaf*", "*leaves*", "*foliage*")
    """Objects or materials that are leaves."""
    stem: tuple[str, ...] = (
        "*stem*",
        "*stalk*",
        "*petiole*",
        "*peduncle*",
        "*pedicel*",
        "*branch*",
        "*truss*",
        "*calyx*",
        "*sepal*",
        "*flower*",
    )
    """Objects or materials that are stems, stalks, calyces or flowers."""
    fruit: tuple[str, ...] = ("*fruit*", "*tomato*", "*berry*")
    """Objects or materials that are fruits. The object's name is asked before its material's, and in either the
    order is ignore, leaf, stem, fruit: `tomato_leaf` is a leaf."""
    green: tuple[str, ...] = ("*green*", "*unripe*")
    """Fruits that are green, by their object or material."""
    turning: tuple[str, ...] = ("*turning*",)
    """Fruits that are turning; all others are ripe."""
    triangles: int | None = None
    """The most triangles that a plant keeps: a larger one is decimated, and its leaves keep their outlines; None keeps
    all."""
    fruits: Literal["objects", "pieces"] = "objects"
    """Whether each object is one fruit, or each connected piece of one."""
    units: Unit = "m"
    """Length that the file counts in."""
    up: Axis | None = None
    """The file's axis that points up; None for y in glTF and GLB, z in all others."""
    scale: float = 1.0
    """Further factor on all lengths."""
    yaw: float = 0.0
    """Turn about the vertical, counter-clockwise from above, in [rad]; at 0 the robot stands at the plant's -x."""
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Shift after all that, in [m]; the plant's origin is where its stem leaves the ground."""

    def __post_init__(self) -> None:
        for name in ("ignore", "leaf", "stem", "fruit", "green", "turning"):
            given: object = getattr(self, name)
            patterns = (given,) if isinstance(given, str) else given
            if not isinstance(patterns, list | tuple) or not all(isinstance(p, str) and p for p in patterns):
                raise InvalidInputError(
                    f"{name} must be a pattern such as '{name}_*' or a list of them; got {given!r}"
                )
            object.__setattr__(self, name, tuple(patterns))
        budget: object = self.triangles
        if budget is not None and not (type(budget) is int and budget >= FEWEST_TRIANGLES):
            raise InvalidInputError(
                f"triangles must be a whole number of {FEWEST_TRIANGLES} or more, or be left out to keep all; got "
                f"{budget!r}"
            )
        for name, choices in (("fruits", ("objects", "pieces")), ("units", get_args(Unit))):
            if getattr(self, name) not in choices:
                raise InvalidInputError.choice(name, getattr(self, name), choices)
        if self.up is not None and self.up not in get_args(Axis):
            raise InvalidInputError.choice("up", self.up, get_args(Axis))
        if not (_is_finite(self.scale) and 1e-6 <= self.scale <= 1e6):
            raise InvalidInputError(f"scale must be from 1e-06 to 1e+06; got {self.scale!r}")
        if not _is_finite(self.yaw):
            raise InvalidInputError(f"yaw must be a finite number, in [rad]; got {self.yaw!r}")
        if not (
            isinstance(self.offset, list | tuple)
            and len(self.offset) == 3
            and all(map(_is_finite, self.offset))
        ):
            raise InvalidInputError(f"offset must be three finite numbers (x, y, z [m]); got {self.offset!r}")
        object.__setattr__(self, "offset", tuple(float(v) for v in self.offset))

    def kind_of(self, name: str, material: str) -> OrganKind | None:
        """What an object is by its name, or else by its material's; None if nothing matches."""
        kinds: tuple[OrganKind, ...] = ("ignore", "leaf", "stem", "fruit")
        for word in filter(None, (name, material)):
            for kind in kinds:
                if _matches(word, getattr(self, kind)):
                    return kind
        return None

    def ripeness_of(self, name: str, material: str) -> Ripeness:
        """How ripe a fruit is by the names of object and material."""
        for word in filter(None, (name, material)):
            if _matches(word, self.green):
                return "green"
            if _matches(word, self.turning):
                return "turning"
        return "ripe"

    def T_plant_file(self, suffix: str) -> Float64:
        """From coordinates of a file with an ending such as `.obj` to the plant frame in [m]. Shape (4, 4)."""
        up = self.up or ("y" if suffix.lower() in Y_UP_SUFFIXES else "z")
        rows = np.array(_AXES[up])
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        T = np.eye(4)
        T[:3, :3] = turn @ rows * (self.scale * METRES[self.units])
        T[:3, 3] = self.offset
        return T


def _matches(word: str, patterns: tuple[str, ...]) -> bool:
    return any(fnmatchcase(word.lower(), pattern.lower()) for pattern in patterns)


def _is_finite(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
