"""How near the camera and the last links come to a plant on the way from one joint position to another."""

from typing import Any, Final

import numpy as np
import torch
import warp as wp
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.robot.iiwa14 import LINK_NAMES, NUM_JOINTS
from maniskill_tomato.robot.kinematics import link_transforms
from maniskill_tomato.robot.spheres import sphere_table
from maniskill_tomato.visibility import clearance_kernels
from maniskill_tomato.visibility.caster import VisibilityCaster

CLEARANCE_RANGE: Final = 0.1
"""Largest clearance that is told apart, in [m]; what is farther away counts as this."""

PATH_SAMPLES: Final = 8
"""Joint positions looked at along a move, its end among them: 15 mm apart on a move of 0.12 m."""


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
        self._device = caster.device
        self._warp_device = str(wp.device_from_torch(str(caster.device)))
        b, links = caster.num_envs, len(LINK_NAMES)
        shares = np.arange(1, samples + 1, dtype=np.float32) / samples
        self._shares = torch.as_tensor(shares, device=self._device)[None, :, None]
        self._plant_poses = torch.eye(4, device=self._device).repeat(b, 1, 1)
        self._link_poses = torch.eye(4, device=self._device).repeat(b, samples, links, 1, 1)
        self._clearance = torch.zeros(b, device=self._device)
        sphere_links, spheres = sphere_table()
        self._sphere_links = wp.array(sphere_links, dtype=wp.int32, device=self._warp_device)
        self._spheres = wp.array(spheres, dtype=wp.vec4, device=self._warp_device)
        self._record()

    def along(self, start_qpos: Tensor, end_qpos: Tensor, T_world_plant: Tensor) -> Tensor:
        """The smallest clearance on the straight line between two joint positions, the start left out.

        Args:
            start_qpos: Joint positions, in [rad]. Shape (B, 7).
            end_qpos: Likewise. Shape (B, 7).
            T_world_plant: Poses of the plants, translation in [m]. Shape (B, 4, 4).

        Returns:
            In [m], at most `CLEARANCE_RANGE`, negative in contact. Shape (B,).

        Raises:
            InvalidInputError: A tensor has the wrong shape.
        """
        b = self._caster.num_envs
        joints, poses = (b, NUM_JOINTS), (b, 4, 4)
        for name, tensor, shape in (
            ("start_qpos", start_qpos, joints),
            ("end_qpos", end_qpos, joints),
            ("T_world_plant", T_world_plant, poses),
        ):
            if tuple(tensor.shape) != shape:
                raise InvalidInputError(f"{name} must have shape {shape}, got {tuple(tensor.shape)}")
        if self._scene is not self._caster.scene:
            self._record()
        path = torch.lerp(start_qpos[:, None], end_qpos[:, None], self._shares)
        self._link_poses.copy_(link_transforms(path.reshape(-1, NUM_JOINTS)).view_as(self._link_poses))
        self._plant_poses.copy_(T_world_plant)
        self._clearance.fill_(CLEARANCE_RANGE)
        stream = None
        if self._device.type == "cuda":
            stream = wp.stream_from_torch(torch.cuda.current_stream(self._device))
        self._command.launch(stream)
        return self._clearance.clone()

    def at(self, qpos: Tensor, T_world_plant: Tensor) -> Tensor:
        """The clearance where the arm stands; as `along` a path that goes nowhere. Shape (B,)."""
        return self.along(qpos, qpos, T_world_plant)

    def _record(self) -> None:
        """Prepares the launch that reads the caster's tables as they are now."""
        self._scene = self._caster.scene
        inputs = [
            self._scene,
            wp.from_torch(self._plant_poses, dtype=wp.mat44),
            wp.from_torch(self._link_poses, dtype=wp.mat44),
            self._sphere_links,
            self._spheres,
            CLEARANCE_RANGE,
            wp.from_torch(self._clearance),
        ]
        dim = (self._link_poses.shape[0], self._link_poses.shape[1], len(self._spheres))
        # A recorded launch keeps addresses, not arrays: what they point to must stay alive with it.
        self._launched_with = inputs
        self._command: Any = wp.launch(
            clearance_kernels.sphere_clearance,
            dim=dim,
            inputs=inputs,
            device=self._warp_device,
            record_cmd=True,
        )
