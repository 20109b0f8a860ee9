"""One target of a row after the other: which are in reach, which is next, and how the arm gets there."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal, get_args

import numpy as np
import torch
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.robot.inverse_kinematics import Reach
from maniskill_tomato.robot.look_at_move import moved_position
from maniskill_tomato.robot.transit import Transit, TransitPlanner
from maniskill_tomato.sensing.view_lattice import ViewLattice
from maniskill_tomato.tasks.arm_moves import Plan
from maniskill_tomato.tasks.world import World
from maniskill_tomato.tasks.world_state import MAX_TARGETS

Transits = Literal["none", "target", "refused", "both"]
"""When the arm goes by its ready posture (`robot.transit`): never; to the next target, if it cannot look at it from
where it stands; where a move is refused, if another posture reaches the place; or both."""


class TargetSequence:
    """The targets of every environment's row."""

    def __init__(self, world: World, lattice: ViewLattice, transits: Transits) -> None:
        """Follows a world.

        Args:
            world: The plants and arms.
            lattice: Says what the arm reaches.
            transits: When an arm goes by its ready posture.
        """
        if transits not in get_args(Transits):
            raise InvalidInputError.choice("transits", transits, get_args(Transits))
        self.transits: Transits = transits
        self._world = world
        self._lattice = lattice
        self._planner = TransitPlanner(world.device)

    def in_reach(self, indices: Sequence[int]) -> list[list[int]]:
        """The ripe fruits of some environments that the arm can look at."""
        plant_batch = self._world.plant_batch
        ripe = [[j for j in plant_batch.ripe_fruits[i] if j < MAX_TARGETS] for i in indices]
        centres = [plant_batch.fruit_positions_w(i, own) for i, own in zip(indices, ripe, strict=True)]
        near = iter(self._lattice.in_reach(torch.cat(centres)).tolist())
        return [[j for j in own if next(near)] for own in ripe]

    def begin(self, env_idx: Tensor) -> None:
        """Begins rows whose first targets are chosen. Shape (b,)."""
        state, indices = self._world.state, env_idx.tolist()
        state.open_targets[env_idx] = False
        for i, near in zip(indices, self.in_reach(indices), strict=True):
            state.open_targets[i, near] = True
        state.open_targets[env_idx, state.target[env_idx]] = True
        state.target_count[env_idx] = state.open_targets[env_idx].sum(-1)
        state.seen_count[env_idx] = 0
        state.target_moves[env_idx] = 0
        state.target_done[env_idx] = False
        state.transits[env_idx] = 0

    def is_over(self) -> Tensor:
        """Whether no target is left. Shape (N,), bool."""
        return ~self._world.state.open_targets.any(-1)

    def is_success(self) -> Tensor:
        """Whether all targets were seen. Shape (N,), bool."""
        state = self._world.state
        return state.seen_count >= state.target_count

    def open_targets(self, env_index: int = 0) -> list[int]:
        """The fruits that are yet to be looked for, the target among them, as indices in `Plant.fruits`."""
        return [int(j) for j in self._world.state.open_targets[env_index].nonzero()[:, 0]]

    def finish(self, full_visibility: float, max_moves: int) -> list[int]:
        """Counts what the last move saw; returns the environments that turn to another target."""
        state = self._world.state
        state.target_done = state.fraction_after > full_visibility
        state.seen_count = state.seen_count + state.target_done.long()
        ended = state.target_done | (state.target_moves >= max_moves)
        return [i for i in ended.nonzero()[:, 0].tolist() if self._choose_next(i)]

    def _choose_next(self, env_index: int) -> bool:
        """Chooses the nearest fruit left, if there is one."""
        world, state = self._world, self._world.state
        state.open_targets[env_index, state.target[env_index]] = False
        left: list[int] = state.open_targets[env_index].nonzero()[:, 0].tolist()
        if not left:
            return False
        away = world.plant_batch.fruit_positions_w(env_index, left) - world.T_w_camera[env_index, :3, 3]
        nearest = left[int(np.argmin(away.norm(dim=-1).tolist()))]
        world.set_target(torch.tensor([env_index], device=world.device), [nearest])
        state.target_moves[env_index] = 0
        return True

    def way_to_next(self, env_index: int, known_target: Tensor) -> Transit | None:
        """A transit to the nearest place for a first view; None if the camera sees the target from where it is, or if
        there is none.

        Args:
            env_index: Which environment.
            known_target: Where its target is believed to be, in the base frame, in [m]. Shape (3,).
        """
        if self.transits not in ("target", "both"):
            return None
        return self._planner.to_first_view(
            self._world.state.qpos[env_index],
            self._world.T_w_camera[env_index, :3, 3],
            self._lattice.positions(known_target[None])[0],
            known_target,
        )

    def ways_of_refused(self, plan: Plan, action: Tensor, known_target: Tensor) -> Plan:
        """The plan with transits where a look-at move is refused and another posture reaches the place.

        Args:
            plan: Of the move.
            action: What was asked for. Shape (N, 3).
            known_target: In the base frame, in [m]. Shape (N, 3).
        """
        if self.transits not in ("refused", "both"):
            return plan
        world, ways = self._world, {}
        for i in (plan.reach == int(Reach.UNREACHABLE)).nonzero()[:, 0].tolist():
            place = moved_position(world.T_w_camera[i, :3, 3], known_target[i], action[i])
            way = self._planner.plan(world.state.qpos[i], place[None], known_target[i])
            if way is not None:
                ways[i] = way
        return with_transits(plan, ways)


def with_transits(plan: Plan, ways: dict[int, Transit]) -> Plan:
    """The plan with other ways for some environments, which reach where they go."""
    if not ways:
        return plan
    target_qpos, reach = plan.target_qpos.clone(), plan.reach.clone()
    for i, way in ways.items():
        target_qpos[i] = way.waypoints[-1].to(target_qpos)
        reach[i] = int(Reach.REACHABLE)
    return replace(plan, target_qpos=target_qpos, reach=reach, transits=ways)
