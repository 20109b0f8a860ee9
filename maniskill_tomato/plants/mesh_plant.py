"""A plant of somebody else's making: the objects of a mesh file as organs and fruits."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.plants.fruit import SKIN_VARIANTS
from maniskill_tomato.plants.generator import FRUIT_CLASS
from maniskill_tomato.plants.leaf import LEAF_VARIANTS
from maniskill_tomato.plants.mesh_files import MeshObject, objects_of_arrays, read_objects
from maniskill_tomato.plants.mesh_rules import METRES, MeshRules, OrganKind
from maniskill_tomato.plants.mesh_surface import (
    Surface,
    across_faces,
    is_below,
    is_open,
    joined,
    pieces_of,
    placed,
    split_at_seams,
    within_budget,
)
from maniskill_tomato.plants.meshing import Float64, Int64, normalized
from maniskill_tomato.plants.organs import Fruit, MeshPart, Organ, Plant, SemanticClass

FRUIT_RADII: Final = (0.004, 0.15)
"""Smallest and largest radius of a fruit, in [m]; another one says that the unit is wrong or fruits are not apart."""

PLANT_HEIGHTS: Final = (0.05, 6.0)
"""Lowest and highest plant, in [m]; likewise."""

FARTHEST_AXIS: Final = 1.0
"""How far the middle of a plant may be from its origin, along the ground, in [m]."""

TEXTURE_LENGTH: Final = 0.1
"""Length of a stem over which its texture repeats, in [m]."""


def plant_from_mesh(path: Path, rules: MeshRules, seed: int = 0) -> Plant:
    """Reads a plant from a mesh file.

    Leaves and stalks that are open surfaces are drawn from both sides; rays meet both sides anyway. Surfaces have the
    file's own colours where it gives any, and look like ours elsewhere.

    Args:
        path: The file.
        rules: Which object is what, unit, axes and place, and the budget of triangles.
        seed: The number that the plant has in its set, kept in `Plant.seed`.

    Returns:
        The plant; `preset` is the file's name without its ending.

    Raises:
        InvalidInputError: The file cannot be read, an object is none of the kinds or a card with a cut-out texture, a
            fruit's or the plant's size is impossible, no fruit is ripe, or so few triangles would not do. The message
            names the object.
    """
    return _plant(path, path.stem, read_objects(path), rules, rules.T_plant_file(path.suffix), seed)


def plant_from_triangles(source: str, arrays: Mapping[str, NDArray[Any]], seed: int = 0) -> Plant:
    """A plant from named triangles, which a generator of plants made; see `plant_from_mesh`.

    Args:
        source: The generator's name, kept in `Plant.preset`.
        arrays: Triangles of each object in the plant's frame (origin at the foot of the stem, z up), in [m], by names
            that begin as `MeshRules` has them: `leaf_...`, `stem...`, `fruit_...`. Shapes (F, 3, 3).
        seed: Which plant, kept in `Plant.seed`.

    Raises:
        InvalidInputError: As for `plant_from_mesh`.
    """
    return _plant(source, source, objects_of_arrays(source, arrays), MeshRules(), np.eye(4), seed)


def _plant(
    path: Path | str, preset: str, objects: Sequence[MeshObject], rules: MeshRules, T: Float64, seed: int
) -> Plant:
    kinds = _sorted_by_kind(path, objects, rules)
    surfaces = [placed(joined(parts), T) for _, _, parts in kinds]
    if rules.triangles is not None:
        surfaces = within_budget(path, surfaces, [name for _, name, _ in kinds], rules.triangles)
    organs: list[Organ] = []
    fruits: list[Fruit] = []
    for index, ((kind, name, parts), surface) in enumerate(zip(kinds, surfaces, strict=True)):
        if kind != "fruit":
            organs.append(_green_organ(kind, name, surface, index))
            continue
        ripeness = rules.ripeness_of(name, parts[0].material)
        for number, own in enumerate(_fruit_surfaces(surface, rules.fruits)):
            called = name if rules.fruits == "objects" else f"{name}_{number:02d}"
            centre, radius = _fitted(path, called, own.vertices, own.faces, rules)
            material = f"fruit_{ripeness}_{len(fruits) % SKIN_VARIANTS[ripeness]}"
            meshes = _mesh_parts(own, _round_uvs(own.vertices, centre), material)
            fruits.append(Fruit(len(organs), centre.astype(np.float32), radius, ripeness))
            organs.append(Organ(called, FRUIT_CLASS[ripeness], meshes))
    plant = Plant(preset=preset, seed=seed, detail="training", organs=tuple(organs), fruits=tuple(fruits))
    _check_plant(path, plant, rules)
    return plant


def _sorted_by_kind(
    path: Path | str, objects: Sequence[MeshObject], rules: MeshRules
) -> list[tuple[OrganKind, str, list[MeshObject]]]:
    """Kind, unique name and parts of each object in the order of names; parts of one name and kind are one object."""
    grouped: dict[tuple[OrganKind, str], list[MeshObject]] = {}
    unknown: dict[str, MeshObject] = {}
    for found in objects:
        kind = rules.kind_of(found.name, found.material)
        if kind is None:
            unknown.setdefault(found.name, found)
        elif kind != "ignore":
            if found.has_holes:
                raise InvalidInputError(
                    f"{path}: object {found.name!r} is a card: its shape is in the alpha channel of its texture "
                    f"(material {found.material!r}). Rays meet triangles, so it would hide what it leaves open; cut it "
                    "out along its outline where it was made, or leave it out with ignore="
                )
            grouped.setdefault((kind, found.name), []).append(found)
    if unknown:
        some = next(iter(unknown.values()))
        of_material = f" of material {some.material!r}" if some.material else ""
        more = f" (and {len(unknown) - 1} more)" if len(unknown) > 1 else ""
        raise InvalidInputError(
            f"{path}: object {some.name!r}{of_material}{more} is no leaf, stem or fruit by its name: rename it, or say "
            "with patterns such as leaf=['blade*'], stem=, fruit= or ignore= what it is"
        )
    names = [name for _, name in grouped]
    return [
        (kind, name if names.count(name) == 1 else f"{name}/{kind}", parts)
        for (kind, name), parts in grouped.items()
    ]


def _green_organ(kind: OrganKind, name: str, surface: Surface, index: int) -> Organ:
    vertices = surface.vertices
    if kind == "leaf":
        uvs = _blade_uvs(vertices, pieces_of(len(vertices), surface.faces))
        parts = _mesh_parts(surface, uvs, f"leaf_upper_{index % LEAF_VARIANTS}", sheet=True)
        return Organ(name, SemanticClass.LEAF, parts)
    uvs = np.stack([vertices[:, 0] + vertices[:, 1], vertices[:, 2]], 1) / TEXTURE_LENGTH
    return Organ(name, SemanticClass.STEM, _mesh_parts(surface, uvs, "stem", sheet=True))


def _mesh_parts(
    surface: Surface, uvs: Float64, material: str, *, sheet: bool = False
) -> tuple[MeshPart, ...]:
    """Parts of one image of the file, or of none, that are drawn from one or from both sides; with smooth normals.

    Args:
        surface: The triangles.
        uvs: Where their vertices are in our texture. Shape (V, 2).
        material: Its name.
        sheet: Whether pieces may be open surfaces, which are then drawn from both sides.
    """
    across = across_faces(surface.vertices, surface.faces)
    kept = np.flatnonzero((across * across).sum(1) > 0.0)
    count = len(surface.vertices)
    # Numbers from `count` on are the same vertices on the lower side of a sheet that is modelled from both.
    corners = surface.faces.copy()
    corners[kept] += count * is_below(count, surface.faces[kept], across[kept])
    normals = np.zeros((2 * count, 3))
    for k in range(3):
        np.add.at(normals, corners[kept, k], across[kept])
    normals = normalized(normals)
    paint_of_kept = surface.paint_of_face[kept]
    two_sided = is_open(count, surface.faces[kept]) & sheet
    groups = np.unique(np.stack([paint_of_kept, two_sided], 1), axis=0).tolist() or [[0, False]]
    parts = []
    for number, side in groups:
        own = kept[(paint_of_kept == number) & (two_sided == side)]
        faces, paint = corners[own], surface.paints[number]
        if paint is not None:
            used, places, faces = split_at_seams(faces, surface.uvs[own])
        else:
            used = np.arange(count)
            if len(groups) > 1 or (faces >= count).any():
                used, inverse = np.unique(faces, return_inverse=True)
                faces = inverse.reshape(-1, 3)
            places = uvs[used % count]
        parts.append(
            MeshPart(
                vertices=surface.vertices[used % count].astype(np.float32),
                normals=normals[used].astype(np.float32),
                uvs=places.astype(np.float32),
                faces=faces.astype(np.int32),
                material=material,
                two_sided=bool(side),
                texture=None if paint is None else paint.image,
            )
        )
    return tuple(parts)


def _fruit_surfaces(surface: Surface, fruits: str) -> Iterable[Surface]:
    """Each fruit of an object, from the lowest up.

    A piece whose middle lies in a larger one, such as a seed or a calyx, is part of that.
    """
    if fruits == "objects":
        return [surface]
    vertices, faces = surface.vertices, surface.faces
    labels = pieces_of(len(vertices), faces)
    kinds = np.unique(labels[faces[:, 0]])
    centres = np.stack([vertices[labels == kind].mean(0) for kind in kinds])
    radii = np.array(
        [np.linalg.norm(vertices[labels == k] - c, axis=1).max() for k, c in zip(kinds, centres, strict=True)]
    )
    owner: dict[int, list[int]] = {}
    for i in np.argsort(-radii, kind="stable").tolist():
        inside = [j for j in owner if np.linalg.norm(centres[i] - centres[j]) < radii[j]]
        owner.setdefault(inside[0] if inside else i, []).append(i)
    order = sorted(owner, key=lambda i: centres[i][::-1].tolist())
    return [surface.of(np.isin(labels[faces[:, 0]], kinds[owner[i]])) for i in order]


def _fitted(
    path: Path | str, name: str, vertices: Float64, faces: Int64, rules: MeshRules
) -> tuple[Float64, float]:
    """Centre of a fruit's surface and the radius of the sphere about it that holds every vertex, in [m]."""
    corners = vertices[faces]
    weights = np.linalg.norm(across_faces(vertices, faces), axis=1)
    if not weights.sum() > 0.0:
        raise InvalidInputError(f"{path}: fruit {name!r} has no surface; all its triangles are flat")
    centre = np.round((corners.mean(1) * weights[:, None]).sum(0) / weights.sum(), 6)
    away = vertices.astype(np.float32).astype(np.float64) - centre.astype(np.float32)
    radius = round(float(np.sqrt((away * away).sum(1).max())), 6) + 1e-6
    low, high = FRUIT_RADII
    if not low <= radius <= high:
        pieces = len(np.unique(pieces_of(len(vertices), faces)[faces[:, 0]]))
        many = pieces > 1 and radius > high and rules.fruits == "objects"
        hint = (
            f"it is of {pieces} pieces: if each is a fruit, say fruits='pieces'"
            if many
            else _unit_hint(rules)
        )
        raise InvalidInputError(
            f"{path}: fruit {name!r} has a radius of {radius:.4g} m; one of {low} to {high} m is allowed; {hint}"
        )
    return centre, radius


