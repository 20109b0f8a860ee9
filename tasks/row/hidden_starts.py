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
"""Candidates that are looked from at a time, shared out among the environments; the first good one is taken."""

FEWEST_AT_ONCE = 2
"""The fewest of one environment."""

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


@dataclass(frozen=True, eq=False)
class StartRequest:
    """The environment that a start is drawn for."""

    env_index: int
    """Which environment."""
    rng: np.random.RandomState
    """Its generator."""
    targets: Sequence[int]
    """Indices of the fruits to choose from."""
    target_positions: Tensor
    """Their centres, world frame, in [m]. Shape (len(targets), 3)."""


@dataclass(eq=False)
class _Search:
    """How far the drawing for one environment is."""

    request: StartRequest
    order: list[int]
    """The targets in the order of their turns, as indices in the request's."""
    turn: int = 0
    """How many turns were taken."""
    target: int = 0
    """Whose candidates are looked from, as an index in the request's targets."""
    cost: float = float("inf")
    """How far V_f of the best start so far is off."""
    best: Start | None = None


class HardStarts:
    """Draws starts, for many environments at once."""

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

    def draw(self, requests: Sequence[StartRequest], T_world_plant: Tensor) -> list[Start]:
        """A start for each environment from which one of its targets is hidden, reached by the arm and free of contact.

        Positions are uniform over the box; the camera looks at the target with the picture upright. Targets take
        turns in random order until one has such a start. An environment's draws do not depend on the others.

        Args:
            requests: The environments, b of them.
            T_world_plant: Poses of all environments' plants. Shape (N, 4, 4).

        Raises:
            InvalidInputError: There are no targets, or the arm reaches no start for any.
        """
        if not all(request.targets for request in requests):
            raise InvalidInputError("the plant has no ripe fruit to look for; choose another preset or seed")
        searches = [_Search(r, r.rng.permutation(len(r.targets)).tolist()) for r in requests]
        open_searches = searches
        while open_searches:
            self._take_turns(open_searches, T_world_plant)
            open_searches = [
                s for s in open_searches if s.cost > 0.0 and s.turn < max(len(s.request.targets), MAX_DRAWS)
            ]
        for search in searches:
            if search.best is None:
                own = self._task.own
                where = (
                    f"the box {self._task.start_box} [m] in front of the plant"
                    if own.starts is None
                    else f"the starts of {own.env_id}"
                )
                raise InvalidInputError(
                    f"the arm can look at none of the {len(search.order)} ripe fruits from {where} without touching "
                    "it; move the plant with plant_pose"
                )
        return [search.best for search in searches if search.best is not None]

    def given(
        self, camera_positions: Sequence[object], targets: Sequence[int], target_positions: Tensor
    ) -> list[Start]:
        """Starts at camera positions, looking at the targets; upright if the arm can, else turned.

        Args:
            camera_positions: Of each environment, b of them: three numbers each, world frame, in [m].
            targets: Indices in `Plant.fruits`.
            target_positions: Their centres, world frame, in [m]. Shape (b, 3).

        Raises:
            InvalidInputError: One is not three finite numbers, or the arm cannot look at the target from there.
        """
        positions = torch.as_tensor(
            np.stack([_checked_position(position) for position in camera_positions]), device=self._device
        )
        move = self._look(positions, target_positions.double(), None)
        for position, reach in zip(camera_positions, move.reach.tolist(), strict=True):
            if reach != int(Reach.REACHABLE):
                raise InvalidInputError(
                    f"the arm cannot look at the target from the reset option camera_position {position!r}; give "
                    "one inside its workspace"
                )
        qpos, poses = move.qpos.float(), move.T_world_camera.float()
        return [Start(target, qpos[k], poses[k], True) for k, target in enumerate(targets)]

    def _look(self, positions: Tensor, targets: Tensor, rolls: int | None) -> LookAtMove:
        reference = self._ready.expand(len(positions), 7)
        return self._mover.look_from(reference, positions, targets, rolls, largest_joint_step=10.0)

    def _take_turns(self, searches: Sequence[_Search], T_world_plant: Tensor) -> None:
        """Draws candidates for the next target of each search, and looks from them until one is in range."""
        own = self._task.own
        draws, target_positions = [], []
        for search in searches:
            search.target = search.order[search.turn % len(search.order)]
            search.turn += 1
            target, rng = search.request.target_positions[search.target], search.request.rng
            target_positions.append(target)
            if own.starts is None:
                draws.append(rng.uniform(self._low, self._high, (CANDIDATES, 3)))
            else:
                draws.append(own.draw_starts(rng, CANDIDATES, target.double().cpu().numpy(), 3))
        env_idx = torch.tensor([search.request.env_index for search in searches], device=self._device)
        positions = torch.as_tensor(np.stack(draws), device=self._device)
        if own.starts is None:
            base = T_world_plant[env_idx, :3, 3].double()
            base[:, 2] = 0.0
            positions = positions + base[:, None]
        targets = torch.stack(target_positions).double()[:, None].expand_as(positions)
        far_enough = (positions - targets).norm(dim=-1) >= self._task.start_distance
        left = {k: np.flatnonzero(own).tolist() for k, own in enumerate(far_enough.cpu().numpy())}
        while left := {k: own for k, own in left.items() if own and searches[k].cost > 0.0}:
            at_once = max(FEWEST_AT_ONCE, AT_ONCE // len(left))
            rows = [(k, candidate) for k, own in left.items() for candidate in own[:at_once]]
            owner, candidate = (
                torch.tensor(column, device=self._device) for column in zip(*rows, strict=True)
            )
            look = self._look(positions[owner, candidate], targets[owner, candidate], 1)
            good = (look.reach == int(Reach.REACHABLE)).nonzero()[:, 0]
            if len(good):
                owners = [searches[rows[row][0]] for row in good.tolist()]
                qpos, poses = look.qpos[good].float(), look.T_world_camera[good].float()
                self._try(owners, qpos, poses, T_world_plant)
            left = {k: own[at_once:] for k, own in left.items()}

    def _try(self, owners: Sequence[_Search], qpos: Tensor, poses: Tensor, T_world_plant: Tensor) -> None:
        """Looks from candidates, and keeps for each search the first in range or the one nearest to it.

        Args:
            owners: Whose candidates they are, C of them.
            qpos: In [rad]. Shape (C, 7).
            poses: Of the optical frame. Shape (C, 4, 4).
            T_world_plant: Of all environments. Shape (N, 4, 4).
        """
        low, high = self._task.start_visibility
        env_idx = torch.tensor([s.request.env_index for s in owners], device=self._device)
        targets = torch.tensor([s.request.targets[s.target] for s in owners], device=self._device)
        plants = T_world_plant[env_idx]
        fraction = self._scene.visible_fraction_from(poses, targets, plants, link_transforms(qpos), env_idx)
        clearance = self._scene.clearance_at(qpos, plants, env_idx)
        excess = torch.maximum(low - fraction, fraction - high).clamp_min(0.0)
        is_hard = (fraction >= low) & (fraction < high)
        costs = torch.where(clearance > 0.0, torch.where(is_hard, 0.0, excess + 1e-6), torch.inf).tolist()
        for k, (search, cost) in enumerate(zip(owners, costs, strict=True)):
            if cost < search.cost:  # The first of equal ones stays.
                search.cost = cost
                target = search.request.targets[search.target]
                search.best = Start(target, qpos[k], poses[k], cost == 0.0)


def _checked_position(camera_position: object) -> NDArray[np.float64]:
    """The reset option `camera_position`. Shape (3,)."""
    try:
        values = np.asarray(camera_position, dtype=np.float64)
    except (TypeError, ValueError):
        values = np.zeros(0)
    if values.shape != (3,) or not np.isfinite(values).all():
        raise InvalidInputError(
            f"reset option camera_position must be three finite numbers (x, y, z [m]); got {camera_position!r}"
        )
    return values
