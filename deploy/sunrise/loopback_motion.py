"""A simple arm for the loopback controller: joint-linear moves with a trapezoidal speed, torques, tool pose."""

import math
import threading
import time
from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from maniskill_tomato.robot import iiwa14

FloatArray = npt.NDArray[np.float64]


def flange_pose(qpos: Sequence[float], media_flange_m: float = 0.0) -> FloatArray:
    """The flange in the base frame by modified Denavit-Hartenberg parameters.

    Args:
        qpos: Joint angles, in [rad]. Shape (7,).
        media_flange_m: How much farther out the flange of this arm lies than the plain one, in [m].

    Returns:
        The transform T_base_flange. Shape (4, 4).
    """
    pose = np.eye(4)
    for (a, alpha, d), theta in zip(iiwa14.MODIFIED_DH, qpos, strict=True):
        ca, sa, ct, st = math.cos(alpha), math.sin(alpha), math.cos(theta), math.sin(theta)
        pose = pose @ np.array(
            [
                [ct, -st, 0.0, a],
                [st * ca, ct * ca, -sa, -d * sa],
                [st * sa, ct * sa, ca, d * ca],
                [0.0, 0.0, 0.0, 1.0],
            ]
        )
    pose[:3, 3] += pose[:3, 2] * media_flange_m
    return pose


def transform_from_xyzabc(values: Sequence[float]) -> FloatArray:
    """The transform of x, y, z [mm] and A, B, C [rad], R = Rz(A) Ry(B) Rx(C). Shape (4, 4), in [m]."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("ZYX", values[3:]).as_matrix()
    pose[:3, 3] = np.array(values[:3]) / 1000.0
    return pose


def xyzabc_from_transform(pose: FloatArray) -> list[float]:
    """x, y, z [mm] and A, B, C [rad] of a transform in [m]. Shape (6,)."""
    turns = Rotation.from_matrix(pose[:3, :3]).as_euler("ZYX")
    return [*(1000.0 * pose[:3, 3]).tolist(), *turns.tolist()]


class SimulatedArm:
    """Seven joints that move on straight lines in joint space.

    Safe to read from one thread while another moves it.
    """

    def __init__(self, qpos: Sequence[float], speedup: float = 1.0) -> None:
        """Starts at rest.

        Args:
            qpos: Joint angles, in [rad]. Shape (7,).
            speedup: How much faster than a real arm it moves.
        """
        self._lock = threading.Lock()
        self._qpos = [float(q) for q in qpos]
        self._speedup = speedup
        self.external_torque = [0.0] * 7
        """What pushes on each joint, in [N m]; tests set it. Shape (7,)."""
        self.disobeys = ""
        """How it moves otherwise than told: `hurry`, `stray`, `stall`, `crawl`, or not at all."""
        self.strays_by = 0.0
        """How far joint 7 leaves the path, in [rad]."""

    @property
    def qpos(self) -> list[float]:
        """Joint angles, in [rad]. Shape (7,)."""
        with self._lock:
            return list(self._qpos)

    def move(self, target: Sequence[float], relative_speed: float, keep_going: Callable[[], bool]) -> None:
        """Moves all joints together, until there or until `keep_going` says no.

        Args:
            target: Joint angles, in [rad]. Shape (7,).
            relative_speed: Share of the largest joint speeds.
            keep_going: Asked every 2 ms.
        """
        start = np.array(self.qpos)
        change = np.array(target, dtype=np.float64) - start
        if not np.any(change):
            return
        relative_speed = {"hurry": 1.0, "crawl": relative_speed / 20.0}.get(self.disobeys, relative_speed)
        speed = float(np.min(iiwa14.VELOCITY_LIMITS * relative_speed / np.maximum(np.abs(change), 1e-12)))
        acceleration = float(np.min(iiwa14.ACCELERATION_LIMITS / np.maximum(np.abs(change), 1e-12)))
        speed = min(speed, math.sqrt(acceleration))  # Shares of the path a second.
        ramp = speed / acceleration
        duration = 1.0 / speed + ramp
        began = time.monotonic()
        while keep_going():
            t = min((time.monotonic() - began) * self._speedup, duration)
            if t < ramp:
                share = 0.5 * acceleration * t * t
            elif t < duration - ramp:
                share = speed * (t - 0.5 * ramp)
            else:
                share = 1.0 - 0.5 * acceleration * (duration - t) ** 2
            if self.disobeys == "stall":
                share, t = min(share, 0.5), 0.0
            qpos = start + share * change
            if self.disobeys == "stray":
                qpos[6] += self.strays_by * math.sin(math.pi * share) ** 2
            with self._lock:
                self._qpos = qpos.tolist()
            if t >= duration:
                return
            time.sleep(0.002)
