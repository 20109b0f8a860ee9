"""`WholeRow`, the goal of `deploy inspect`: every ripe fruit of a row, one after the other, by the camera alone.

`sensing.inspection` says what to look at next, in the simulator too. Where the camera cannot look at it from where it
stands, it names the places from which it could, the nearest first, and the loop finds a way to one of them. What is
seen on the way is mapped too. Where there is no way, the fruit is given up.
"""

from typing import Final

import numpy as np
import torch

from maniskill_tomato.deploy.goal import End, Look
from maniskill_tomato.deploy.interface import Float64, Frame
from maniskill_tomato.deploy.robot_perception import ImagePerception
from maniskill_tomato.deploy.run_records import LoopConfig
from maniskill_tomato.robot.arm_model import ArmModel
from maniskill_tomato.robot.iiwa14 import IIWA14
from maniskill_tomato.robot.transit import STAND_OFF, TRANSIT_MOVES, TransitPlanner
from maniskill_tomato.sensing.inspection import InspectedFruit, Inspection
from maniskill_tomato.sensing.view_lattice import ViewLattice

STILL: Final = 0.005
"""An arm whose joints have all turned by less than this shows the same view again, in [rad]."""

STUCK: Final = 3
"""The run ends after so many times `LoopConfig.refused_after` refused moves in a row; a fruit is given up after one."""


class WholeRow:
    """All fruits in reach, until nothing is worth another move."""

    def __init__(
        self, perception: ImagePerception, loop: LoopConfig, row_moves: int, model: ArmModel = IIWA14
    ) -> None:
        """Begins without a view.

        Args:
            perception: Turns pictures into a map of fruits.
            loop: V_f of a fully seen fruit, and the most moves for one.
            row_moves: The most moves for the row.
            model: Of the arm.
        """
        self.max_moves = loop.max_moves
        self.view_joints: list[Float64] = []
        """Where the arm was at each view of the inspection, in [rad]. Each of shape (7,)."""
        self._perception, self._loop, self._row_moves = perception, loop, row_moves
        self._mapper = perception.begin_row()
        self._inspection = Inspection(loop.threshold, self._mapper.config.stop_errors)
        self._lattice, self._planner = ViewLattice(model=model), TransitPlanner(model=model)
        self._places: Float64 | None = None
        self._turned_at = self._refused = 0
        self._is_new = self._gives_up = self._moved = False

    def fruits(self) -> list[InspectedFruit]:
        """The inspection list so far."""
        return self._inspection.fruits(self._mapper.map(0))

    def look(self, frame: Frame, T_world_camera: Float64, joints: Float64, moves: int) -> Look:
        """Maps the picture, and turns to another fruit when it is time; see `Goal`."""
        self._places = None
        moved = self._map(frame, T_world_camera, joints) or self._moved
        self._moved = False
        end = self._turn(T_world_camera, joints, moves)
        view = self._perception.sighting(moved or self._is_new)
        if self._places is not None and end is None:
            return Look(view=view, moves_left=self._moves_left(moves + TRANSIT_MOVES), places=self._places)
        is_new, self._is_new = self._is_new, False
        return Look(view=view, moves_left=self._moves_left(moves), end=end, is_new_target=is_new)

    def pass_by(self, frame: Frame, T_world_camera: Float64, joints: Float64) -> None:
        """Maps the picture; that it may not show the target speaks against nobody."""
        self._moved |= self._map(frame, T_world_camera, joints, is_on_the_way=True)

    def refused(self, in_a_row: int, why: str) -> End | None:
        """Where there is no way to a fruit, or too many moves were refused, it is given up, at last the row."""
        self._refused += 1
        if self._places is not None or self._refused >= self._loop.refused_after:
            self._gives_up = True
        if in_a_row < STUCK * self._loop.refused_after:
            return None
        return End(reason="refused", detail=f"{in_a_row} moves in a row were refused, the last one: {why}")

    # ------------------------------------------------------------------ targets

    def _map(
        self, frame: Frame, T_world_camera: Float64, joints: Float64, is_on_the_way: bool = False
    ) -> bool:
        """Takes a view into the map, unless the arm stands where it stood; whether the target is elsewhere."""
        if self.view_joints and np.abs(joints - self.view_joints[-1]).max() < STILL:
            return False
        moved = self._perception.take(frame, T_world_camera)
        self.view_joints.append(joints.copy())
        self._refused = 0
        view = self._mapper.last_view(0)
        assert view is not None
        self._inspection.take_in(self._mapper.map(0), view, is_on_the_way)
        return moved

    def _turn(self, T_world_camera: Float64, joints: Float64, moves: int) -> End | None:
        """Chooses what to look at next if this is done; why the run is over."""
        inspection, fruits = self._inspection, self._mapper.map(0)
        aim = inspection.aim
        if self._gives_up and aim is not None and aim.track is not None:
            inspection.give_up(aim.track)
        is_done = aim is None or inspection.is_done(fruits, moves - self._turned_at, self.max_moves)
        if is_done or self._gives_up:
            self._gives_up = False
            aim = inspection.next(fruits, T_world_camera[:3, 3], self._lattice)
            if aim is None:
                return End(reason="success", detail=f"nothing is worth another move after {moves}")
            self._mapper.turn_to(0, aim.track, aim.position_w)
            self._is_new, self._turned_at = True, moves
            self._refused = 0
            self._name_places(T_world_camera, joints, aim.position_w, moves)
        if moves >= self._row_moves:
            return End(reason="budget", detail=f"all {self._row_moves} moves are made")
        return None

    def _moves_left(self, moves: int) -> int:
        """For this target, in [0, `max_moves`]."""
        return max(min(self.max_moves - (moves - self._turned_at), self._row_moves - moves), 0)

    def _name_places(self, T_world_camera: Float64, joints: Float64, target: Float64, moves: int) -> None:
        """Says where to go if the camera cannot look at the target from where it is, and moves are left for it."""
        goal = torch.as_tensor(target)
        if moves + TRANSIT_MOVES > self._row_moves or self._planner.can_turn(torch.tensor(joints), goal):
            return
        places = self._lattice.positions(goal.float()[None])[0].double().numpy()
        places = places[self._lattice.reachable(goal.float()[None])[0].numpy()]
        places = places[np.linalg.norm(places - target, axis=-1) >= STAND_OFF]
        near = np.linalg.norm(places - T_world_camera[:3, 3], axis=-1).argsort(kind="stable")
        self._places = places[near]
