"""Triangle meshes on a device: the links, and one set per plant, shared by every environment that shows it."""

import threading
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.plants.organs import ROLE_OF_CLASS, Plant
from maniskill_tomato.plants.plant_store import PLANT_STORE
from maniskill_tomato.raycast.embree import BYTES_OF_A_FACE as BYTES_OF_AN_EMBREE_FACE
from maniskill_tomato.raycast.embree import Backend, EmbreeMesh
from maniskill_tomato.robot.iiwa14 import LINK_NAMES

BYTES_OF_A_FACE: Final = 90
"""Corners, vertex indices and bounding volumes of a triangle of a Warp mesh, as measured."""

LinkTriangles = Mapping[str, tuple[NDArray[Any], NDArray[Any]]]
"""Vertices in the link frame, in [m], Shape (V, 3), and faces, Shape (F, 3), by link name."""


def build_mesh(vertices: NDArray[Any], faces: NDArray[Any], device: str, backend: Backend) -> Any:
    """A mesh with its bounding volume hierarchy; kernels know it by its attribute `id`.

    Args:
        vertices: Positions, in [m]. Shape (V, 3).
        faces: Vertex indices. Shape (F, 3).
        device: A Warp device name.
        backend: Whose.
    """
    if backend == "embree":
        return EmbreeMesh(vertices, faces)
    points = wp.array(np.ascontiguousarray(vertices, dtype=np.float32), dtype=wp.vec3, device=device)
    indices = wp.array(np.ascontiguousarray(faces, dtype=np.int32).ravel(), dtype=wp.int32, device=device)
    return wp.Mesh(points=points, indices=indices)


class PlantMeshes:
    """The meshes of one plant: all of it, and each fruit on its own."""

    def __init__(self, plant: Plant, device: str, backend: Backend) -> None:
        if not plant.fruits:
            raise InvalidInputError(f"a plant needs at least one fruit to look at; {plant.preset!r} has none")
        self.plant = plant
        """Whose meshes these are."""
        self.whole = build_mesh(plant.vertices, plant.faces, device, backend)
        """All triangles, for rays."""
        self._device = device
        self._for_distances = self.whole if backend == "warp" else None
        self._lock = threading.Lock()
        organs = [plant.organs[fruit.organ_index] for fruit in plant.fruits]
        self.fruits = [build_mesh(organ.vertices, organ.faces, device, backend) for organ in organs]
        self.spheres = np.array([(*fruit.centre, fruit.radius) for fruit in plant.fruits], dtype=np.float32)
        """Centre in the plant frame and radius of each fruit, in [m]. Shape (F, 4)."""
        self.is_ripe = np.array([fruit.ripeness == "ripe" for fruit in plant.fruits], dtype=np.int32)
        roles = np.array([ROLE_OF_CLASS[organ.semantic_class] for organ in plant.organs], dtype=np.uint8)
        self.role_of_face = torch.from_numpy(roles[plant.organ_of_face])
        """Values of `Role` of the triangles of `whole`, on the CPU. Shape (F,), uint8."""
        faces = len(plant.faces) + sum(len(organ.faces) for organ in organs)
        self.size = BYTES_OF_A_FACE * faces
        """In memory, in [bytes]."""
        if backend == "embree":
            self.size = BYTES_OF_AN_EMBREE_FACE * faces + BYTES_OF_A_FACE * len(plant.faces)

    @property
    def for_distances(self) -> Any:
        """All triangles as a Warp mesh, which finds the nearest point; built when first asked for."""
        with self._lock:
            if self._for_distances is None:
                self._for_distances = build_mesh(self.plant.vertices, self.plant.faces, self._device, "warp")
            return self._for_distances


def plant_meshes(plant: Plant, device: str, backend: Backend) -> PlantMeshes:
    """The meshes of a plant, found by its identity; those of the plants asked for last are kept for all scenes.

    Building the hierarchy of a plant takes tens of milliseconds. Scenes hold on to the sets that they show; the bound
    is on what is kept beyond that.
    """
    return PLANT_STORE.get(
        (plant, device, backend), lambda: PlantMeshes(plant, device, backend), lambda meshes: meshes.size
    )


class LinkMeshes:
    """The links that have triangles."""

    def __init__(self, robot_meshes: LinkTriangles, warp_device: str, backend: Backend) -> None:
        names = [name for name, (_, faces) in robot_meshes.items() if len(faces)]
        points = [np.asarray(robot_meshes[name][0], dtype=np.float32) for name in names]
        self.count = len(names)
        self._meshes = [
            build_mesh(p, robot_meshes[name][1], warp_device, backend)
            for name, p in zip(names, points, strict=True)
        ]
        self._indices = [LINK_NAMES.index(name) for name in names]
        self._lows = [p.min(axis=0) for p in points]
        self._highs = [p.max(axis=0) for p in points]

    def describe(self, scene: Any, device: torch.device) -> None:
        """Fills the table of links of a `kernels.Scene`."""
        meshes = torch.tensor([mesh.id for mesh in self._meshes], dtype=torch.int64, device=device)
        indices = torch.tensor(self._indices, dtype=torch.int32, device=device)
        scene.link_meshes = wp.from_torch(meshes, dtype=wp.uint64)
        scene.link_indices = wp.from_torch(indices)
        for name, corners in (("link_lows", self._lows), ("link_highs", self._highs)):
            table = torch.tensor(np.array(corners, dtype=np.float32).reshape(-1, 3), device=device)
            setattr(scene, name, wp.from_torch(table, dtype=wp.vec3))
