"""Spheres that cover the camera and the last links, for distances to what is around the arm.

The camera's bar and the bracket, the wrist and the forearm, which reach into the leaves when the camera does. Every
point of these links' meshes lies in one of their spheres (a test holds them together), so that a distance to the
spheres is never larger than that to the links. The spheres' outer surface lies 6 mm from the links in the mean at the
camera (95 %: 11 mm) and 9 mm at the wrist and the forearm (95 %: 25 mm).
"""

from typing import Final

import numpy as np
import numpy.typing as npt

from maniskill_tomato.robot.arm_model import ArmModel, Sphere
from maniskill_tomato.robot.d435 import T_flange_camera_color_optical
from maniskill_tomato.robot.iiwa14 import IIWA14

CAMERA_SPHERES: Final[tuple[Sphere, ...]] = (
    (0.0, -0.0345, 0.0385, 0.0195),
    (0.0, -0.0207, 0.0385, 0.0195),
    (0.0, -0.0069, 0.0385, 0.0195),
    (0.0, 0.0069, 0.0385, 0.0195),
    (0.0, 0.0207, 0.0385, 0.0195),
    (0.0, 0.0345, 0.0385, 0.0195),
)
"""The camera's bar in the flange link where the drawings have it."""


def sphere_table(
    T_flange_camera: npt.NDArray[np.float64] = T_flange_camera_color_optical, model: ArmModel = IIWA14
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.float32]]:
    """All spheres of an arm and its camera in one table, the camera's last.

    Args:
        T_flange_camera: The colour camera's optical frame in the flange link, which its bar goes with. Shape (4, 4).
        model: Of the arm.

    Returns:
        Index of each sphere's link in its `link_names`, shape (S,), and centre and radius in [m], shape (S, 4).
    """
    every = [(name, sphere) for name, spheres in model.spheres.items() for sphere in spheres]
    every += [(model.flange_link, sphere) for sphere in CAMERA_SPHERES]
    links = [model.link_names.index(name) for name, _ in every]
    rows = np.array([sphere for _, sphere in every])
    if T_flange_camera is not T_flange_camera_color_optical:
        moved = T_flange_camera @ np.linalg.inv(T_flange_camera_color_optical)
        camera = slice(-len(CAMERA_SPHERES), None)
        rows[camera, :3] = rows[camera, :3] @ moved[:3, :3].T + moved[:3, 3]
    return np.array(links, dtype=np.int32), rows.astype(np.float32)
