"""`WholeRow`, the goal of `deploy inspect`: every ripe fruit of a row, one after the other, by the camera alone.

`sensing.inspection` says what to look at next, in the simulator too. Where the camera cannot look at it from where it
stands, the arm goes by its ready posture (`robot.transit`), in pieces that `safety` allows. A fresh picture is taken
before every piece; only what it shows of the plant is kept, for the collision check. A piece that is refused ends the
transit, and the fruit is given up. Where it is the first piece, leaves stand about the arm: it goes back to the view
before, up to `RETREATS` times, and tries from there.
"""

import logging
from collections import deque
from dataclasses import replace
from typing import Final

import numpy as np
import torch

from maniskill_tomato.deploy.goal import End, Look
from maniskill_tomato.deploy.interface import Float64, Frame
from maniskill_tomato.deploy.robot_perception import ImagePerception, Sighting
from maniskill_tomato.deploy.run_records import LoopConfig
from maniskill_tomato.deploy.safety import SafetyConfig, joint_path
from maniskill_tomato.robot.kinematics import forward_kinematics
from maniskill_tomato.robot.transit import TRANSIT_MOVES, TransitPlanner
from maniskill_tomato.sensing.inspection import InspectedFruit, Inspection
from maniskill_tomato.sensing.view_lattice import ViewLattice

STILL: Final = 0.005
"""An arm whose joints have all turned by less than this shows the same view again, in [rad]."""

ARRIVED: Final = 0.02
"""One whose joints are nearer than this to where it was sent is there, in [rad]."""

STUCK: Final = 3
"""The run ends after so many times `LoopConfig.refused_after` refused moves in a row; a fruit is given up after one."""

RETREATS: Final = 2
"""Views that the arm goes back by to begin a transit."""

WITHIN: Final = 0.95
"""Pieces of a transit take this share of the steps that `safety` allows."""

_logger = logging.getLogger(__name__)


