"""Starts of the general tasks: camera positions from which the target is hidden."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.raycast.scene import RayScene
from maniskill_tomato.robot.iiwa14 import READY_QPOS
from maniskill_tomato.robot.inverse_kinematics import Reach
from maniskill_tomato.robot.kinematics import link_transforms
from maniskill_tomato.robot.look_at_move import LookAtMove, LookAtMover
from maniskill_tomato.tasks.row.row_config import GeneralTaskConfig

CANDIDATES = 64
"""Camera positions drawn at a time for each target."""

AT_ONCE = 8
"""Candidates that are looked from at a time; the first good one is taken."""

MAX_DRAWS = 4
"""Draws of `CANDIDATES` positions over all targets of a plant before the best start so far is taken."""


@dataclass(frozen=True, eq=False)
class Start:
    """Where an episode begins."""

    target: int
    """Index of the fruit in `Plant.fruits`."""
    qpos: Tensor
    """Joint positions, in [rad]. Shape (7,), float32."""
    T_world_camera: Tensor
    """Pose of the optical frame. Shape (4, 4), float32."""
    is_hard: bool
    """Whether V_f is in the task's range; if not, no drawn start was and this is the nearest to it."""


class HardStarts:
    """Draws starts for one environment at a time."""

    def __init__(self, task: GeneralTaskConfig, scene: RayScene, device: torch.device) -> None:
        """Keeps the ranges.

        Args:
            task: The task, whose start fields are drawn from.
            scene: Says what is seen and what is touched.
            device: Where results go.
        """
        self._task = task
        self._scene = scene
        self._device = device
        self._low, self._high = np.array(task.start_box).T
        self._mover = LookAtMover(device)
        self._ready = torch.tensor(READY_QPOS, dtype=torch.float64, device=device)

    def draw(
        self,
        env_index: int,
        rng: np.random.RandomState,
        targets: Sequence[int],
        target_positions: Tensor,
        T_world_plant: Tensor,
    ) -> Start:
        """A start from which one of the targets is hidden, reached by the arm and free of contact.

        Positions are uniform over the box; the camera looks at the target with the picture upright. Targets take
        turns in random order until one has such a start.

        Args:
            env_index: Which environment.
            rng: Its generator.
            targets: Indices of the fruits to choose from.
            target_positions: Their centres, world frame, in [m]. Shape (len(targets), 3).
            T_world_plant: Pose of the plant. Shape (4, 4).

        Raises:
            InvalidInputError: There are no targets, or the arm reaches no start for any.
        """
        if not targets:
            raise InvalidInputError("the plant has no ripe fruit to look for; choose another preset or seed")
        best: tuple[float, Start] | None = None
        order = rng.permutation(len(targets))
        for k in range(max(len(targets), MAX_DRAWS)):
            chosen = int(order[k % len(targets)])
            positions = rng.uniform(self._low, self._high, (CANDIDATES, 3))
            found = self._first_hard(
                env_index, targets[chosen], target_positions[chosen], positions, T_world_plant
            )
            if found is not None and (best is None or found[0] < best[0]):
                best = found
            if best is not None and best[1].is_hard:
                return best[1]
        if best is None:
            raise InvalidInputError(
                f"the arm can look at none of the {len(targets)} ripe fruits from the box {self._task.start_box} [m] "
                "in front of the plant without touching it; move the plant with plant_pose"
            )
        return best[1]

    def given(self, camera_position: object, target: int, target_position: Tensor) -> Start:
        """The start at a camera position, looking at the target; upright if the arm can, else turned.

        Raises:
            InvalidInputError: It is not three finite numbers, or the arm cannot look at the target from there.
        """
        try:
            values = np.asarray(camera_position, dtype=np.float64)
        except (TypeError, ValueError):
            values = np.zeros(0)
        if values.shape != (3,) or not np.isfinite(values).all():
            raise InvalidInputError(
                f"reset option camera_position must be three finite numbers (x, y, z [m]); got {camera_position!r}"
            )
        move = self._look(torch.as_tensor(values, device=self._device)[None], target_position, None)
        if int(move.reach[0]) != Reach.REACHABLE:
            raise InvalidInputError(
                f"the arm cannot look at the target from the reset option camera_position {camera_position!r}; give "
                "one inside its workspace"
            )
        return Start(target, move.qpos[0].float(), move.T_world_camera[0].float(), True)

    def _look(self, positions: Tensor, target_position: Tensor, rolls: int | None) -> LookAtMove:
        reference = self._ready.expand(len(positions), 7)
        target = target_position.double().expand(len(positions), 3)
        return self._mover.look_from(reference, positions, target, rolls, largest_joint_step=10.0)

    def _first_hard(
        self,
        env_index: int,
        target: int,
        target_position: Tensor,
        draws: NDArray[np.float64],
        T_world_plant: Tensor,
    ) -> tuple[float, Start] | None:
        """The first candidate in range, or the one nearest to it, with how far V_f is off; None if none is reached."""
        low, high = self._task.start_visibility
        stem = T_world_plant[:3, 3].double()
        positions = torch.as_tensor(draws, device=self._device)
        positions = positions + torch.stack([stem[0], stem[1], torch.zeros_like(stem[2])])
        far_enough = (positions - target_position.double()).norm(dim=-1) >= self._task.start_distance
        look = self._look(positions[far_enough], target_position, 1)
        good = look.reach == int(Reach.REACHABLE)
        all_qpos, all_poses = look.qpos[good].float(), look.T_world_camera[good].float()
        nearest: tuple[float, Start] | None = None
        for i in range(0, len(all_qpos), AT_ONCE):
            qpos, poses = all_qpos[i : i + AT_ONCE], all_poses[i : i + AT_ONCE]
            fraction = self._scene.visible_fraction_from(
                poses, target, T_world_plant, link_transforms(qpos), env_index
            )
            env_idx = torch.full((len(qpos),), env_index, device=self._device)
            clearance = self._scene.clearance_at(qpos, T_world_plant.expand(len(qpos), 4, 4), env_idx)
            excess = torch.maximum(low - fraction, fraction - high).clamp_min(0.0)
            is_hard = (fraction >= low) & (fraction < high)
            cost = torch.where(clearance > 0.0, torch.where(is_hard, 0.0, excess + 1e-6), torch.inf)
            k = int(cost.argmin())  # The first of equal ones.
            value = float(cost[k])
            if value < (nearest[0] if nearest else float("inf")):
                nearest = (value, Start(target, qpos[k], poses[k], value == 0.0))
            if value == 0.0:
                break
        return nearest
