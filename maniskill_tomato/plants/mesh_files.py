"""The named objects of a mesh file: GLB, glTF, OBJ and PLY by trimesh, and `.npz` with an array an object."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.array_files import read_arrays
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.plants.mesh_colours import Paint, paint_of
from maniskill_tomato.plants.meshing import Float64, Int64
from maniskill_tomato.plants.organs import UInt8

MESH_SUFFIXES: Final = (".glb", ".gltf", ".obj", ".ply", ".npz")
"""Endings of the files that can be a plant."""

PLY_LABELS: Final = ("object", "instance", "label", "class")
"""Whole numbers of a PLY's faces or vertices that tell its objects apart, the first one that there is."""

_OPAQUE: Final = 128
"""An alpha below this of 255 is a hole."""


@dataclass(frozen=True, eq=False)
class MeshObject:
    """One named object of a file, in the file's own frame and unit."""

    name: str
    material: str
    """Name of its material, or empty."""
    vertices: Float64
    """Shape (V, 3)."""
    faces: Int64
    """Vertex indices. Shape (F, 3)."""
    paint: Paint | None = None
    """Its colours; None if the file has none."""
    has_holes: bool = False
    """Whether the alpha channel of its texture makes parts of it invisible."""


def read_objects(path: Path) -> list[MeshObject]:
    """The objects of a file that have triangles, in the order of their names.

    Raises:
        InvalidInputError: There is no such file, it cannot be read, or an object's numbers are not finite.
    """
    if not path.is_file():
        raise InvalidInputError(f"there is no mesh file {path}")
    suffix = path.suffix.lower()
    if suffix not in MESH_SUFFIXES:
        raise InvalidInputError.choice(f"the ending of the mesh file {path.name}", path.suffix, MESH_SUFFIXES)
    try:
        objects = list(_read_npz(path) if suffix == ".npz" else _read_scene(path, suffix))
    except InvalidInputError:
        raise
    except Exception as error:  # What a broken file makes trimesh and NumPy raise has no common base.
        raise InvalidInputError(f"{path} cannot be read as {suffix[1:].upper()}: {error}") from error
    return _checked(str(path), objects)


def objects_of_arrays(source: str, arrays: Mapping[str, NDArray[Any]]) -> list[MeshObject]:
    """The objects of named triangles, as an `.npz` file holds them.

    Args:
        source: Where they come from, for messages.
        arrays: Triangles of each object by its name. Shapes (F, 3, 3).

    Raises:
        InvalidInputError: One has another shape or type, or numbers that are not finite, or there is no triangle.
    """
    return _checked(source, list(_objects_of(source, arrays)))


def _checked(source: str, objects: list[MeshObject]) -> list[MeshObject]:
    for found in objects:
        if found.faces.size and not 0 <= found.faces.min() <= found.faces.max() < len(found.vertices):
            raise InvalidInputError(
                f"{source}: object {found.name!r} has triangles between corners that are not there"
            )
        if not np.isfinite(found.vertices).all():
            raise InvalidInputError(
                f"{source}: object {found.name!r} has corners that are not finite numbers"
            )
    if not objects:
        raise InvalidInputError(f"{source} holds no triangles")
    # Not in the file's order, which its reader does not keep: the number of a fruit must always be the same.
    return sorted(objects, key=lambda found: (found.name, found.material))


def _read_npz(path: Path) -> Iterator[MeshObject]:
    return _objects_of(str(path), read_arrays(path))


def _objects_of(source: str, arrays: Mapping[str, NDArray[Any]]) -> Iterator[MeshObject]:
    for name, corners in arrays.items():
        if corners.ndim != 3 or corners.shape[1:] != (3, 3) or corners.dtype.kind not in "fiu":
            raise InvalidInputError(
                f"{source}: object {name!r} must be an array of triangles of shape (F, 3, 3), got "
                f"{corners.dtype} of shape {corners.shape}"
            )
        if len(corners):
            yield MeshObject(name, "", *joined_corners(corners.astype(np.float64)))


def joined_corners(corners: Float64) -> tuple[Float64, Int64]:
    """Vertices and faces of triangles of shape (F, 3, 3), with equal corners as one vertex.

    Args:
        corners: Shape (F, 3, 3).

    Returns:
        Shapes (V, 3) and (F, 3).
    """
    from trimesh.grouping import unique_rows

    points = corners.reshape(-1, 3)
    if not np.isfinite(points).all():
        return points, np.arange(len(points)).reshape(-1, 3)
    first, inverse = unique_rows(points, digits=7)
    return points[first], inverse.reshape(-1, 3).astype(np.int64)


