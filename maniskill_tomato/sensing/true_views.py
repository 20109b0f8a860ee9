"""What the simulator knows of the views around the present one: for critics, which no robot carries."""

import math
from collections.abc import Callable
from typing import Final

import torch
from torch import Tensor

from maniskill_tomato.robot.look_at import look_at_pose, look_frame
from maniskill_tomato.sensing.observation import MAP_SIDE, NEAR_MAP_SIDE
from maniskill_tomato.sensing.view_lattice import FIRST_DISTANCE, ViewLattice

TRUE_VIEWS: Final = MAP_SIDE**2 + NEAR_MAP_SIDE**2
"""Views: those of the observation's `map`, then those of its `near_map`."""

_MAPS = ((MAP_SIDE, math.radians(10.0), 1.0), (NEAR_MAP_SIDE, math.radians(15.0), 0.6))
"""Cells of a side, angle between neighbours in [rad], share of the present distance."""


def map_positions(camera_position: Tensor, target_position: Tensor) -> Tensor:
    """Where cameras stand for the cells of the observation's maps.

    Args:
        camera_position: In the world frame, in [m]. Shape (B, 3).
        target_position: What the camera looks at. Shape (B, 3).

    Returns:
        Row by row from above, each from the left. Shape (B, `TRUE_VIEWS`, 3).
    """
    axes = look_frame(camera_position, target_position)
    distance = (camera_position - target_position).norm(dim=-1)
    positions = []
    for side, step, share in _MAPS:
        steps = (torch.arange(side, device=axes.device) - side // 2) * step
        up, right = torch.meshgrid(-steps, steps, indexing="ij")
        angle = (right.square() + up.square()).sqrt()
        across = torch.sinc(angle / math.pi)
        offset = torch.stack([right * across, up * across, -torch.cos(angle)], dim=-1).reshape(-1, 3)
        away = distance if share == 1.0 else (share * distance).clamp_min(FIRST_DISTANCE)
        positions.append(target_position[:, None] + away[:, None, None] * (offset @ axes.mT))
    return torch.cat(positions, dim=1)


class TrueViews:
    """True V_f of every candidate of the lattice, asked once for every target, and read off where the maps are."""

    def __init__(self, num_envs: int, lattice: ViewLattice) -> None:
        """Knows nothing yet.

        Args:
            num_envs: Number of environments B.
            lattice: The candidates.
        """
        self._lattice = lattice
        self._table = torch.zeros(num_envs, lattice.size, device=lattice.device)

    def begin(
        self,
        env_idx: Tensor,
        target_position: Tensor,
        visible_fraction: Callable[[Tensor, int], Tensor],
    ) -> None:
        """Asks about the targets of some environments.

        Args:
            env_idx: Which environments. Shape (b,).
            target_position: Of all environments, in the world frame, in [m]. Shape (B, 3).
            visible_fraction: True V_f of poses (K, 4, 4) in an environment, of shape (K,).
        """
        candidates = self._lattice.positions(target_position)
        for i in (int(i) for i in env_idx):
            self._table[i] = visible_fraction(look_at_pose(candidates[i], target_position[i]), i)

    def describe(self, camera_position: Tensor, target_position: Tensor) -> Tensor:
        """2 V_f - 1 on the maps' places, between the candidates by interpolation; -1 outside the lattice.

        Args:
            camera_position: In the world frame, in [m]. Shape (B, 3).
            target_position: The true one. Shape (B, 3).

        Returns:
            Shape (B, `TRUE_VIEWS`).
        """
        places = map_positions(camera_position, target_position)
        return 2.0 * self._lattice.resample(self._table, target_position, places, outside=0.0) - 1.0
