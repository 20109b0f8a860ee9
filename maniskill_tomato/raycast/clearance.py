"""How near the camera and the last links come to a plant on the way from one joint position to another."""

from typing import Any, Final

import numpy as np
import torch
import warp as wp
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.raycast import clearance_kernels
from maniskill_tomato.raycast.caster import VisibilityCaster
from maniskill_tomato.robot.iiwa14 import LINK_NAMES, NUM_JOINTS
from maniskill_tomato.robot.kinematics import RecordedLaunch, link_transforms
from maniskill_tomato.robot.spheres import sphere_table

CLEARANCE_RANGE: Final = 0.1
"""Largest clearance that is told apart, in [m]; what is farther away counts as this."""

PATH_SAMPLES: Final = 8
"""Joint positions looked at along a move, its end among them: 15 mm apart on a move of 0.12 m."""


_LAUNCHES_KEPT = 16


class PlantClearance:
    """Distances between the arm's spheres (`robot.spheres`) and the plants of a `VisibilityCaster`.

    All triangles of the plant count, leaves too. A sphere that a leaf cuts has a negative clearance: the distance from
    its surface inwards.
    """

    def __init__(self, caster: VisibilityCaster, samples: int = PATH_SAMPLES) -> None:
        """Shares the meshes of a caster, and follows its `replace_plant`.

        Args:
            caster: Whose plants are kept clear of.
            samples: Joint positions along a path.

        Raises:
            InvalidInputError: `samples` is below 1.
        """
        if samples < 1:
            raise InvalidInputError(f"samples must be at least 1, got {samples}")
        self._caster = caster
        self._samples = samples
        device = caster.device
        shares = np.arange(1, samples + 1, dtype=np.float32) / samples
        self._shares = torch.as_tensor(shares, device=device)[None, :, None]
        self._launches: dict[int, _Launch] = {}

    def along(
        self,
        start_qpos: Tensor,
        end_qpos: Tensor,
        T_world_plant: Tensor,
        env_idx: Tensor | None = None,
    ) -> Tensor:
        """The smallest clearance on the straight line between two joint positions, the start left out.

        Args:
            start_qpos: Joint positions, in [rad]. Shape (P, 7).
            end_qpos: Likewise. Shape (P, 7).
            T_world_plant: Poses of the plants, translation in [m]. Shape (P, 4, 4).
            env_idx: Whose plant each path is held against; None for one path in every environment. Shape (P,).

        Returns:
            In [m], at most `CLEARANCE_RANGE`, negative in contact. Shape (P,).

        Raises:
            InvalidInputError: A tensor has the wrong shape.
        """
        paths = self._caster.num_envs if env_idx is None else len(env_idx)
        joints, poses = (paths, NUM_JOINTS), (paths, 4, 4)
        for name, tensor, shape in (
            ("start_qpos", start_qpos, joints),
            ("end_qpos", end_qpos, joints),
            ("T_world_plant", T_world_plant, poses),
        ):
            if tuple(tensor.shape) != shape:
                raise InvalidInputError(f"{name} must have shape {shape}, got {tuple(tensor.shape)}")
        if paths == 0:
            return start_qpos.new_zeros(0)
        launch = self._launches.get(paths)
        if launch is None or launch.scene is not self._caster.scene:
            if len(self._launches) >= _LAUNCHES_KEPT:
                self._launches.clear()
            launch = self._launches[paths] = _Launch(self._caster, paths, self._samples)
        path = torch.lerp(start_qpos[:, None], end_qpos[:, None], self._shares)
        transforms = link_transforms(path.reshape(-1, NUM_JOINTS))
        return launch.run(transforms, T_world_plant, env_idx)

    def at(self, qpos: Tensor, T_world_plant: Tensor, env_idx: Tensor | None = None) -> Tensor:
        """The clearance where the arm stands; as `along` a path that goes nowhere. Shape (P,)."""
        return self.along(qpos, qpos, T_world_plant, env_idx)


class _Launch:
    """The kernel's launch for one number of paths, with its tensors."""

    def __init__(self, caster: VisibilityCaster, paths: int, samples: int) -> None:
        device = caster.device
        self.scene = caster.scene
        self._every = torch.arange(paths, dtype=torch.int32, device=device)
        self._envs = self._every.clone()
        self._plant_poses = torch.zeros(paths, 4, 4, device=device)
        self._link_poses = torch.zeros(paths, samples, len(LINK_NAMES), 4, 4, device=device)
        self._clearance = torch.zeros(paths, device=device)
        sphere_links, spheres = sphere_table()
        warp_device = wp.device_from_torch(device)
        # The launch keeps addresses: what they point to must stay alive with it.
        self._arguments: list[Any] = [
            self.scene,
            wp.from_torch(self._envs),
            wp.from_torch(self._plant_poses, dtype=wp.mat44),
            wp.from_torch(self._link_poses, dtype=wp.mat44),
            wp.array(sphere_links, dtype=wp.int32, device=warp_device),
            wp.array(spheres, dtype=wp.vec4, device=warp_device),
            CLEARANCE_RANGE,
            wp.from_torch(self._clearance),
        ]
        threads = (paths, samples, len(spheres))
        self._launch = RecordedLaunch(clearance_kernels.sphere_clearance, threads, device, self._arguments)

    def run(self, link_poses: Tensor, T_world_plant: Tensor, env_idx: Tensor | None) -> Tensor:
        self._link_poses.copy_(link_poses.view_as(self._link_poses))
        self._plant_poses.copy_(T_world_plant)
        self._envs.copy_(self._every if env_idx is None else env_idx)
        self._clearance.fill_(CLEARANCE_RANGE)
        self._launch()
        return self._clearance.clone()
