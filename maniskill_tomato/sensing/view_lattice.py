"""A fixed lattice of camera positions round a target, from which planners choose and on which reach is known.

Directions are those from the target to the camera: azimuth 0 points along -x of the world, where the robot stands, and
grows to the right of a robot that faces the plant (towards -y); elevation grows upwards. Distances grow by a constant
factor. The axes do not follow the target or the camera, so that a table of numbers per candidate keeps its meaning.
"""

import math
from typing import Final

import torch
from torch import Tensor

from maniskill_tomato.robot.arm_model import ArmModel
from maniskill_tomato.robot.camera_reach import CameraReach
from maniskill_tomato.robot.iiwa14 import IIWA14

AZIMUTHS: Final = 13
"""Candidates from -90 to 90 degrees of azimuth."""
ELEVATIONS: Final = 9
"""Candidates from -60 to 60 degrees of elevation."""
DISTANCES: Final = 4
"""Candidates by distance."""
ANGLE_STEP: Final = math.radians(15.0)
"""Between neighbouring directions, in [rad]."""
FIRST_DISTANCE: Final = 0.22
"""From the target to the nearest candidates, in [m]: a little more than the smallest distance of a move."""
DISTANCE_RATIO: Final = 1.5
"""Between neighbouring distances: the last is 0.74 m, beyond which the arm reaches less than a third of the
directions."""

REACHABLE_SHARE: Final = 0.1
"""A target is in reach when the arm can look at it from this share of the candidates or more."""


class ViewLattice:
    """K = 13 x 9 x 4 camera positions round each target: azimuths, elevations, distances, the last fastest."""

    shape: Final = (AZIMUTHS, ELEVATIONS, DISTANCES)
    size: Final = AZIMUTHS * ELEVATIONS * DISTANCES

    def __init__(self, device: str | torch.device = "cpu", model: ArmModel = IIWA14) -> None:
        """Works out the candidates.

        Args:
            device: Where all tensors live.
            model: Of the arm that shall reach them.
        """
        self.model = model
        self.device = torch.device(device)
        self.azimuths = (torch.arange(AZIMUTHS, device=self.device) - AZIMUTHS // 2) * ANGLE_STEP
        """In [rad]. Shape (13,)."""
        self.elevations = (torch.arange(ELEVATIONS, device=self.device) - ELEVATIONS // 2) * ANGLE_STEP
        """In [rad]. Shape (9,)."""
        self.distances = FIRST_DISTANCE * DISTANCE_RATIO ** torch.arange(DISTANCES, device=self.device)
        """In [m]. Shape (4,)."""
        azimuth, elevation, distance = torch.meshgrid(
            self.azimuths, self.elevations, self.distances, indexing="ij"
        )
        direction = torch.stack(
            [
                -torch.cos(azimuth) * torch.cos(elevation),
                -torch.sin(azimuth) * torch.cos(elevation),
                torch.sin(elevation),
            ],
            dim=-1,
        )
        self.offsets = (distance[..., None] * direction).reshape(-1, 3)
        """From the target to each candidate, in the world frame, in [m]. Shape (K, 3)."""
        self.neighbours = self._neighbours()
        """One step down and up in azimuth, elevation and distance; -1 where the lattice ends. Shape (K, 6)."""
        self._reach = CameraReach(self.device, model)

    def positions(self, target_position: Tensor) -> Tensor:
        """The candidates' camera positions round each target, in the world frame, in [m].

        Args:
            target_position: In the world frame, in [m]. Shape (B, 3).

        Returns:
            Shape (B, K, 3).
        """
        return target_position[:, None] + self.offsets

    def index(self, azimuth: Tensor | int, elevation: Tensor | int, distance: Tensor | int) -> Tensor:
        """The candidate at given steps along the three axes of `shape`."""
        steps = [torch.as_tensor(step, device=self.device) for step in (azimuth, elevation, distance)]
        return (steps[0] * ELEVATIONS + steps[1]) * DISTANCES + steps[2]

    def coordinates(self, target_position: Tensor, camera_positions: Tensor) -> Tensor:
        """Where cameras stand on the lattice, in fractional steps of azimuth, elevation and distance from its first.

        Args:
            target_position: In the world frame, in [m]. Shape (B, 3).
            camera_positions: In the world frame, in [m]. Shape (B, M, 3).

        Returns:
            Within the lattice from 0 to 12, 8 and 3. Shape (B, M, 3).
        """
        offset = camera_positions - target_position[:, None]
        distance = offset.norm(dim=-1).clamp_min(1e-6)
        azimuth = torch.atan2(-offset[..., 1], -offset[..., 0])
        elevation = torch.asin((offset[..., 2] / distance).clamp(-1.0, 1.0))
        return torch.stack(
            [
                azimuth / ANGLE_STEP + AZIMUTHS // 2,
                elevation / ANGLE_STEP + ELEVATIONS // 2,
                torch.log(distance / FIRST_DISTANCE) / math.log(DISTANCE_RATIO),
            ],
            dim=-1,
        )

    def nearest(self, target_position: Tensor, camera_positions: Tensor) -> Tensor:
        """The candidate nearest to each camera in steps of the lattice. Shape (B, M), int64."""
        coordinates = self.coordinates(target_position, camera_positions).round().long()
        last = torch.tensor(self.shape, device=self.device) - 1
        return self.index(*torch.minimum(coordinates.clamp_min(0), last).unbind(-1))

    def reachable(self, target_position: Tensor) -> Tensor:
        """Which candidates the arm can look at its target from, with any of `CAMERA_ROLLS`.

        Exact poses only, and kinematics only: collisions are not asked for.

        Args:
            target_position: In the robot's base frame, in [m]. Shape (B, 3).

        Returns:
            Shape (B, K), bool.
        """
        targets = target_position.double()
        return self._reach.reachable(self.positions(targets), targets[:, None], kept_clear=False)

    def in_reach(self, target_position: Tensor) -> Tensor:
        """Which targets the arm can look at from `REACHABLE_SHARE` of the candidates. Shape (B, 3) to (B,), bool."""
        enough = math.ceil(REACHABLE_SHARE * self.size)
        return self.reachable(target_position).sum(dim=-1) >= enough

    def _neighbours(self) -> Tensor:
        steps = torch.stack(
            torch.meshgrid(*(torch.arange(n, device=self.device) for n in self.shape), indexing="ij"), dim=-1
        ).reshape(-1, 3)
        last = torch.tensor(self.shape, device=self.device) - 1
        columns = []
        for axis in range(3):
            for sign in (-1, 1):
                moved = steps.clone()
                moved[:, axis] += sign
                valid = ((moved >= 0) & (moved <= last)).all(dim=-1)
                columns.append(torch.where(valid, self.index(*moved.unbind(-1)), -1))
        return torch.stack(columns, dim=-1)
