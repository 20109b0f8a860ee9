"""Depth images with labels by ray casting: what a camera with a perfect segmenter sees, without a renderer."""

from typing import Any

import torch
import warp as wp
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.raycast import image_kernels, view_ray_kernels
from maniskill_tomato.raycast.caster import VisibilityCaster
from maniskill_tomato.raycast.images import BACKGROUND_DEPTH, CastImages
from maniskill_tomato.raycast.view_buffers import make_view
from maniskill_tomato.robot.d435 import CameraIntrinsics
from maniskill_tomato.robot.iiwa14 import LINK_NAMES


class ImageCaster:
    """Casts a ray through every pixel's centre at the meshes of a `VisibilityCaster`."""

    def __init__(self, caster: VisibilityCaster, intrinsics: CameraIntrinsics) -> None:
        """Shares the meshes of a caster, and follows its `replace_plant`.

        Args:
            caster: Whose environments are looked at.
            intrinsics: Of the images.
        """
        self.intrinsics = intrinsics
        self._caster = caster
        self._warp_device = str(wp.device_from_torch(str(caster.device)))
        b, device = caster.num_envs, caster.device
        shape = (b, intrinsics.height, intrinsics.width)
        self._depth = torch.zeros(shape, device=device)
        self._label = torch.zeros(shape, dtype=torch.int8, device=device)
        self._links_away = torch.eye(4, device=device).repeat(b, len(LINK_NAMES), 1, 1)
        self._links_away[..., :3, 3] = 1.0e6

    def cast(
        self,
        T_world_camera: Tensor,
        target_fruit: Tensor,
        T_world_plant: Tensor,
        link_transforms: Tensor | None = None,
    ) -> CastImages:
        """Takes the images.

        Args:
            T_world_camera: Poses of the optical frames, translation in [m]. Shape (B, 4, 4).
            target_fruit: Indices into the plants' `fruits`; none is labelled for one that does not exist. Shape (B,).
            T_world_plant: Poses of the plants. Shape (B, 4, 4).
            link_transforms: World poses of `iiwa14.LINK_NAMES`; None for no robot. Shape (B, 9, 4, 4).

        Raises:
            InvalidInputError: A tensor has the wrong shape.
        """
        b = self._caster.num_envs
        links = self._links_away if link_transforms is None else link_transforms
        for name, tensor, shape in (
            ("T_world_camera", T_world_camera, (b, 4, 4)),
            ("target_fruit", target_fruit, (b,)),
            ("T_world_plant", T_world_plant, (b, 4, 4)),
            ("link_transforms", links, (b, len(LINK_NAMES), 4, 4)),
        ):
            if tuple(tensor.shape) != shape:
                raise InvalidInputError(f"{name} must have shape {shape}, got {tuple(tensor.shape)}")
        scene: Any = self._caster.scene
        view = make_view(b, int(scene.link_lows.shape[0]), self._warp_device)
        cameras = wp.from_torch(T_world_camera.float().contiguous(), dtype=wp.mat44)
        plants = wp.from_torch(T_world_plant.float().contiguous(), dtype=wp.mat44)
        link_poses = wp.from_torch(links.float().contiguous(), dtype=wp.mat44)
        targets = wp.from_torch(target_fruit.to(torch.int32).contiguous())
        wp.launch(
            view_ray_kernels.prepare_rays,
            dim=b,
            inputs=[scene, view, cameras, plants, link_poses],
            device=self._warp_device,
        )
        i = self.intrinsics
        wp.launch(
            image_kernels.trace_image,
            dim=(b, i.height, i.width),
            inputs=[
                scene,
                view,
                i.fx,
                i.fy,
                i.cx,
                i.cy,
                BACKGROUND_DEPTH,
                targets,
                wp.from_torch(self._depth),
                wp.from_torch(self._label),
            ],
            device=self._warp_device,
        )
        if self._depth.is_cuda:
            wp.synchronize_device(self._warp_device)
        return CastImages(self._depth.clone(), self._label.clone())
