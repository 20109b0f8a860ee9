"""Plants in the colours of their materials: meshes with a colour at every vertex, and one colour for every organ."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.plants.decimation import decimated
from maniskill_tomato.plants.materials import MATERIALS
from maniskill_tomato.plants.organs import MeshPart, Organ, Plant, SemanticClass, joined_faces
from maniskill_tomato.plants.row import Row

UInt8 = NDArray[np.uint8]
Float32 = NDArray[np.float32]
Int32 = NDArray[np.int32]

FRUITS = (SemanticClass.FRUIT_RIPE, SemanticClass.FRUIT_TURNING, SemanticClass.FRUIT_GREEN)


@dataclass(frozen=True, eq=False, kw_only=True)
class ColouredMesh:
    """Triangles with a colour at every vertex, seen from both sides."""

    vertices: Float32
    """In the plant frame, in [m]. Shape (V, 3)."""
    normals: Float32
    """Unit vertex normals. Shape (V, 3)."""
    colours: UInt8
    """sRGB. Shape (V, 3)."""
    faces: Int32
    """Vertex indices. Shape (F, 3)."""


def plant_organs(plant: Plant) -> dict[str, tuple[Organ, ...]]:
    """The organs in parts that a viewer shows or hides: `leaves`, `stems`, `fruits`, and `neighbours` of a row."""
    count = plant.middle_organs if isinstance(plant, Row) else len(plant.organs)
    own, others = plant.organs[:count], plant.organs[count:]
    parts = {
        "leaves": tuple(o for o in own if o.semantic_class is SemanticClass.LEAF),
        "fruits": tuple(o for o in own if o.semantic_class in FRUITS),
        "stems": tuple(o for o in own if o.semantic_class not in (SemanticClass.LEAF, *FRUITS)),
        "neighbours": tuple(others),
    }
    return {name: organs for name, organs in parts.items() if organs}


def organ_meshes(
    parts: Mapping[str, Sequence[Organ]], neighbour_share: float = 1.0
) -> dict[str, ColouredMesh]:
    """Each part as one mesh.

    Args:
        parts: As of `plant_organs`.
        neighbour_share: Share of the neighbours' triangles that is kept; fewer make smaller files.
    """
    meshes = {name: _joined(organs) for name, organs in parts.items()}
    if neighbour_share < 1.0 and "neighbours" in meshes:
        meshes["neighbours"] = _thinned(meshes["neighbours"], neighbour_share)
    return meshes


def plant_layers(plant: Plant, neighbour_share: float = 1.0) -> dict[str, ColouredMesh]:
    """The parts of a plant as meshes; see `plant_organs` and `organ_meshes`."""
    return organ_meshes(plant_organs(plant), neighbour_share)


def organ_colours(plant: Plant) -> NDArray[np.float64]:
    """The mean colour of every organ, sRGB from 0 to 255. Shape (organs, 3)."""
    return np.stack([np.concatenate([part_colours(p) for p in o.parts]).mean(0) for o in plant.organs])


def part_colours(part: MeshPart) -> UInt8:
    """The colours of its texture at the vertices, sRGB. Shape (V, 3)."""
    texture = MATERIALS[part.material].base_color if part.texture is None else part.texture
    rows, columns = texture.shape[:2]
    # Textures repeat.
    at = np.floor(part.uvs.astype(np.float64) * (columns, rows)).astype(np.int64) % (columns, rows)
    colours: UInt8 = texture[at[:, 1], at[:, 0], :3]
    return colours


def _joined(organs: Iterable[Organ]) -> ColouredMesh:
    parts: Sequence[MeshPart] = [part for organ in organs for part in organ.parts]
    return ColouredMesh(
        vertices=np.concatenate([p.vertices for p in parts]),
        normals=np.concatenate([p.normals for p in parts]),
        colours=np.concatenate([part_colours(p) for p in parts]),
        faces=joined_faces(parts),
    )


def _thinned(mesh: ColouredMesh, share: float) -> ColouredMesh:
    """The mesh with a share of its triangles."""
    budget = int(share * len(mesh.faces))
    moved, left, _ = decimated(mesh.vertices.astype(np.float64), mesh.faces.astype(np.int64), budget)
    used, faces = np.unique(left, return_inverse=True)
    return ColouredMesh(
        vertices=moved[used].astype(np.float32),
        normals=mesh.normals[used],
        colours=mesh.colours[used],
        faces=faces.reshape(-1, 3).astype(np.int32),
    )
