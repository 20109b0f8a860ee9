"""Collisions of the arm with itself, the table and things that stand about, by MuJoCo on its URDF."""

from dataclasses import dataclass
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.deploy.arm_shapes import arm_shapes
from maniskill_tomato.deploy.interface import Float64
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.robot.arm_model import ArmModel
from maniskill_tomato.robot.d435 import T_flange_camera_color_optical
from maniskill_tomato.robot.iiwa14 import IIWA14

mj: Any = mujoco

TABLE: Final = "table"
OBSTACLE: Final = "obstacle"

LOOK_AHEAD: Final = 0.05
"""Distances are known up to this far beyond the clearances, in [m]; from there a path is followed in long steps."""

PATH_ERROR: Final = 5e-4
"""Between the postures that are looked at, shapes get nearer than their clearance by less than this, in [m]."""

FARTHEST_CORNER: Final = 1e4
"""Of a box from the base, in [m]: sums of larger numbers lose what the arm is held clear by."""

LEAVING_SLACK: Final = 1e-3
"""What is too near already gets nearer by less than this before it must be clear, in [m]."""

Corner = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Box:
    """An axis-aligned box in the base frame."""

    low: Corner
    """Lower corner x, y, z, in [m]."""
    high: Corner
    """Upper corner, in [m]."""

    def __post_init__(self) -> None:
        if not all(low < high for low, high in zip(self.low, self.high, strict=True)):
            raise InvalidInputError(
                f"low must lie below high along every axis, got {self.low} and {self.high}"
            )
        if not all(abs(corner) <= FARTHEST_CORNER for corner in (*self.low, *self.high)):
            raise InvalidInputError(
                f"low and high must be from {-FARTHEST_CORNER:g} to {FARTHEST_CORNER:g} m, got {self.low} and "
                f"{self.high}"
            )


@dataclass(frozen=True, kw_only=True)
class Contact:
    """Two things that come too near to each other."""

    first: str
    """A link."""
    second: str
    """A link, `table`, or `obstacle N`."""
    distance: float
    """Between their collision shapes, in [m], negative if they overlap."""
    clearance: float
    """How far they must stay from each other, in [m]."""
    share: float = 1.0
    """After so much of the move."""


def arm_spec(
    table_height: float, obstacles: tuple[Box, ...], T_flange_camera: Float64, model: ArmModel = IIWA14
) -> Any:
    """The arm with its collision shapes, the table and what stands about, not compiled yet.

    Args:
        table_height: Height of the surface that the arm stands on, in [m].
        obstacles: Boxes, geoms `obstacle N`.
        T_flange_camera: The camera's optical frame in `link_ee`, which its body goes with. Shape (4, 4).
        model: Of the arm.
    """
    spec = arm_shapes(model, T_flange_camera)
    world = spec.worldbody
    world.add_geom(
        name=TABLE, type=mj.mjtGeom.mjGEOM_PLANE, size=[2.0, 2.0, 0.1], pos=[0.0, 0.0, table_height]
    )
    for k, box in enumerate(obstacles):
        low, high = np.array(box.low), np.array(box.high)
        world.add_geom(
            name=f"{OBSTACLE} {k}",
            type=mj.mjtGeom.mjGEOM_BOX,
            size=((high - low) / 2).tolist(),
            pos=((high + low) / 2).tolist(),
        )
    return spec


