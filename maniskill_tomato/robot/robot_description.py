"""The robot's description files: the URDF, and the triangles of every link as SAPIEN renders them.

`tools/build_robot.py` wrote those of the iiwa 14. Of another arm the collision shapes of its URDF stand for its links.
"""

from functools import lru_cache
from pathlib import Path
from typing import Any, Final
from xml.etree import ElementTree

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from maniskill_tomato.assets import asset_path
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.robot import d435, iiwa14
from maniskill_tomato.robot.arm_model import ArmModel
from maniskill_tomato.robot.iiwa14 import IIWA14

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


@lru_cache(maxsize=4)
def _link_meshes(model: ArmModel) -> dict[str, LinkMesh]:
    if model is IIWA14:
        result = {name: _load(name) for name in model.link_names}
    else:
        result = _shape_meshes(model)
    flange_vertices, flange_faces = result[model.flange_link]
    camera_vertices, camera_faces = _load(d435.CAMERA_LINK_NAME)
    rotation, offset = d435.T_flange_camera[:3, :3], d435.T_flange_camera[:3, 3]
    placed = (camera_vertices @ rotation.T + offset).astype(np.float32)
    result[model.flange_link] = (
        np.concatenate([flange_vertices, placed]),
        np.concatenate([flange_faces, camera_faces + np.int32(len(flange_vertices))]),
    )
    return result


def _shape_meshes(model: ArmModel) -> dict[str, LinkMesh]:
    """The collision shapes of each link of a URDF as triangles; none for a link without."""
    import trimesh

    links = {link.attrib.get("name"): link for link in ElementTree.parse(model.urdf).getroot().iter("link")}
    meshes: dict[str, LinkMesh] = {}
    for name in model.link_names:
        shapes: list[Any] = []
        for collision in links[name].findall("collision"):
            origin = collision.find("origin")
            at = {} if origin is None else origin.attrib
            T = np.eye(4)
            T[:3, 3] = [float(v) for v in at.get("xyz", "0 0 0").split()]
            angles = [float(v) for v in at.get("rpy", "0 0 0").split()]
            T[:3, :3] = Rotation.from_euler("xyz", angles).as_matrix()
            for shape in collision.iterfind("geometry/*"):
                shapes.append(_shape_mesh(shape, model.urdf).apply_transform(T))
        whole: Any = trimesh.util.concatenate(shapes) if shapes else trimesh.Trimesh()
        meshes[name] = (whole.vertices.astype(np.float32), whole.faces.astype(np.int32).reshape(-1, 3))
    return meshes


def _shape_mesh(shape: ElementTree.Element, urdf: Path) -> Any:
    import trimesh

    if shape.tag == "box":
        return trimesh.creation.box([float(v) for v in shape.attrib["size"].split()])
    if shape.tag == "cylinder":
        return trimesh.creation.cylinder(float(shape.attrib["radius"]), float(shape.attrib["length"]))
    if shape.tag == "sphere":
        return trimesh.creation.icosphere(2, float(shape.attrib["radius"]))
    raise InvalidInputError(
        f"{urdf} has a collision shape {shape.tag!r}; an arm is drawn from boxes, cylinders and spheres only"
    )


def link_meshes(model: ArmModel = IIWA14) -> dict[str, LinkMesh]:
    """Every triangle that one sees of the robot, of the iiwa 14 from the files that SAPIEN renders.

    Args:
        model: Of the arm.

    Returns:
        For each of its `link_names`: vertices in the link frame, in [m], float32, shape (V, 3); and faces, int32,
        shape (F, 3), counter-clockwise from outside. The flange link holds the D435's housing too.

    Raises:
        FileNotFoundError: The package was installed without its assets.
        InvalidInputError: The collision shapes of another arm are meshes.
    """
    return {name: (vertices.copy(), faces.copy()) for name, (vertices, faces) in _link_meshes(model).items()}
