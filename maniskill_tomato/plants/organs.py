"""A plant as the rest of the package sees it: organs made of triangles, and the fruits among them.

Plant frame: origin where the stem leaves the ground, z up, metres, right-handed. The row runs along y; a
robot stands at -x.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cached_property
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]
Int32 = NDArray[np.int32]
UInt8 = NDArray[np.uint8]
Ripeness = Literal["ripe", "turning", "green"]


class SemanticClass(IntEnum):
    """What a pixel shows; the values are stable and used in datasets."""

    BACKGROUND = 0
    STEM = 1
    """Main stem, peduncles, pedicels and calyces."""
    LEAF = 2
    """Leaflets with their petiole and rachis."""
    FRUIT_RIPE = 3
    FRUIT_TURNING = 4
    FRUIT_GREEN = 5
    ROBOT = 6
    OBJECT = 7
    """Things that are neither plant nor robot."""


class Role(IntEnum):
    """What a pixel shows, as far as a search for one fruit is concerned; the same numbers for every plant."""

    BACKGROUND = 0
    """Neither plant nor robot."""
    ROBOT = 1
    STEM = 2
    LEAF = 3
    OTHER_FRUIT = 4
    """A fruit that is not the target."""
    TARGET = 5
    """The target fruit."""
    OBJECT = 6
    """A thing between the plants, such as a string or a board."""


ROLE_OF_CLASS: Final[Mapping[SemanticClass, Role]] = {
    SemanticClass.BACKGROUND: Role.BACKGROUND,
    SemanticClass.STEM: Role.STEM,
    SemanticClass.LEAF: Role.LEAF,
    SemanticClass.FRUIT_RIPE: Role.OTHER_FRUIT,
    SemanticClass.FRUIT_TURNING: Role.OTHER_FRUIT,
    SemanticClass.FRUIT_GREEN: Role.OTHER_FRUIT,
    SemanticClass.ROBOT: Role.ROBOT,
    SemanticClass.OBJECT: Role.OBJECT,
}
"""The role of every class, of a fruit as one that is not the target."""


@dataclass(frozen=True, eq=False)
class MeshPart:
    """Triangles of one material."""

    vertices: Float32
    """Positions in the plant frame, in [m]. Shape (V, 3)."""
    normals: Float32
    """Unit vertex normals. Shape (V, 3)."""
    uvs: Float32
    """Texture coordinates in [0, 1]. Shape (V, 2)."""
    faces: Int32
    """Vertex indices, counter-clockwise from outside. Shape (F, 3)."""
    material: str
    """Name of the material, a key of `materials.MATERIALS`."""
    two_sided: bool = False
    """Whether a renderer, which draws only what faces the camera, must draw both sides; rays meet both anyway."""
    texture: UInt8 | None = None
    """Base colours of its mesh file, sRGB with alpha, in place of those of the material. Shape (rows, columns, 4)."""


@dataclass(frozen=True, eq=False)
class Organ:
    """One instance for segmentation: a fruit, a leaf, a truss without its fruits, the stem."""

    name: str
    """Unique in the plant, e.g. `leaf_07` or `fruit_03`."""
    semantic_class: SemanticClass
    parts: tuple[MeshPart, ...]

    @cached_property
    def vertices(self) -> Float32:
        """All positions in the plant frame, in [m]. Shape (V, 3)."""
        return np.concatenate([part.vertices for part in self.parts])

    @cached_property
    def faces(self) -> Int32:
        """All triangles, indices into `vertices`. Shape (F, 3)."""
        return joined_faces(self.parts)


def joined_faces(meshes: Sequence[MeshPart | Organ]) -> Int32:
    """The triangles of meshes whose vertices are put one after another. Shape (F, 3)."""
    offsets = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    return np.concatenate([m.faces + k for m, k in zip(meshes, offsets, strict=True)]).astype(np.int32)


@dataclass(frozen=True, eq=False)
class Fruit:
    """Where a fruit hangs."""

    organ_index: int
    """Index of its organ in `Plant.organs`."""
    centre: Float32
    """Centre of the fruit in the plant frame, in [m]. Shape (3,)."""
    radius: float
    """Radius of the smallest sphere around `centre` that holds every vertex, in [m]."""
    ripeness: Ripeness


@dataclass(frozen=True, eq=False)
class Plant:
    """A plant, generated or read from a mesh file."""

    preset: str
    """Name of the preset, or of the mesh file without its ending."""
    seed: int
    detail: Literal["training", "picture"]
    organs: tuple[Organ, ...]
    fruits: tuple[Fruit, ...]

    @cached_property
    def vertices(self) -> Float32:
        """All positions in the plant frame, in [m]. Shape (V, 3)."""
        return np.concatenate([organ.vertices for organ in self.organs])

    @cached_property
    def faces(self) -> Int32:
        """All triangles, indices into `vertices`. Shape (F, 3)."""
        return joined_faces(self.organs)

    @cached_property
    def organ_of_face(self) -> Int32:
        """Index into `organs` for every triangle. Shape (F,)."""
        return np.repeat(np.arange(len(self.organs)), [len(o.faces) for o in self.organs]).astype(np.int32)


def placed(plant: Plant, rotation: Float32, place: Float32) -> Plant:
    """The plant turned about its origin and then moved.

    Args:
        plant: The plant.
        rotation: Shape (3, 3).
        place: In [m]. Shape (3,).
    """

    def part(p: MeshPart) -> MeshPart:
        return replace(p, vertices=p.vertices @ rotation.T + place, normals=p.normals @ rotation.T)

    return replace(
        plant,
        organs=tuple(replace(o, parts=tuple(part(p) for p in o.parts)) for o in plant.organs),
        fruits=tuple(replace(f, centre=rotation @ f.centre + place) for f in plant.fruits),
    )


def with_fruit_at(plant: Plant, fruit: int, centre: Float32) -> Plant:
    """The plant with one fruit elsewhere; its stalk stays where it was.

    Args:
        plant: The plant.
        fruit: Index in `Plant.fruits`.
        centre: Where its centre goes, in the plant frame, in [m]. Shape (3,).
    """
    moved = plant.fruits[fruit]
    way = np.asarray(centre, dtype=np.float32) - moved.centre
    organs, fruits = list(plant.organs), list(plant.fruits)
    organ = organs[moved.organ_index]
    parts = tuple(replace(part, vertices=part.vertices + way) for part in organ.parts)
    organs[moved.organ_index] = replace(organ, parts=parts)
    fruits[fruit] = replace(moved, centre=moved.centre + way)
    return replace(plant, organs=tuple(organs), fruits=tuple(fruits))
