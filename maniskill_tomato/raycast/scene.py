"""One scene of triangles: the plants and the robots of N environments, and what rays and spheres meet of them.

scene = RayScene(plants, intrinsics, robot_meshes=link_meshes())
seen = scene.visibility(T_w_camera, target_fruit, T_w_plant, link_transforms(qpos))
seen.visible_fraction, seen.any_visible
scene.replace_plants({env_index: new_plant})
"""

from collections.abc import Mapping, Sequence
from typing import Final

import torch
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.plants.organs import Plant
from maniskill_tomato.raycast.embree import Backend, choose_backend
from maniskill_tomato.raycast.images import CastImages, Picture
from maniskill_tomato.raycast.meshes import LinkTriangles
from maniskill_tomato.raycast.view_rays import ViewRays
from maniskill_tomato.raycast.visibility import Visibility
from maniskill_tomato.raycast.warp_scene import WarpScene
from maniskill_tomato.robot.d435 import CameraIntrinsics
from maniskill_tomato.robot.iiwa14 import LINK_NAMES, NUM_JOINTS
from maniskill_tomato.robot.kinematics import link_transforms

CLEARANCE_RANGE: Final = 0.1
"""Largest clearance that is told apart, in [m]; what is farther away counts as this."""

PATH_SAMPLES: Final = 8
"""Joint positions looked at along a move, its end among them: 15 mm apart on a move of 0.12 m."""


