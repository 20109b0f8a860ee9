"""Spheres that cover the camera and the last links, for distances to what is around the arm.

The camera's bar and the bracket, the wrist and the forearm, which reach into the leaves when the camera does. Every
point of these links' meshes lies in one of their spheres (a test holds them together), so that a distance to the
spheres is never larger than that to the links. The spheres' outer surface lies 6 mm from the links in the mean at the
camera (95 %: 11 mm) and 9 mm at the wrist and the forearm (95 %: 25 mm).
"""

from typing import Final

import numpy as np
import numpy.typing as npt

from maniskill_tomato.robot.d435 import T_flange_camera_color_optical
from maniskill_tomato.robot.iiwa14 import LINK_NAMES

Sphere = tuple[float, float, float, float]

CAMERA_SPHERES: Final[tuple[Sphere, ...]] = (
    (0.0, -0.0345, 0.0385, 0.0195),
    (0.0, -0.0207, 0.0385, 0.0195),
    (0.0, -0.0069, 0.0385, 0.0195),
    (0.0, 0.0069, 0.0385, 0.0195),
    (0.0, 0.0207, 0.0385, 0.0195),
    (0.0, 0.0345, 0.0385, 0.0195),
)
"""The camera's bar in `link_ee` where the drawings have it; the last spheres of `LINK_SPHERES`."""

LINK_SPHERES: Final[dict[str, tuple[Sphere, ...]]] = {
    "link_5": (
        (0.0, 0.0, 0.012, 0.0689),
        (0.0, -0.004, 0.045, 0.0688),
        (0.0, -0.016, 0.075, 0.0664),
        (0.0, -0.032, 0.103, 0.0639),
        (0.0, -0.05, 0.13, 0.0631),
        (0.0, -0.07, 0.157, 0.0661),
        (0.0, -0.076, 0.183, 0.07),
        (0.0, -0.078, 0.205, 0.0701),
    ),
    "link_6": (
        (0.0, 0.022, 0.0, 0.0672),
        (0.0, 0.05, 0.0, 0.066),
        (0.0, 0.078, 0.0, 0.0686),
        (0.0, 0.06, 0.035, 0.076),
        (0.0, 0.08, 0.03, 0.0759),
    ),
    "link_7": ((0.0, 0.0, 0.012, 0.0514),),
    "link_ee": ((0.0, 0.0, 0.008, 0.038), *CAMERA_SPHERES),
}
"""Centre x, y, z in the link's frame and radius of each sphere, in [m]; `link_ee` carries bracket and camera."""


def sphere_table(
    T_flange_camera: npt.NDArray[np.float64] = T_flange_camera_color_optical,
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.float32]]:
    """All spheres in one table.

    Args:
        T_flange_camera: The colour camera's optical frame in `link_ee`, which its bar goes with. Shape (4, 4).

    Returns:
        Index of each sphere's link in `LINK_NAMES`, shape (S,), and centre and radius in [m], shape (S, 4).
    """
    links = [LINK_NAMES.index(name) for name, spheres in LINK_SPHERES.items() for _ in spheres]
    rows = np.array([sphere for spheres in LINK_SPHERES.values() for sphere in spheres])
    if T_flange_camera is not T_flange_camera_color_optical:
        moved = T_flange_camera @ np.linalg.inv(T_flange_camera_color_optical)
        camera = slice(-len(CAMERA_SPHERES), None)
        rows[camera, :3] = rows[camera, :3] @ moved[:3, :3].T + moved[:3, 3]
    return np.array(links, dtype=np.int32), rows.astype(np.float32)
