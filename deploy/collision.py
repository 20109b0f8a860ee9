"""Collisions of the arm with itself, the table and things that stand about, by MuJoCo on the package's URDF."""

from dataclasses import dataclass
from typing import Any, Final

import mujoco
import numpy as np

from maniskill_tomato.deploy.interface import Float64
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.robot.d435 import CAMERA_LINK_NAME, T_flange_camera_color_optical, camera_link_pose
from maniskill_tomato.robot.robot_description import urdf_path

mj: Any = mujoco

TABLE: Final = "table"
OBSTACLE: Final = "obstacle"


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


@dataclass(frozen=True, kw_only=True)
class Contact:
    """Two things that come too near to each other."""

    first: str
    """A link."""
    second: str
    """A link, `table`, or `obstacle N`."""
    distance: float
    """Between their collision shapes, in [m], negative if they overlap."""
    sample: int
    """At which of the joint positions."""


def arm_spec(table_height: float, obstacles: tuple[Box, ...], T_flange_camera: Float64) -> Any:
    """The arm with its collision shapes, the table and what stands about, not compiled yet.

    Args:
        table_height: Height of the surface that the arm stands on, in [m].
        obstacles: Boxes, geoms `obstacle N`.
        T_flange_camera: The camera's optical frame in `link_ee`, which its body goes with. Shape (4, 4).
    """
    spec = mj.MjSpec.from_file(urdf_path())
    pose = camera_link_pose(T_flange_camera)
    camera = spec.body(CAMERA_LINK_NAME)
    camera.pos = pose[:3, 3]
    mj.mju_mat2Quat(camera.quat, np.ascontiguousarray(pose[:3, :3]).ravel())
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
    ) -> None:
        """Compiles the model.

        Args:
            table_height: Height of the surface that the arm stands on, in [m].
            table_clearance: How far links stay from it, in [m].
            self_clearance: How far links stay from each other, in [m].
            obstacles: Boxes to stay clear of.
            obstacle_clearance: By so much, in [m].
            T_flange_camera: The camera's optical frame in `link_ee`, which its body goes with. Shape (4, 4).
        """
        spec = arm_spec(table_height, obstacles, T_flange_camera)
        self._model: Any = spec.compile()
        self._data: Any = mj.MjData(self._model)
        self._model.geom_margin[:] = max(table_clearance, self_clearance, obstacle_clearance)
        self._clearances = {TABLE: table_clearance, OBSTACLE: obstacle_clearance, "link": self_clearance}
        self._names = [self._name(g) for g in range(self._model.ngeom)]
        # Links that are welded together count as one; the base is welded to the world.
        weld = self._model.body_weldid[self._model.geom_bodyid]
        parent = self._model.body_weldid[self._model.body_parentid[weld]]
        self._weld, self._parent_weld = weld, parent

    def _name(self, geom: int) -> str:
        body = self._model.geom_bodyid[geom]
        model = self._model
        return str(model.geom(geom).name if body == 0 else model.body(body).name)

    def nearest(self, joint_positions: Float64) -> Contact | None:
        """The first joint position with anything too near, and its deepest contact there.

        Args:
            joint_positions: In [rad]. Shape (N, 7).

        Returns:
            None if all are clear.
        """
        model, data = self._model, self._data
        for k, joints in enumerate(joint_positions):
            data.qpos[:] = joints
            mj.mj_kinematics(model, data)
            mj.mj_collision(model, data)
            worst: Contact | None = None
            for contact in data.contact[: data.ncon] if data.ncon else ():
                a, b = int(contact.geom[0]), int(contact.geom[1])
                if self._are_neighbours(a, b) or not contact.dist < self._needed(a, b):
                    continue
                if worst is None or contact.dist < worst.distance:
                    names = sorted(
                        (self._names[a], self._names[b]), key=lambda name: name.startswith((TABLE, OBSTACLE))
                    )
                    worst = Contact(first=names[0], second=names[1], distance=float(contact.dist), sample=k)
            if worst is not None:
                return worst
        return None

    def _are_neighbours(self, a: int, b: int) -> bool:
        """Whether two shapes belong to links with at most one joint between them."""
        if 0 in (self._model.geom_bodyid[a], self._model.geom_bodyid[b]):
            return False
        return bool(
            self._weld[a] == self._weld[b]
            or self._parent_weld[a] == self._weld[b]
            or self._parent_weld[b] == self._weld[a]
        )

    def _needed(self, a: int, b: int) -> float:
        for kind in (TABLE, OBSTACLE):
            if self._names[a].startswith(kind) or self._names[b].startswith(kind):
                return self._clearances[kind]
        return self._clearances["link"]
