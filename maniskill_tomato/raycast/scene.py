"""One scene of triangles: the plants and the robots of N environments, and what rays and spheres meet of them.

scene = RayScene(plants, intrinsics, robot_meshes=link_meshes())
seen = scene.visibility(T_w_camera, target_fruit, T_w_plant, link_transforms(qpos))
seen.visible_fraction, seen.any_visible
scene.replace_plant(env_index, new_plant)
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from maniskill_tomato.plants.organs import Plant
from maniskill_tomato.raycast.cast_image import ImageCaster
from maniskill_tomato.raycast.cast_views import CastViews
from maniskill_tomato.raycast.caster import LinkMeshes, VisibilityCaster
from maniskill_tomato.raycast.clearance import PlantClearance
from maniskill_tomato.raycast.images import CastImages, Picture
from maniskill_tomato.raycast.picture_caster import PictureCaster
from maniskill_tomato.raycast.view_rays import ViewRayCaster, ViewRays
from maniskill_tomato.raycast.visibility import Visibility
from maniskill_tomato.robot.d435 import CameraIntrinsics


class RayScene:
    """The plants and the links of N environments, on one device."""

    def __init__(
        self,
        plants: Sequence[Plant],
        intrinsics: CameraIntrinsics,
        *,
        robot_meshes: LinkMeshes | None = None,
        rays_per_side: int = 16,
        cached_plants: int = 64,
        device: str | torch.device = "cpu",
    ) -> None:
        """Builds the meshes.

        Args:
            plants: The plant of each environment; environments that show the same object share its meshes.
            intrinsics: The camera whose view is asked for, the same in all environments.
            robot_meshes: Links that can hide something, keyed by `iiwa14.LINK_NAMES`; None for no robot.
            rays_per_side: A visible fraction is counted with the square of this number of rays.
            cached_plants: How many plants' meshes are kept for environments that show them again.
            device: Where the rays are cast and all tensors live: "cpu" or a CUDA device.

        Raises:
            InvalidInputError: No plants, a plant without fruits, an unknown link, or a number out of range.
        """
        self._intrinsics = intrinsics
        self._caster = VisibilityCaster(
            plants=plants,
            intrinsics=intrinsics,
            robot_meshes=robot_meshes,
            rays_per_side=rays_per_side,
            cached_plants=cached_plants,
            device=device,
        )
        self._views = CastViews(self._caster, rays_per_side)
        self._view_rays = ViewRayCaster(self._caster)
        self._clearance = PlantClearance(self._caster)
        self._images: dict[CameraIntrinsics, ImageCaster] = {}

    @property
    def num_envs(self) -> int:
        """Number of environments N."""
        return self._caster.num_envs

    @property
    def device(self) -> torch.device:
        """Where the rays are cast."""
        return self._caster.device

    @property
    def intrinsics(self) -> CameraIntrinsics:
        """The camera of `visibility`, `visible_fraction_from` and `view_rays`."""
        return self._intrinsics

    def plant(self, env_index: int) -> Plant:
        """The plant that an environment shows."""
        return self._caster.plant(env_index)

    def replace_plant(self, env_index: int, plant: Plant) -> None:
        """Shows another plant in one environment.

        Args:
            env_index: Which environment, from 0 to N - 1.
            plant: A plant object used lately is found again, a new one costs the time to sort its triangles.
        """
        self._caster.replace_plant(env_index, plant)

    def visibility(
        self, T_w_camera: Tensor, target_fruit: Tensor, T_w_plant: Tensor, T_w_links: Tensor | None = None
    ) -> Visibility:
        """What each environment's camera sees of its target.

        Args:
            T_w_camera: Poses of the optical frames, translation in [m]. Shape (N, 4, 4).
            target_fruit: Indices into the plants' `fruits`; not checked on CUDA, where one that does not
                exist gives NaN. Shape (N,).
            T_w_plant: Poses of the plants. Shape (N, 4, 4).
            T_w_links: Poses of `iiwa14.LINK_NAMES`; None for no robot. Shape (N, 9, 4, 4).

        Raises:
            InvalidInputError: A tensor has the wrong shape or a target does not exist.
        """
        return self._caster.cast(T_w_camera, target_fruit, T_w_plant, T_w_links)

    def visible_fraction_from(
        self,
        T_w_camera: Tensor,
        target_fruit: int,
        T_w_plant: Tensor,
        T_w_links: Tensor | None = None,
        env_index: int = 0,
    ) -> Tensor:
        """V_f of one fruit from K viewpoints, the same numbers that `visibility` gives one by one.

        Args:
            T_w_camera: Poses of the optical frames, translation in [m]. Shape (K, 4, 4).
            target_fruit: Index into the plant's `fruits`.
            T_w_plant: Pose of the plant. Shape (4, 4).
            T_w_links: Poses of `iiwa14.LINK_NAMES` for each viewpoint; None for no robot. Shape (K, 9, 4, 4).
            env_index: Which environment shows the plant.

        Returns:
            V_f in [0, 1]. Shape (K,).

        Raises:
            InvalidInputError: A shape does not fit, or the fruit or the environment does not exist.
        """
        return self._views.visible_fraction(T_w_camera, target_fruit, T_w_plant, T_w_links, env_index)

    def view_rays(
        self,
        T_w_camera: Tensor,
        target_fruit: Tensor,
        target_position: Tensor,
        T_w_plant: Tensor,
        T_w_links: Tensor | None = None,
    ) -> ViewRays:
        """Looks along the pattern of `view_rays.ray_pattern` in each environment.

        Args:
            T_w_camera: Poses of the optical frames, translation in [m]. Shape (N, 4, 4).
            target_fruit: Indices into the plants' `fruits`; all rays are OUTSIDE for one that does not exist.
                Shape (N,).
            target_position: Where the pattern is centred: the target's centre as it is known, in the world
                frame, in [m]. Shape (N, 3).
            T_w_plant: Poses of the plants. Shape (N, 4, 4).
            T_w_links: Poses of `iiwa14.LINK_NAMES`; None for no robot. Shape (N, 9, 4, 4).

        Raises:
            InvalidInputError: A tensor has the wrong shape.
        """
        return self._view_rays.cast(T_w_camera, target_fruit, target_position, T_w_plant, T_w_links)

    def image(
        self,
        intrinsics: CameraIntrinsics,
        T_w_camera: Tensor,
        target_fruit: Tensor,
        T_w_plant: Tensor,
        T_w_links: Tensor | None = None,
    ) -> CastImages:
        """Depth and labels of every pixel in each environment.

        Args:
            intrinsics: Of the images.
            T_w_camera: Poses of the optical frames, translation in [m]. Shape (N, 4, 4).
            target_fruit: Indices into the plants' `fruits`; none is labelled for one that does not exist.
                Shape (N,).
            T_w_plant: Poses of the plants. Shape (N, 4, 4).
            T_w_links: Poses of `iiwa14.LINK_NAMES`; None for no robot. Shape (N, 9, 4, 4).

        Raises:
            InvalidInputError: A tensor has the wrong shape.
        """
        caster = self._images.get(intrinsics)
        if caster is None:
            caster = self._images[intrinsics] = ImageCaster(self._caster, intrinsics)
        return caster.cast(T_w_camera, target_fruit, T_w_plant, T_w_links)

    def picture(
        self,
        intrinsics: CameraIntrinsics,
        T_w_camera: Tensor,
        T_w_plant: Tensor,
        T_w_links: Tensor | None = None,
    ) -> Picture:
        """Depth, organs and shading of the first environment, as a painter needs them.

        Args:
            intrinsics: Of the picture.
            T_w_camera: Pose of the optical frame, translation in [m]. Shape (4, 4).
            T_w_plant: Pose of the plant. Shape (4, 4).
            T_w_links: Poses of `iiwa14.LINK_NAMES`; None for no robot. Shape (9, 4, 4).
        """
        return PictureCaster(self._caster, intrinsics).draw(T_w_camera, T_w_plant, T_w_links)

    def clearance_along(
        self,
        start_qpos: Tensor,
        end_qpos: Tensor,
        T_w_plant: Tensor,
        env_idx: Tensor | None = None,
    ) -> Tensor:
        """The smallest clearance on the straight line between two joint positions, the start left out.

        It is the distance between the spheres about the last links and the camera (`robot.spheres`) and the triangles
        of the plant, leaves too. A sphere that a leaf cuts has a negative clearance: the distance from its surface
        inwards.

        Args:
            start_qpos: Joint positions, in [rad]. Shape (P, 7).
            end_qpos: Likewise. Shape (P, 7).
            T_w_plant: Poses of the plants, translation in [m]. Shape (P, 4, 4).
            env_idx: Whose plant each path is held against; None for one path in every environment. Shape (P,).

        Returns:
            In [m], at most `CLEARANCE_RANGE`, negative in contact. Shape (P,).

        Raises:
            InvalidInputError: A tensor has the wrong shape.
        """
        return self._clearance.along(start_qpos, end_qpos, T_w_plant, env_idx)

    def clearance_at(self, qpos: Tensor, T_w_plant: Tensor, env_idx: Tensor | None = None) -> Tensor:
        """The clearance where the arm stands; as `clearance_along` a path that goes nowhere. Shape (P,)."""
        return self._clearance.at(qpos, T_w_plant, env_idx)