class RayScene:
    """The plants and the links of N environments, on one device."""

    def __init__(
        self,
        plants: Sequence[Plant],
        intrinsics: CameraIntrinsics,
        *,
        robot_meshes: LinkTriangles | None = None,
        rays_per_side: int = 16,
        device: str | torch.device = "cpu",
        backend: Backend | None = None,
    ) -> None:
        """Builds the meshes.

        Args:
            plants: The plant of each environment; environments that show the same object share its meshes.
            intrinsics: The camera whose view is asked for, the same in all environments.
            robot_meshes: Links that can hide something, keyed by `iiwa14.LINK_NAMES`; None for no robot.
            rays_per_side: A visible fraction is counted with the square of this number of rays.
            device: Where the rays are cast and all tensors live: "cpu" or a CUDA device.
            backend: What traces the rays, with the same answers; None for Embree on a CPU that has it, and else Warp.

        Raises:
            InvalidInputError: No plants, a plant without fruits, an unknown link, a number out of range, or a backend
                that is not to be had here.
        """
        if len(plants) == 0:
            raise InvalidInputError("plants must name the plant of at least one environment, got none")
        if rays_per_side < 2:
            raise InvalidInputError(f"rays_per_side must be at least 2, got {rays_per_side}")
        for name in robot_meshes or {}:
            if name not in LINK_NAMES:
                raise InvalidInputError.choice("a key of robot_meshes", name, LINK_NAMES)
        self._intrinsics = intrinsics
        self._device = torch.device(device)
        self._plants = list(plants)
        self._backend: Backend = choose_backend(self._device, backend)
        self._rays = WarpScene(
            plants, intrinsics, robot_meshes or {}, rays_per_side, self._device, self._backend
        )
        n = len(plants)
        self._poses_shape, self._row_shape = (n, 4, 4), (n,)
        self._links_shape = (n, len(LINK_NAMES), 4, 4)
        shares = torch.arange(1, PATH_SAMPLES + 1, dtype=torch.float32, device=self._device) / PATH_SAMPLES
        self._path_shares = shares[None, :, None]

    @property
    def num_envs(self) -> int:
        """Number of environments N."""
        return len(self._plants)

    @property
    def device(self) -> torch.device:
        """Where the rays are cast."""
        return self._device

    @property
    def backend(self) -> Backend:
        """What traces the rays."""
        return self._backend

    @property
    def intrinsics(self) -> CameraIntrinsics:
        """The camera of `visibility`, `visible_fraction_from` and `view_rays`."""
        return self._intrinsics

    def plant(self, env_index: int) -> Plant:
        """The plant that an environment shows."""
        return self._plants[env_index]

    def replace_plants(self, plants: Mapping[int, Plant]) -> None:
        """Shows other plants in some environments.

        Args:
            plants: By the index of the environment, from 0 to N - 1. A plant object used lately is found again, a new
                one costs the time to sort its triangles.
        """
        for env_index in plants:
            if not 0 <= env_index < self.num_envs:
                raise InvalidInputError(
                    f"plants must be keyed by environments from 0 to {self.num_envs - 1}, got {env_index}"
                )
        self._rays.show(plants)
        for env_index, plant in plants.items():
            self._plants[env_index] = plant

    def prepare(self, plant: Plant) -> object:
        """Sorts the triangles of a plant that will be shown, in any thread.

        Returns:
            What `replace_plants` finds again for as long as somebody holds on to it; None where it has to sort them
            itself, on CUDA.
        """
        return self._rays.prepare(plant)

    def visibility(
        self,
        T_w_camera: Tensor,
        target_fruit: Tensor,
        T_w_plant: Tensor,
        T_w_links: Tensor | None = None,
        mask: Tensor | None = None,
    ) -> Visibility:
        """What each environment's camera sees of its target.

        Args:
            T_w_camera: Poses of the optical frames, translation in [m]. Shape (N, 4, 4).
            target_fruit: Indices into the plants' `fruits`; not checked on CUDA, where one that does not
                exist gives NaN. Shape (N,).
            T_w_plant: Poses of the plants. Shape (N, 4, 4).
            T_w_links: Poses of `iiwa14.LINK_NAMES`; None for no robot. Shape (N, 9, 4, 4).
            mask: The environments that are asked about, all if None; the answers of the others mean nothing.
                Shape (N,), bool.

        Raises:
            InvalidInputError: A tensor has the wrong shape or a target does not exist.
        """
        self._check_views(T_w_camera, target_fruit, T_w_plant, T_w_links, mask)
        if self._device.type == "cpu":
            self._check_targets(target_fruit)
        return self._rays.visibility(T_w_camera, target_fruit, T_w_plant, T_w_links, mask)

    def visible_fraction_from(
        self,
        T_w_camera: Tensor,
        target_fruit: Tensor | int,
        T_w_plant: Tensor,
        T_w_links: Tensor | None = None,
        env_idx: Tensor | int = 0,
    ) -> Tensor:
        """V_f from K viewpoints, the same numbers that `visibility` gives one by one.

        A number and a single pose of the plant are for all viewpoints.

        Args:
            T_w_camera: Poses of the optical frames, translation in [m]. Shape (K, 4, 4).
            target_fruit: Index into the plant's `fruits`. A number or shape (K,).
            T_w_plant: Pose of the plant. Shape (4, 4) or (K, 4, 4).
            T_w_links: Poses of `iiwa14.LINK_NAMES` for each viewpoint; None for no robot. Shape (K, 9, 4, 4).
            env_idx: Which environment shows the plant. A number or shape (K,).

        Returns:
            V_f in [0, 1]. Shape (K,).

        Raises:
            InvalidInputError: A shape does not fit, or a fruit or an environment does not exist.
        """
        count = T_w_camera.shape[0] if T_w_camera.dim() == 3 else 0
        _check_shape("T_w_camera", T_w_camera, (count, 4, 4))
        _check_shape("T_w_plant", T_w_plant, (4, 4) if T_w_plant.dim() == 2 else (count, 4, 4))
        if T_w_links is not None:
            _check_shape("T_w_links", T_w_links, (count, *self._links_shape[1:]))
        targets = torch.as_tensor(target_fruit, device=self._device)
        environments = torch.as_tensor(env_idx, device=self._device)
        for name, numbers in (("target_fruit", targets), ("env_idx", environments)):
            _check_shape(name, numbers, (count,) if numbers.dim() else ())
        pairs = torch.stack([environments.expand(count), targets.expand(count)], dim=-1)
        for env, target in {(int(env), int(target)) for env, target in pairs.tolist()}:
            if not 0 <= env < self.num_envs:
                raise InvalidInputError(f"env_idx must be from 0 to {self.num_envs - 1}, got {env}")
            fruits = len(self._plants[env].fruits)
            if not 0 <= target < fruits:
                raise InvalidInputError(f"target_fruit must be from 0 to {fruits - 1}, got {target}")
        return self._rays.visible_fraction_from(T_w_camera, targets, T_w_plant, T_w_links, environments)

    def view_rays(
        self,
        T_w_camera: Tensor,
        target_fruit: Tensor,
        target_position: Tensor,
        T_w_plant: Tensor,
        T_w_links: Tensor | None = None,
        mask: Tensor | None = None,
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
            mask: As in `visibility`.

        Raises:
            InvalidInputError: A tensor has the wrong shape.
        """
        self._check_views(T_w_camera, target_fruit, T_w_plant, T_w_links, mask)
        _check_shape("target_position", target_position, (self.num_envs, 3))
        return self._rays.view_rays(T_w_camera, target_fruit, target_position, T_w_plant, T_w_links, mask)

    def image(
        self,
        intrinsics: CameraIntrinsics,
        T_w_camera: Tensor,
        target_fruit: Tensor,
        T_w_plant: Tensor,
        T_w_links: Tensor | None = None,
    ) -> CastImages:
        """Depth and role of every pixel in each environment.

        Args:
            intrinsics: Of the images.
            T_w_camera: Poses of the optical frames, translation in [m]. Shape (N, 4, 4).
            target_fruit: Indices into the plants' `fruits`; no pixel shows one that does not exist. Shape (N,).
            T_w_plant: Poses of the plants. Shape (N, 4, 4).
            T_w_links: Poses of `iiwa14.LINK_NAMES`; None for no robot. Shape (N, 9, 4, 4).

        Raises:
            InvalidInputError: A tensor has the wrong shape.
        """
        self._check_views(T_w_camera, target_fruit, T_w_plant, T_w_links)
        return self._rays.image(intrinsics, T_w_camera, target_fruit, T_w_plant, T_w_links)

    def picture(
        self,
        intrinsics: CameraIntrinsics,
        T_w_camera: Tensor,
        T_w_plant: Tensor,
        T_w_links: Tensor | None = None,
        env_index: int = 0,
    ) -> Picture:
        """Depth, organs and shading in one environment.

        Args:
            intrinsics: Of the picture.
            T_w_camera: Pose of the optical frame, translation in [m]. Shape (4, 4).
            T_w_plant: Pose of the plant. Shape (4, 4).
            T_w_links: Poses of `iiwa14.LINK_NAMES`; None for no robot. Shape (9, 4, 4).
            env_index: Which environment.

        Raises:
            InvalidInputError: A tensor has the wrong shape, or there is no such environment.
        """
        if not 0 <= env_index < self.num_envs:
            raise InvalidInputError(f"env_index must be from 0 to {self.num_envs - 1}, got {env_index}")
        _check_shape("T_w_camera", T_w_camera, (4, 4))
        _check_shape("T_w_plant", T_w_plant, (4, 4))
        if T_w_links is not None:
            _check_shape("T_w_links", T_w_links, self._links_shape[1:])
        return self._rays.picture(intrinsics, T_w_camera, T_w_plant, T_w_links, env_index)

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
        paths = self.num_envs if env_idx is None else len(env_idx)
        _check_shape("start_qpos", start_qpos, (paths, NUM_JOINTS))
        _check_shape("end_qpos", end_qpos, (paths, NUM_JOINTS))
        _check_shape("T_w_plant", T_w_plant, (paths, 4, 4))
        if paths == 0:
            return start_qpos.new_zeros(0)
        path = torch.lerp(start_qpos[:, None], end_qpos[:, None], self._path_shares)
        T_w_links = link_transforms(path.reshape(-1, NUM_JOINTS)).view(
            paths, PATH_SAMPLES, *self._links_shape[1:]
        )
        return self._rays.clearance(T_w_links, T_w_plant, env_idx, CLEARANCE_RANGE)

    def clearance_at(self, qpos: Tensor, T_w_plant: Tensor, env_idx: Tensor | None = None) -> Tensor:
        """The clearance where the arm stands; as `clearance_along` a path that goes nowhere. Shape (P,)."""
        paths = self.num_envs if env_idx is None else len(env_idx)
        _check_shape("qpos", qpos, (paths, NUM_JOINTS))
        _check_shape("T_w_plant", T_w_plant, (paths, 4, 4))
        if paths == 0:
            return qpos.new_zeros(0)
        return self._rays.clearance(link_transforms(qpos)[:, None], T_w_plant, env_idx, CLEARANCE_RANGE)

    def _check_views(
        self,
        T_w_camera: Tensor,
        target_fruit: Tensor,
        T_w_plant: Tensor,
        T_w_links: Tensor | None,
        mask: Tensor | None = None,
    ) -> None:
        """Checks the arguments that describe one view in each environment."""
        _check_shape("T_w_camera", T_w_camera, self._poses_shape)
        _check_shape("target_fruit", target_fruit, self._row_shape)
        _check_shape("T_w_plant", T_w_plant, self._poses_shape)
        if T_w_links is not None:
            _check_shape("T_w_links", T_w_links, self._links_shape)
        if mask is not None:
            _check_shape("mask", mask, self._row_shape)

    def _check_targets(self, target_fruit: Tensor) -> None:
        for env, (target, plant) in enumerate(zip(target_fruit.tolist(), self._plants, strict=True)):
            if not 0 <= target < len(plant.fruits):
                raise InvalidInputError(
                    f"target_fruit[{env}] must be from 0 to {len(plant.fruits) - 1} for its plant, got {target}"
                )


def _check_shape(name: str, tensor: Tensor, shape: tuple[int, ...]) -> None:
    if tensor.shape != shape:
        raise InvalidInputError(f"{name} must have shape {shape}, got {tuple(tensor.shape)}")