class WholeRow:
    """All fruits in reach, until nothing is worth another move."""

    def __init__(
        self, perception: ImagePerception, loop: LoopConfig, safety: SafetyConfig, row_moves: int
    ) -> None:
        """Begins without a view.

        Args:
            perception: Turns pictures into a map of fruits.
            loop: V_f of a fully seen fruit, and the most moves for one.
            safety: How far a piece of a transit may go.
            row_moves: The most moves for the row.
        """
        self.max_moves = loop.max_moves
        self.view_joints: list[Float64] = []
        """Where the arm was at each view of the inspection, in [rad]. Each of shape (7,)."""
        self._perception, self._loop, self._safety, self._row_moves = perception, loop, safety, row_moves
        self._mapper = perception.begin_row()
        self._inspection = Inspection(loop.threshold, self._mapper.config.stop_errors)
        self._lattice, self._planner = ViewLattice(), TransitPlanner()
        self._way: deque[Float64] = deque()
        self._sent: Float64 | None = None
        self._on_the_way: Sighting | None = None
        self._trail: list[Float64] = []
        self._turned_at = self._refused = self._retreats = 0
        self._is_new = self._gives_up = self._is_first_piece = self._retreating = self._replans = False

    def fruits(self) -> list[InspectedFruit]:
        """The inspection list so far."""
        return self._inspection.fruits(self._mapper.map(0))

    def look(self, frame: Frame, T_world_camera: Float64, joints: Float64, moves: int) -> Look | None:
        """Maps the picture, and turns to another fruit when it is time; see `Goal`."""
        if self._sent is not None:
            is_there = np.abs(joints - self._sent).max() < ARRIVED
            self._sent = None
            self._is_first_piece = self._retreating = False
            if is_there:
                self._way.popleft()
            else:
                self._break_off()
            if self._way:
                return self._piece(self._unmapped(frame), moves, cost=0)
        moved = self._map(frame, T_world_camera, joints)
        end = self._turn(T_world_camera, joints, moves)
        view = self._perception.sighting(moved or self._is_new)
        self._on_the_way = view
        if self._way and end is None:
            self._is_first_piece = not self._retreating
            return self._piece(view, moves, cost=1 if self._retreating else TRANSIT_MOVES)
        is_new, self._is_new = self._is_new, False
        return Look(view=view, moves_left=self._moves_left(moves), end=end, is_new_target=is_new)

    def refused(self, in_a_row: int, why: str) -> End | None:
        """A refused piece ends a transit; too many moves in a row, and the fruit is given up, at last the row."""
        self._refused += 1
        if self._sent is not None:
            can_retreat = self._is_first_piece and self._retreats < RETREATS and len(self._trail) > 1
            self._break_off()
            if can_retreat:
                self._gives_up, self._retreating = False, True
        elif self._refused >= self._loop.refused_after:
            self._gives_up = True
        if in_a_row < STUCK * self._loop.refused_after:
            return None
        return End(reason="refused", detail=f"{in_a_row} moves in a row were refused, the last one: {why}")

    # ------------------------------------------------------------------ targets

    def _map(self, frame: Frame, T_world_camera: Float64, joints: Float64) -> bool:
        """Takes a view into the map, unless the arm stands where it stood; whether the target is elsewhere."""
        if self.view_joints and np.abs(joints - self.view_joints[-1]).max() < STILL:
            return False
        moved = self._perception.take(frame, T_world_camera)
        self.view_joints.append(joints.copy())
        if not self._trail or np.abs(joints - self._trail[-1]).max() >= STILL:
            self._trail.append(joints.copy())
        self._refused = 0
        view = self._mapper.last_view(0)
        assert view is not None
        self._inspection.take_in(self._mapper.map(0), view)
        return moved

    def _turn(self, T_world_camera: Float64, joints: Float64, moves: int) -> End | None:
        """Chooses what to look at next if this is done; why the run is over."""
        inspection, fruits = self._inspection, self._mapper.map(0)
        aim = inspection.aim
        if self._gives_up and aim is not None and aim.track is not None:
            inspection.give_up(aim.track)
        # A place to scan counts as done after any move, one on the way to it too.
        is_on_its_way = self._retreating or (self._replans and aim is not None and aim.track is None)
        is_done = not is_on_its_way and (
            aim is None or inspection.is_done(fruits, moves - self._turned_at, self.max_moves)
        )
        if is_done or self._gives_up:
            self._gives_up = self._retreating = self._replans = False
            aim = inspection.next(fruits, T_world_camera[:3, 3], self._lattice)
            if aim is None:
                return End(reason="success", detail=f"nothing is worth another move after {moves}")
            self._mapper.turn_to(0, aim.track, aim.position_w)
            self._is_new, self._turned_at = True, moves
            self._refused = self._retreats = 0
            self._plan_way(T_world_camera, joints, aim.position_w, moves)
        elif self._retreating:
            self._trail.pop()
            self._way.append(self._trail[-1])
            self._retreats, self._replans = self._retreats + 1, True
        elif self._replans and aim is not None:
            self._replans = False
            self._plan_way(T_world_camera, joints, aim.position_w, moves)
        if moves >= self._row_moves:
            return End(reason="budget", detail=f"all {self._row_moves} moves are made")
        return None

    def _moves_left(self, moves: int) -> int:
        """For this target, in [0, `max_moves`]."""
        return max(min(self.max_moves - (moves - self._turned_at), self._row_moves - moves), 0)

    # ----------------------------------------------------------------- transits

    def _plan_way(self, T_world_camera: Float64, joints: Float64, target: Float64, moves: int) -> None:
        """A transit, if the camera cannot look at the target from where it stands and moves are left for it."""
        if moves + TRANSIT_MOVES > self._row_moves:
            return
        goal = torch.as_tensor(target)
        places = self._lattice.positions(goal.float()[None])[0].double()
        position = torch.as_tensor(T_world_camera[:3, 3])
        transit = self._planner.to_first_view(torch.tensor(joints), position, places, goal)
        if transit is not None:
            c = self._safety
            pieces = cut_way(transit.waypoints.numpy(), WITHIN * c.max_joint_step, WITHIN * c.max_flange_step)
            self._way.extend(pieces)
            _logger.info("a transit of %d pieces to %s", len(pieces), np.round(target, 3).tolist())

    def _piece(self, view: Sighting, moves: int, cost: int) -> Look:
        self._sent = self._way[0]
        return Look(
            view=view,
            moves_left=self._moves_left(moves + cost),
            go_to=self._sent,
            cost=cost,
            detail="on the way to another view",
        )

    def _break_off(self) -> None:
        """Ends a transit on which the arm did not get as far as it was sent."""
        self._way.clear()
        self._sent = None
        self._gives_up = True

    def _unmapped(self, frame: Frame) -> Sighting:
        """A view on the way, of which nothing is kept in the map."""
        assert self._on_the_way is not None
        return replace(
            self._on_the_way,
            visible_fraction=0.0,
            sure_fraction=0.0,
            mask=np.zeros(frame.depth.shape, np.bool_),
            fruits_seen=0,
            recall=None,
        )


def cut_way(waypoints: Float64, joint_step: float, flange_step: float) -> list[Float64]:
    """Cuts straight lines in joint space into pieces.

    Args:
        waypoints: Joint positions, the present ones first, in [rad]. Shape (n, 7).
        joint_step: The most that one joint turns in a piece, in [rad].
        flange_step: The farthest that the flange gets from where a piece begins, in [m].

    Returns:
        Where each piece ends, in [rad]. Each of shape (7,).
    """
    ends: list[Float64] = []
    for start, goal in zip(waypoints[:-1], waypoints[1:], strict=True):
        count = max(int(np.ceil(np.abs(goal - start).max() / joint_step)), 1)
        while True:
            stops = [start + (goal - start) * k / count for k in range(count + 1)]
            if all(_reach(a, b) <= flange_step for a, b in zip(stops[:-1], stops[1:], strict=True)):
                break
            count += 1
        ends += stops[1:]
    return ends


def _reach(start: Float64, end: Float64) -> float:
    """The farthest that the flange gets from its start on a straight line in joint space, in [m]."""
    flange = forward_kinematics(torch.as_tensor(joint_path(start, end, 0.05))).numpy()[:, :3, 3]
    return float(np.linalg.norm(flange - flange[0], axis=-1).max())