class CollisionChecker:
    """Holds joint positions against collision shapes. Neighbouring links overlap and are left out."""

    def __init__(
        self,
        *,
        table_height: float = 0.0,
        table_clearance: float = 0.03,
        self_clearance: float = 0.01,
        obstacles: tuple[Box, ...] = (),
        obstacle_clearance: float = 0.05,
        T_flange_camera: Float64 = T_flange_camera_color_optical,
        model: ArmModel = IIWA14,
    ) -> None:
        """Compiles the model.

        Args:
            table_height: Height of the surface that the arm stands on, in [m].
            table_clearance: How far links stay from it, in [m].
            self_clearance: How far links stay from each other, in [m].
            obstacles: Boxes to stay clear of.
            obstacle_clearance: By so much, in [m].
            T_flange_camera: The camera's optical frame in `link_ee`, which its body goes with. Shape (4, 4).
            model: Of the arm.
        """
        spec = arm_spec(table_height, obstacles, T_flange_camera, model)
        self._model: Any = spec.compile()
        self._data: Any = mj.MjData(self._model)
        compiled = self._model
        compiled.geom_margin[:] = max(table_clearance, self_clearance, obstacle_clearance) + LOOK_AHEAD
        names = [self._name(g) for g in range(compiled.ngeom)]
        self._names = names
        # Links that are welded together count as one; the base is welded to the world.
        weld = compiled.body_weldid[compiled.geom_bodyid]
        parent = compiled.body_weldid[compiled.body_parentid[weld]]
        in_world = compiled.geom_bodyid == 0
        is_table = np.array([name.startswith(TABLE) for name in names])
        is_obstacle = np.array([name.startswith(OBSTACLE) for name in names])
        # By pair of shapes. Neighbours have at most one joint between them.
        neighbours = (weld[:, None] == weld) | (parent[:, None] == weld) | (weld[:, None] == parent)
        self._ignored = neighbours & ~(in_world[:, None] | in_world)
        self._needed = np.full((compiled.ngeom, compiled.ngeom), self_clearance)
        self._needed[is_obstacle[:, None] | is_obstacle] = obstacle_clearance
        self._needed[is_table[:, None] | is_table] = table_clearance
        levers = np.stack([self._levers(g) for g in range(compiled.ngeom)])
        # A joint that moves both shapes moves neither about the other.
        moves = levers > 0.0
        self._pair_levers = np.where(moves[:, None] ^ moves, levers[:, None] + levers, 0.0)
        self._pair_levers[self._ignored] = 0.0

    def _name(self, geom: int) -> str:
        body = self._model.geom_bodyid[geom]
        model = self._model
        return str(model.geom(geom).name if body == 0 else model.body(body).name)

    def _levers(self, geom: int) -> Float64:
        """Farthest that a point of a shape is from each joint's axis, in [m]; 0 for joints that do not move it."""
        model = self._model
        levers = np.zeros(model.nv)
        away = float(np.linalg.norm(model.geom_pos[geom]) + model.geom_rbound[geom])
        body = int(model.geom_bodyid[geom])
        while body != 0:
            first = int(model.body_jntadr[body])
            for joint in range(first, first + int(model.body_jntnum[body])):
                levers[model.jnt_dofadr[joint]] = away + float(np.linalg.norm(model.jnt_pos[joint]))
            away += float(np.linalg.norm(model.body_pos[body]))
            body = int(model.body_parentid[body])
        return levers

    def nearest(self, joint_positions: Float64) -> Contact | None:
        """The first joint position with anything too near, and its deepest contact there.

        Args:
            joint_positions: In [rad]. Shape (N, 7).

        Returns:
            None if all are clear.
        """
        for joints in joint_positions:
            near = self._near(joints)
            contact = self._deepest(near, near.needed, 1.0)
            if contact is not None:
                return contact
        return None

    def along(self, start: Float64, goal: Float64, leaving: float) -> Contact | None:
        """The first contact on the straight line in joint space, and the deepest one there.

        Between the postures that are looked at, too, nothing gets nearer than its clearance by `PATH_ERROR` or more:
        the next one is so near that no pair of shapes can have used up its room by then.

        Args:
            start: Where the arm stands, in [rad]. Shape (7,).
            goal: Where it would go, in [rad]. Shape (7,).
            leaving: What is too near at the start must be clear after this much turn of the fastest joint, in [rad],
                and get no nearer until then.

        Returns:
            None if the line is clear.
        """
        turn = np.abs(goal - start)
        speeds: Float64 = self._pair_levers @ turn
        fastest, most = float(speeds.max()), float(turn.max())
        leaves = min(1.0, leaving / most) if most > 0.0 else 1.0
        standing = self._near(start)
        share = 0.0
        while True:
            near = self._near(start + share * (goal - start))
            allowed = near.needed
            if share < leaves:
                stood = standing.distance_of(near.pairs)
                allowed = np.where(stood < allowed, stood - LEAVING_SLACK, allowed)
            contact = self._deepest(near, allowed, share)
            if contact is not None or share == 1.0:
                return contact
            rooms = near.distances - allowed + 2.0 * PATH_ERROR
            pair_speeds = speeds[near.pairs[:, 0], near.pairs[:, 1]]
            moving = pair_speeds > 0.0
            ahead = min(
                (rooms[moving] / pair_speeds[moving]).min(initial=np.inf), LOOK_AHEAD / max(fastest, 1e-12)
            )
            following = min(share + ahead, 1.0)
            share = leaves if share < leaves < following else following

    def smallest(self, contact: Contact, joint_positions: Float64) -> float:
        """Smallest distance of two things at some postures, or that of the contact itself, in [m].

        Args:
            contact: Between which.
            joint_positions: In [rad]. Shape (N, 7).
        """
        names, found = {contact.first, contact.second}, contact.distance
        for joints in joint_positions:
            near = self._near(joints)
            for pair, distance in zip(near.pairs, near.distances, strict=True):
                if {self._names[g] for g in pair} == names:
                    found = min(found, float(distance))
        return found

    def _near(self, joints: Float64) -> "_Near":
        """The pairs of shapes that are not far from each other."""
        data = self._data
        data.qpos[:] = joints
        mj.mj_kinematics(self._model, data)
        mj.mj_collision(self._model, data)
        pairs = np.array(data.contact.geom, dtype=np.int64).reshape(-1, 2)
        counts = ~self._ignored[pairs[:, 0], pairs[:, 1]]
        pairs = pairs[counts]
        return _Near(pairs, np.array(data.contact.dist)[counts], self._needed[pairs[:, 0], pairs[:, 1]])

    def _deepest(self, near: "_Near", allowed: Float64, share: float) -> Contact | None:
        deep = near.distances < allowed
        if not deep.any():
            return None
        k = int(np.where(deep, near.distances, np.inf).argmin())
        a, b = (self._names[g] for g in near.pairs[k])
        first, second = sorted((a, b), key=lambda name: name.startswith((TABLE, OBSTACLE)))
        distance, clearance = float(near.distances[k]), float(near.needed[k])
        return Contact(first=first, second=second, distance=distance, clearance=clearance, share=share)


class _Near:
    """Pairs of shapes near to each other at one posture."""

    def __init__(self, pairs: NDArray[np.int64], distances: Float64, needed: Float64) -> None:
        self.pairs, self.distances, self.needed = pairs, distances, needed

    def distance_of(self, pairs: NDArray[np.int64]) -> Float64:
        """Smallest distance of each of other pairs here, infinite where they are far apart. Shape (N,)."""
        if not len(pairs):
            return np.zeros(0)
        same = (pairs[:, None] == self.pairs).all(-1)
        distances: Float64 = np.where(same, self.distances, np.inf).min(axis=1, initial=np.inf)
        return distances
