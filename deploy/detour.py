"""Joint paths around obstacles, planned with mink's collision limits.

A PTP move is a straight line in joint space. Where `safety` refuses that line for a collision, the arm may still reach
the same posture by a few shorter lines. mink solves for joint velocities that turn towards the goal, keep the joints
within their limits and let no pair of shapes come nearer than its clearance; the configurations that it passes are
then shortened to as few straight moves as `safety` accepts. mink only proposes: `safety` checks each move in full.
"""

import math
from collections.abc import Iterator
from typing import Any, Final

import mink
import mujoco
import numpy as np
import torch

from maniskill_tomato.deploy.collision import OBSTACLE, TABLE, arm_spec
from maniskill_tomato.deploy.interface import ArmState, Float64, JointMove
from maniskill_tomato.deploy.motion_bounds import joint_path
from maniskill_tomato.deploy.plant_points import sphere_distances
from maniskill_tomato.deploy.safety import Safety
from maniskill_tomato.robot.kinematics import forward_kinematics
from maniskill_tomato.robot.spheres import sphere_table

mj: Any = mujoco

MAX_MOVES: Final = 4
"""Straight moves that a way may have."""

AROUND: Final = ((-0.1, 0.0, 0.0), (-0.07, 0.08, 0.0), (-0.07, -0.08, 0.0), (-0.07, 0.0, 0.08), None)
"""By how much the flange passes beside the middle of its straight way, base frame, in [m]: back from the row, and back
and to a side. None goes for the goal at once, which ends before an obstacle that the arm meets head on."""

STEP_LIMIT: Final = 0.05
"""Largest turn of a joint in one step of the solver, in [rad]."""

LEG_STEPS: Final = 60
"""Steps of the solver before it gives up a leg."""

ARRIVED: Final = 0.05
"""Joints this near to the goal are there, in [rad]."""

BALL: Final = 0.03
"""Plant points in one cube of this edge become one ball of this diameter, in [m]."""

NEAR: Final = 0.1
"""Points farther than this from the straight move's spheres are left out, in [m]; `safety` still sees them."""

MAX_BALLS: Final = 100
"""Most balls that the solver steers around: the nearest."""

MARGIN: Final = 0.003
"""By so much more than `safety` asks for the solver keeps away, in [m]."""

DETECTED: Final = 0.05
"""Shapes nearer than this to their clearance slow the solver down, in [m]."""


class DetourPlanner:
    """Finds ways of a few straight moves; not for use from several threads at once."""

    def __init__(self, safety: Safety, T_flange_camera: Float64) -> None:
        """Keeps what every way is checked with.

        Args:
            safety: Judges every straight move in full.
            T_flange_camera: The camera's optical frame in `link_ee`. Shape (4, 4).
        """
        self._safety = safety
        self._T_flange_camera = T_flange_camera

    def plan(
        self, state: ArmState, goal: Float64, now: float, frame_stamp: float, points_w: Float64
    ) -> list[JointMove] | None:
        """Straight moves from where the arm is to the goal.

        Args:
            state: Where the arm is.
            goal: Joint positions that are safe to stand at, in [rad]. Shape (7,).
            now: The time, in [s].
            frame_stamp: When the picture was taken that the decision rests on, in [s].
            points_w: What was seen of the plant, base frame, in [m]. Shape (P, 3).

        Returns:
            At most `MAX_MOVES`; None if no way was found.
        """
        if self._safety.stands_in_collision(goal, points_w):
            return None
        start = state.joint_positions
        arm = _SteeredArm(self._safety, self._T_flange_camera, self._near(start, goal, points_w))
        for around in AROUND:
            path = arm.path(start, goal, around)
            if path is None:
                continue
            moves = self._straightened(path, state, now, frame_stamp, points_w)
            if moves is not None:
                return moves
        return None

    def _near(self, start: Float64, goal: Float64, points_w: Float64) -> Float64:
        """Centres of the balls that stand for the plant beside the way, the nearest first. Shape (N, 3)."""
        if self._safety.config.plant_clearance is None or not len(points_w):
            return np.zeros((0, 3))
        cells = np.unique(np.floor(points_w / BALL), axis=0)
        centres: Float64 = (cells + 0.5) * BALL
        distances = self._sphere_distances(joint_path(start, goal, 0.1), centres).min(axis=0)
        order = np.argsort(distances, kind="stable")
        near: Float64 = centres[order[distances[order] < NEAR][:MAX_BALLS]]
        return near

    def _sphere_distances(self, path: Float64, points_w: Float64) -> Float64:
        return sphere_distances(path, points_w, self._T_flange_camera, self._safety.model)

    def _straightened(
        self, path: Float64, state: ArmState, now: float, frame_stamp: float, points_w: Float64
    ) -> list[JointMove] | None:
        """As few straight moves along the path as `safety` lets through, each as long as it can be."""
        moves: list[JointMove] = []
        at, last = 0, len(path) - 1
        while at < last:
            if len(moves) == MAX_MOVES:
                return None
            here = ArmState(joint_positions=path[at], joint_velocities=np.zeros(7), stamp=state.stamp)
            for end in _halving(at, last):
                move = JointMove(joint_positions=path[end], speed_fraction=self._safety.config.speed_fraction)
                if self._safety.check(move, here, now, frame_stamp, points_w) is None:
                    break
            else:
                return None
            moves.append(move)
            at = end
        return moves


