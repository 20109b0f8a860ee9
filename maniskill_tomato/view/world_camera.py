"""What cameras see in a world: pictures in the colours of the organs, and V_f from any place."""

from typing import Any, Final

import numpy as np
import torch
from torch import Tensor

from maniskill_tomato.raycast.view_rays import RayLabel
from maniskill_tomato.robot.camera_reach import CameraReach
from maniskill_tomato.robot.look_at import look_at_pose
from maniskill_tomato.tasks.world import World
from maniskill_tomato.view.episode_recording import Float64, HandView, TargetRays, UInt8
from maniskill_tomato.view.plant_meshes import organ_colours

PICTURE_SIZE: Final = (320, 240)
"""Width and height of the wrist camera's picture as it is shown, in [px]."""

SKY: Final = (178.0, 196.0, 204.0)
"""Colour of what stands behind the row, sRGB."""

MIDDLE_OF_FRUIT: Final = 0.85
"""Share of a fruit's sphere: a ray that comes nearer to its centre would meet the fruit, which is no whole sphere."""

ARM: Final = (206.0, 206.0, 208.0)
"""Colour of the arm in the picture, sRGB."""


class WorldCamera:
    """Takes pictures in the first environment of a world."""

    def __init__(self, world: World) -> None:
        """Follows the world's plant."""
        self._world = world
        self._palette: tuple[Any, Float64] | None = None
        self._reach: CameraReach | None = None

    def picture(self, T_w_camera: Tensor, T_w_links: Tensor | None) -> UInt8:
        """What a camera sees, each organ in its mean colour.

        Args:
            T_w_camera: Pose of the optical frame, float32. Shape (4, 4).
            T_w_links: Poses of the arm's links; None for no arm. Shape (9, 4, 4).

        Returns:
            RGB. Shape (H, W, 3).
        """
        world = self._world
        plant = world.plant_batch.plants[0]
        if self._palette is None or self._palette[0] is not plant:
            self._palette = plant, np.concatenate([[SKY, ARM], organ_colours(plant)])
        picture = world.scene.picture(
            world.intrinsics.scaled(*PICTURE_SIZE),
            T_w_camera,
            world.plant_batch.T_world_plant[0],
            T_w_links,
        )
        return picture.coloured(self._palette[1])

    def target_rays(self) -> TargetRays:
        """The rays from the wrist camera to the target."""
        world = self._world
        state, batch = world.state, world.plant_batch
        target = world.target_position_w
        rays = world.scene.view_rays(
            world.T_w_camera, state.target, target, batch.T_world_plant, world.T_w_links
        )
        T = as_double(world.T_w_camera[0])
        directions = as_double(rays.direction_c[0]) @ T[:3, :3].T
        label, distance = rays.label[0].cpu().numpy(), as_double(rays.distance[0])
        away = as_double(target[0]) - T[:3, 3]
        along = directions @ away
        passes_by = np.linalg.norm(away - along[:, None] * directions, axis=1)
        radius = batch.plants[0].fruits[int(state.target[0])].radius
        seen = label == int(RayLabel.TARGET)
        hidden = (label == int(RayLabel.OTHER)) & (passes_by < MIDDLE_OF_FRUIT * radius) & (distance < along)
        drawn = seen | hidden
        ends = T[:3, 3] + distance[drawn, None] * directions[drawn]
        return TargetRays(ends=ends.astype(np.float32), is_seen=seen[drawn])

    def look_from(self, position: Float64, target: Tensor) -> HandView:
        """What a camera that no arm holds would see of the present target.

        Args:
            position: Of the camera, in the world frame, in [m]. Shape (3,).
            target: What it is turned to, likewise. Shape (3,).
        """
        world = self._world
        target = target.double()
        place = torch.as_tensor(position, dtype=torch.float64)[None]
        T = look_at_pose(place, target[None])
        if self._reach is None:
            self._reach = CameraReach(world.device)
        return HandView(
            T_w_camera=as_double(T[0]),
            visible_fraction=float(world.ground_truth.visible_fraction(T)[0]),
            is_reachable=bool(self._reach.reachable(place, target)[0]),
            picture=self.picture(T[0].float(), None),
        )


def as_double(values: Tensor) -> Float64:
    """A copy in double precision."""
    return np.array(values.detach().double().cpu().numpy())