def _unit_hint(rules: MeshRules) -> str:
    return f"the file is read with units={rules.units!r} and scale={rules.scale:g}; units may be {', '.join(METRES)}"


def _check_plant(path: Path | str, plant: Plant, rules: MeshRules) -> None:
    ripe = [fruit for fruit in plant.fruits if fruit.ripeness == "ripe"]
    if not plant.fruits:
        names = ", ".join(repr(organ.name) for organ in plant.organs[:5])
        raise InvalidInputError(
            f"{path} has no fruit, only {names}{', ...' if len(plant.organs) > 5 else ''}: say with fruit=['pattern'] "
            "which objects are fruits"
        )
    if not ripe:
        first = plant.organs[plant.fruits[0].organ_index].name
        raise InvalidInputError(
            f"{path}: none of its {len(plant.fruits)} fruits, such as {first!r}, is ripe: change the patterns green= "
            "and turning=, or take the plant out"
        )
    low, high = plant.vertices.min(0), plant.vertices.max(0)
    height = float(high[2] - low[2])
    if not PLANT_HEIGHTS[0] <= height <= PLANT_HEIGHTS[1]:
        raise InvalidInputError(
            f"{path}: the plant is {height:.4g} m high; {PLANT_HEIGHTS[0]} to {PLANT_HEIGHTS[1]} m is allowed; "
            f"{_unit_hint(rules)}, and up={rules.up or 'the format says'!r}"
        )
    x, y = (0.5 * (low + high)[:2]).tolist()
    if np.hypot(x, y) > FARTHEST_AXIS:
        raise InvalidInputError(
            f"{path}: the plant's middle is at x = {x:.2f}, y = {y:.2f} m, but its stem must leave the ground at the "
            f"origin; move it there with offset=({-x:.2f}, {-y:.2f}, 0.0)"
        )


def _round_uvs(vertices: Float64, centre: Float64) -> Float64:
    """Longitude and polar angle about the centre, 0 to 1. Shape (V, 2)."""
    away = normalized(vertices - centre)
    around = np.arctan2(away[:, 1], away[:, 0]) / (2 * np.pi) + 0.5
    return np.stack([around, np.arccos(np.clip(away[:, 2], -1.0, 1.0)) / np.pi], 1)


def _blade_uvs(vertices: Float64, labels: NDArray[np.int64]) -> Float64:
    """Where each vertex is on its piece's blade: along and across its longest extent, 0 to 1. Shape (V, 2)."""
    uvs = np.zeros((len(vertices), 2))
    order = np.argsort(labels, kind="stable")
    for own in np.split(order, np.flatnonzero(np.diff(labels[order])) + 1):
        points = vertices[own] - vertices[own].mean(0)
        axes = np.linalg.eigh(points.T @ points)[1][:, ::-1][:, :2]
        flat = points @ axes
        low, high = flat.min(0), flat.max(0)
        uvs[own] = 0.02 + 0.96 * (flat - low) / np.maximum(high - low, 1e-9)
    return uvs
