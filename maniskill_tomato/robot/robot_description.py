"""The robot's description files: the URDF, and the triangles of every link as SAPIEN renders them.

`tools/build_robot.py` wrote them.
"""

from functools import lru_cache
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from maniskill_tomato.assets import asset_path
from maniskill_tomato.robot import d435, iiwa14

VISIBLE_LINK_NAMES: Final = (*iiwa14.LINK_NAMES, d435.CAMERA_LINK_NAME)
"""The links that have a mesh."""

LinkMesh = tuple[npt.NDArray[np.float32], npt.NDArray[np.int32]]


def urdf_path() -> str:
    """The path of the shipped URDF.

    Raises:
        FileNotFoundError: The package was installed without its assets.
    """
    return str(asset_path(iiwa14.URDF_NAME))


def _load(name: str) -> LinkMesh:
    import trimesh

    scene: Any = trimesh.load_scene(asset_path(f"iiwa14/meshes/{name}.glb"), process=False)
    vertices: list[npt.NDArray[np.float64]] = []
    faces: list[npt.NDArray[np.int64]] = []
    count = 0
    for node in sorted(scene.graph.nodes_geometry):
        transform, geometry = scene.graph[node]
        mesh = scene.geometry[geometry]
        vertices.append(mesh.vertices @ transform[:3, :3].T + transform[:3, 3])
        faces.append(mesh.faces + count)
        count += len(mesh.vertices)
    return np.concatenate(vertices).astype(np.float32), np.concatenate(faces).astype(np.int32)


@lru_cache(maxsize=1)
def _link_meshes() -> dict[str, LinkMesh]:
    result = {name: _load(name) for name in iiwa14.LINK_NAMES}
    flange_vertices, flange_faces = result[iiwa14.EE_LINK_NAME]
    camera_vertices, camera_faces = _load(d435.CAMERA_LINK_NAME)
    rotation, offset = d435.T_flange_camera[:3, :3], d435.T_flange_camera[:3, 3]
    placed = (camera_vertices @ rotation.T + offset).astype(np.float32)
    result[iiwa14.EE_LINK_NAME] = (
        np.concatenate([flange_vertices, placed]),
        np.concatenate([flange_faces, camera_faces + np.int32(len(flange_vertices))]),
    )
    return result


def link_meshes() -> dict[str, LinkMesh]:
    """Every triangle that one sees of the robot, from the files that SAPIEN renders.

    Returns:
        For each of `iiwa14.LINK_NAMES`: vertices in the link frame, in [m], float32, shape (V, 3); and faces,
        int32, shape (F, 3), counter-clockwise from outside. `link_ee` holds the camera bracket and the D435's
        housing.

    Raises:
        FileNotFoundError: The package was installed without its assets.
    """
    return {name: (vertices.copy(), faces.copy()) for name, (vertices, faces) in _link_meshes().items()}
