"""Pictures by ray casting at the meshes of a `VisibilityCaster`: depth, labels and shading, without a renderer."""

from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.raycast import picture_kernels
from maniskill_tomato.raycast.caster import VisibilityCaster
from maniskill_tomato.raycast.images import Picture
from maniskill_tomato.raycast.meshes import FRUIT_CLASSES
from maniskill_tomato.robot.d435 import CAMERA_FAR, CameraIntrinsics
from maniskill_tomato.robot.iiwa14 import LINK_NAMES

_FAR_AWAY = 1.0e6


class PictureCaster:
    """Draws the first environment of a caster; 640 x 480 takes about 0.2 s on one core."""

    def __init__(self, caster: VisibilityCaster, intrinsics: CameraIntrinsics) -> None:
        """Shares the meshes of a caster on the CPU.

        Args:
            caster: Whose plant and links are drawn.
            intrinsics: The camera.

        Raises:
            InvalidInputError: The caster is not on the CPU.
        """
        if caster.device.type != "cpu":
            raise InvalidInputError(f"pictures are cast on the CPU only, got a caster on {caster.device}")
        self._caster = caster
        self.intrinsics = intrinsics

    def draw(
        self, T_world_camera: Tensor, T_world_plant: Tensor, link_transforms: Tensor | None = None
    ) -> Picture:
        """The picture from a pose.

        Args:
            T_world_camera: Pose of the optical frame, translation in [m]. Shape (4, 4).
            T_world_plant: Pose of the plant. Shape (4, 4).
            link_transforms: World poses of `iiwa14.LINK_NAMES`; None for no robot. Shape (9, 4, 4).
        """
        i = self.intrinsics
        size = (i.height, i.width)
        depth, facing = np.zeros(size, dtype=np.float32), np.zeros(size, dtype=np.float32)
        labels = np.zeros(size, dtype=np.int32)
        links = torch.eye(4).repeat(len(LINK_NAMES), 1, 1)
        links[:, :3, 3] = _FAR_AWAY
        if link_transforms is not None:
            links = link_transforms.float().contiguous()
        arrays: list[Any] = [
            wp.array(a, dtype=t, device="cpu", copy=False)
            for a, t in ((depth, wp.float32), (labels, wp.int32), (facing, wp.float32))
        ]
        wp.launch(
            picture_kernels.draw_picture,
            dim=size,
            inputs=[
                self._caster.scene,
                wp.array(self._face_labels(), dtype=wp.int32, device="cpu"),
                wp.mat44(*T_world_camera.double().numpy().ravel().tolist()),
                wp.mat44(*T_world_plant.double().numpy().ravel().tolist()),
                wp.from_torch(links, dtype=wp.mat44),
                wp.vec2(i.fx, i.fy),
                wp.vec2(i.cx, i.cy),
                CAMERA_FAR,
                *arrays,
            ],
            device="cpu",
        )
        return Picture(depth, labels, facing)

    def _face_labels(self) -> NDArray[np.int32]:
        """The organ of every face of the plant's mesh, in the order of `PlantMeshes`: fruits last."""
        plant = self._caster.plant(0)
        is_fruit = np.array([organ.semantic_class in FRUIT_CLASSES for organ in plant.organs])
        order = np.argsort(is_fruit[plant.organ_of_face], kind="stable")
        return np.ascontiguousarray(plant.organ_of_face[order], dtype=np.int32)