class _SteeredArm:
    """The arm among obstacles as mink moves it."""

    def __init__(self, safety: Safety, T_flange_camera: Float64, balls: Float64) -> None:
        config = safety.config
        self._arm = safety.model
        spec = arm_spec(config.table_height, config.obstacles, T_flange_camera, self._arm)
        shapes = [geom for body in spec.bodies for geom in body.geoms if body.name not in ("world", "")]
        for k, geom in enumerate(shapes):
            geom.name = f"shape {k}"
        links, spheres = sphere_table(T_flange_camera, self._arm)
        for k, (link, sphere) in enumerate(zip(links, spheres.astype(np.float64), strict=True)):
            spec.body(self._arm.link_names[link]).add_geom(
                name=f"sphere {k}", type=mj.mjtGeom.mjGEOM_SPHERE, size=[sphere[3], 0.0, 0.0], pos=sphere[:3]
            )
        for k, centre in enumerate(balls):
            spec.worldbody.add_geom(
                name=f"ball {k}", type=mj.mjtGeom.mjGEOM_SPHERE, size=[BALL / 2, 0.0, 0.0], pos=centre
            )
        self._model: Any = spec.compile()
        names = [geom.name for geom in shapes]
        around = [TABLE, *(f"{OBSTACLE} {k}" for k in range(len(config.obstacles)))]
        self._limits: list[Any] = [
            mink.ConfigurationLimit(self._model, min_distance_from_limits=config.joint_margin),
            self._keep_apart(names, names, config.self_clearance),
            self._keep_apart(names, around[:1], config.table_clearance),
        ]
        if config.obstacles:
            self._limits.append(self._keep_apart(names, around[1:], config.obstacle_clearance))
        if len(balls) and config.plant_clearance is not None:
            named = [f"sphere {k}" for k in range(len(spheres))], [f"ball {k}" for k in range(len(balls))]
            self._limits.append(self._keep_apart(*named, config.plant_clearance - BALL / 2))

    def _keep_apart(self, first: list[str], second: list[str], clearance: float) -> Any:
        return mink.CollisionAvoidanceLimit(
            self._model,
            [(first, second)],
            minimum_distance_from_collisions=clearance + MARGIN,
            collision_detection_distance=clearance + MARGIN + DETECTED,
        )

    def path(
        self, start: Float64, goal: Float64, around: tuple[float, float, float] | None
    ) -> Float64 | None:
        """Configurations from start to goal, the last the goal itself, in [rad]; None if mink does not get there.

        Shape (N, 7).
        """
        arm = mink.Configuration(self._model, np.array(start))
        passed = [np.array(start)]
        posture: Any = mink.PostureTask(self._model, cost=1.0)
        if around is not None:
            via: Any = mink.FrameTask(self._arm.flange_link, "body", position_cost=10.0, orientation_cost=1.0)
            middle = forward_kinematics(torch.as_tensor((start + goal) / 2), self._arm).numpy()
            middle[:3, 3] += around
            via.set_target(mink.SE3.from_matrix(middle))
            posture.set_target((start + goal) / 2)
            for _ in range(LEG_STEPS):
                if not self._step(arm, [via], passed):
                    break
        posture.set_target(goal)
        for _ in range(LEG_STEPS):
            if np.abs(arm.q - goal).max() < ARRIVED:
                return np.array([*passed, goal])
            if not self._step(arm, [posture], passed):
                return None
        return None

    def _step(self, arm: Any, tasks: list[Any], passed: list[Float64]) -> bool:
        """Turns the joints a little towards the tasks; whether they moved."""
        try:
            velocity = mink.solve_ik(arm, tasks, 1.0, "daqp", damping=1e-3, limits=self._limits)
        except mink.NoSolutionFound:
            return False
        largest = float(np.abs(velocity).max())
        if not math.isfinite(largest) or largest < 1e-4:
            return False
        arm.integrate_inplace(velocity * min(1.0, STEP_LIMIT / largest), 1.0)
        passed.append(np.array(arm.q))
        return True


def _halving(at: int, last: int) -> Iterator[int]:
    """The end, then half as far, and so on down to the next one."""
    step = last - at
    while step > 0:
        yield at + step
        step //= 2
