"""The wrist camera as a pyramid in space: its centre and the corners of what it sees at a distance."""

import numpy as np
import torch
from numpy.typing import NDArray

from maniskill_tomato.robot.d435 import T_flange_camera_color_optical, color_intrinsics
from maniskill_tomato.robot.kinematics import viewpoint_transform


def frustum_points(viewpoint: NDArray[np.float64], depth: float) -> NDArray[np.float64]:
    """Apex and base of the colour camera's viewing pyramid in the world frame, in [m].

    Args:
        viewpoint: End-effector x, y, z [m], roll, pitch, yaw [rad], world frame. Shape (6,).
        depth: Distance of the base from the camera, in [m].

    Returns:
        The optical centre, then the corners of the 640 x 480 picture: top left, top right, bottom right,
        bottom left. Shape (5, 3).
    """
    camera = color_intrinsics()
    w, h = float(camera.width), float(camera.height)
    corners = camera.ray_directions([(0.0, 0.0), (w, 0.0), (w, h), (0.0, h)]) * depth
    points = np.concatenate([np.zeros((1, 3)), corners])
    T_world_ee = viewpoint_transform(torch.as_tensor(viewpoint, dtype=torch.float64)[None])[0].numpy()
    T_world_optical = T_world_ee @ np.asarray(T_flange_camera_color_optical)
    world: NDArray[np.float64] = points @ T_world_optical[:3, :3].T + T_world_optical[:3, 3]
    return world


def frustum_faces(points: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """The four sides and the base of `frustum_points` as polygons, each of shape (3 or 4, 3)."""
    apex, corners = points[0], points[1:]
    sides = [np.stack((apex, corners[i], corners[(i + 1) % 4])) for i in range(4)]
    return [*sides, corners]