def _read_scene(path: Path, suffix: str) -> Iterator[MeshObject]:
    import trimesh

    options: dict[str, Any] = {"split_objects": True} if suffix == ".obj" else {}
    scene = trimesh.load_scene(path, process=False, **options)
    parents = scene.graph.transforms.parents
    images: dict[object, UInt8] = {}
    for node in scene.graph.nodes_geometry:
        T_scene_node, geometry = scene.graph[node]
        mesh = scene.geometry[geometry]
        if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
            continue
        material = getattr(mesh.visual, "material", None)
        label = str(getattr(material, "name", None) or "")
        name = _object_name(str(node), str(parents.get(node, "")), label)
        T = np.asarray(T_scene_node)
        faces = np.asarray(mesh.faces, dtype=np.int64)
        if np.linalg.det(T[:3, :3]) < 0.0:
            faces = faces[:, ::-1]  # A mirrored node turns its triangles inside out.
        vertices = np.asarray(mesh.vertices, dtype=np.float64) @ T[:3, :3].T + T[:3, 3]
        paint = paint_of(mesh.visual, faces, images, linear=suffix in (".glb", ".gltf"))
        labels = _face_labels(path, mesh) if suffix == ".ply" else None
        for number, rows in [(None, np.arange(len(faces)))] if labels is None else _by_label(labels):
            named = path.stem if suffix == ".ply" else name
            if number is not None:
                named = number
            used, inverse = np.unique(faces[rows], return_inverse=True)
            # Exporters cut meshes along the seams of textures and normals: the same place is one vertex again.
            yield MeshObject(
                named,
                label,
                *joined_corners(vertices[used][inverse.reshape(-1, 3)]),
                paint=None if paint is None else Paint(paint.image, paint.uvs[rows]),
                has_holes=_has_holes(material),
            )


def _object_name(node: str, parent: str, material: str) -> str:
    """The name that a user gave: trimesh adds a code where a node has several materials, and an OBJ's material."""
    if parent and re.fullmatch(re.escape(parent) + r"_[0-9a-f]{6}", node):
        return parent
    return node.removesuffix(f"_{material}") if material else node


def _face_labels(path: Path, mesh: Any) -> tuple[str, NDArray[Any]] | None:
    """The property that tells a PLY's objects apart and its value for each face; None without one."""
    raw = mesh.metadata.get("_ply_raw", {})
    for element in ("face", "vertex"):
        data = raw.get(element, {}).get("data")
        names = getattr(getattr(data, "dtype", None), "names", None) or (
            data if isinstance(data, dict) else ()
        )
        for name in (n for n in PLY_LABELS if n in names):
            values = np.asarray(data[name]).reshape(-1)
            expected = len(mesh.faces) if element == "face" else len(mesh.vertices)
            if len(values) != expected:
                raise InvalidInputError(
                    f"{path}: the {element}s have {len(values)} values of {name!r} for {expected} triangles or "
                    "vertices; triangulate the mesh before it is written"
                )
            return name, values if element == "face" else values[mesh.faces[:, 0]]
    return None


def _by_label(labels: tuple[str, NDArray[Any]]) -> Iterator[tuple[str | None, Int64]]:
    """The name of each object and the numbers of its faces."""
    name, values = labels
    for value in np.unique(values):
        yield f"{name}_{value:g}", np.flatnonzero(values == value)


def _has_holes(material: Any) -> bool:
    """Whether a material's alpha channel cuts pieces out."""
    if getattr(material, "alphaMode", None) == "OPAQUE":
        return False
    if "map_d" in (getattr(material, "kwargs", None) or {}):
        return True  # A picture of its own, which trimesh does not read.
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    mode = getattr(image, "mode", "")
    if image is None or not (mode in ("RGBA", "LA") or "transparency" in getattr(image, "info", {})):
        return False
    # glTF's default is opaque, whatever the picture holds.
    if hasattr(material, "alphaMode") and material.alphaMode is None:
        return False
    alpha = np.asarray(image.convert("RGBA"))[..., 3]
    return bool((alpha < _OPAQUE).any())
