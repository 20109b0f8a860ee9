"""Where episodes start: viewpoints drawn from the task's ranges until the arm can reach one, or given."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.robot.iiwa14 import READY_QPOS
from maniskill_tomato.robot.inverse_kinematics import IkSolution, InverseKinematics, Reach
from maniskill_tomato.robot.kinematics import viewpoint_transform
from maniskill_tomato.tasks.thesis.thesis_config import ViewpointTaskConfig

CANDIDATES = 16
"""Poses drawn at a time; the first one in reach is taken, so the number does not change the distribution."""

MAX_DRAWS = 64
"""Draws of `CANDIDATES` poses after which the ranges count as out of reach."""


class Starts:
    """Start viewpoints of one task, with the joints that take them."""

    def __init__(self, task: ViewpointTaskConfig, device: torch.device) -> None:
        """Keeps the ranges.

        Args:
            task: The task, whose `start_position` and `start_rpy` are drawn from.
            device: Where results go.
        """
        self._task = task
        self._device = device
        self._low, self._high = np.array((*task.start_position, *task.start_rpy)).T
        self._inverse_kinematics = InverseKinematics(device=str(device))
        self._ready = torch.tensor(READY_QPOS, dtype=torch.float64, device=device)

    def draw(self, rngs: Sequence[np.random.RandomState], target_positions: Tensor) -> tuple[Tensor, Tensor]:
        """One start per generator, uniform over the part of the ranges in reach (Eq. 5-1, 5-2, 5-7, 5-8).

        Args:
            rngs: The generator of each environment, b of them.
            target_positions: Where the targets are, world frame, in [m], for starts of a task's own. Shape (b, 3).

        Returns:
            Viewpoints (x, y, z [m], roll, pitch, yaw [rad]) of shape (b, 6) and joints [rad] of shape (b, 7).

        Raises:
            InvalidInputError: The arm reaches nothing of the ranges.
        """
        b, device = len(rngs), self._device
        viewpoint = torch.zeros(b, 6, device=device)
        qpos = torch.zeros(b, 7, device=device)
        rows = torch.arange(b, device=device)  # Those without a start so far.
        for _ in range(MAX_DRAWS):
            draws = np.stack([self._candidates(rngs[i], target_positions[i]) for i in rows.tolist()])
            candidates = torch.as_tensor(draws, dtype=torch.float32, device=device)
            solution = self._solve(candidates.reshape(-1, 6))
            reachable = (solution.reach == int(Reach.REACHABLE)).reshape(-1, CANDIDATES)
            found = reachable.any(dim=-1)
            first = reachable.int().argmax(dim=-1)[found]
            viewpoint[rows[found]] = candidates[found, first]
            qpos[rows[found]] = solution.qpos.reshape(-1, CANDIDATES, 7)[found, first].float()
            rows = rows[~found]
            if not len(rows):
                return viewpoint, qpos
        where = (
            f"the task's ranges {self._task.start_position} [m] and {self._task.start_rpy} [rad]"
            if self._task.own.starts is None
            else f"the starts of {self._task.own.env_id}"
        )
        raise InvalidInputError(
            f"none of {MAX_DRAWS * CANDIDATES} start poses could be reached; {where} lie outside the arm's workspace"
        )

    def _candidates(self, rng: np.random.RandomState, target_position: Tensor) -> NDArray[np.float64]:
        if self._task.own.starts is None:
            return rng.uniform(self._low, self._high, (CANDIDATES, 6))
        return self._task.own.draw_starts(rng, CANDIDATES, target_position.double().cpu().numpy(), 6)

    def given(self, viewpoint: Any, batch: int) -> tuple[Tensor, Tensor]:
        """The same start for all environments being reset.

        Args:
            viewpoint: x, y, z [m], roll, pitch, yaw [rad]. Shape (6,).
            batch: How many environments, b.

        Returns:
            As `draw`.

        Raises:
            InvalidInputError: It is not six finite numbers, or the arm cannot reach it.
        """
        values = np.asarray(viewpoint, dtype=np.float64)
        if values.shape != (6,) or not np.isfinite(values).all():
            raise InvalidInputError(
                "reset option viewpoint must be six finite numbers (x, y, z [m], roll, pitch, yaw [rad]); "
                f"got {viewpoint!r}"
            )
        start = torch.as_tensor(values, dtype=torch.float32, device=self._device).expand(batch, 6)
        solution = self._solve(start)
        if bool((solution.reach != int(Reach.REACHABLE)).any()):
            raise InvalidInputError(
                f"the arm cannot reach the reset option viewpoint {viewpoint!r}; give one inside its workspace"
            )
        return start, solution.qpos.float()

    def _solve(self, viewpoint: Tensor) -> IkSolution:
        poses, reference = viewpoint_transform(viewpoint), self._ready.expand(len(viewpoint), 7)
        return self._inverse_kinematics.solve(poses, reference, neighbour=False)
