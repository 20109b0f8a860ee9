"""The twin's arm: MuJoCo on its URDF, driven along minimum-jerk moves by computed torques."""

from typing import Any, Final

import mujoco
import numpy as np

from maniskill_tomato.deploy.arm_shapes import arm_shapes
from maniskill_tomato.deploy.interface import Float64
from maniskill_tomato.robot.arm_model import NUM_JOINTS, ArmModel
from maniskill_tomato.robot.d435 import T_flange_camera_color_optical
from maniskill_tomato.robot.iiwa14 import IIWA14

mj: Any = mujoco

TIME_STEP: Final = 0.002
"""Of the simulation, in [s]."""

PEAK_SPEED: Final = 1.875
"""Largest speed of a minimum-jerk profile over its mean speed."""
PEAK_ACCELERATION: Final = 5.7735
"""Largest acceleration of it over distance by duration squared (10 / sqrt(3))."""

SETTLING: Final = 0.3
"""The arm is held this long after a move before it reports that it has arrived, in [s]."""

BANDWIDTH: Final = 40.0
"""Of the position control, critically damped, in [rad/s]."""


def duration(turn: Float64, speed_fraction: float, model: ArmModel = IIWA14) -> float:
    """How long a move takes, without the settling, in [s].

    Args:
        turn: How far each joint turns, in [rad]. Shape (7,).
        speed_fraction: Share of the joints' largest speeds.
        model: Of the arm.
    """
    by_speed = PEAK_SPEED * np.abs(turn) / (speed_fraction * model.velocity_limits)
    by_acceleration = np.sqrt(PEAK_ACCELERATION * np.abs(turn) / (speed_fraction * model.acceleration_limits))
    return float(max(by_speed.max(), by_acceleration.max()))


class ArmDynamics:
    """Joint positions and velocities over time, with the joints' torque limits; self-collision is `safety`'s part."""

    def __init__(self, start_joints: Float64, model: ArmModel = IIWA14) -> None:
        self._arm = model
        spec = arm_shapes(model, T_flange_camera_color_optical)
        for geom in spec.geoms:
            geom.contype, geom.conaffinity = 0, 0
        self._model: Any = spec.compile()
        self._model.opt.timestep = TIME_STEP
        self._data: Any = mj.MjData(self._model)
        self._data.qpos[:] = start_joints
        mj.mj_forward(self._model, self._data)
        self._start = self._goal = np.array(start_joints, dtype=np.float64)
        self._began = 0.0
        self._duration = 0.0

    @property
    def time(self) -> float:
        """How long it has been simulated, in [s]."""
        return float(self._data.time)

    @property
    def joint_positions(self) -> Float64:
        """In [rad]. Shape (7,)."""
        return np.array(self._data.qpos, dtype=np.float64)

    @property
    def joint_velocities(self) -> Float64:
        """In [rad/s]. Shape (7,)."""
        return np.array(self._data.qvel, dtype=np.float64)

    @property
    def moving(self) -> bool:
        """Whether a move has not ended or the arm still settles."""
        return self.time < self._began + self._duration + (SETTLING if self._duration else 0.0)

    def start(self, goal: Float64, speed_fraction: float, slowness: float = 1.0) -> float:
        """Begins a move from where the arm is sent now; how long it will take, in [s]."""
        self._start, self._goal = self._goal.copy(), np.array(goal, dtype=np.float64)
        self._began = self.time
        self._duration = slowness * max(
            duration(self._goal - self._start, speed_fraction, self._arm), TIME_STEP
        )
        return self._duration

    def halt(self) -> None:
        """Stops and holds the position of now."""
        self._start = self._goal = self.joint_positions
        self._began, self._duration = self.time, 0.2

    def advance(self, time: float) -> None:
        """Simulates up to a moment, in [s]."""
        while self._data.time < time - 0.5 * TIME_STEP:
            if not self.moving and float(np.abs(self._data.qvel).max()) < 1e-6:
                self._data.time = time  # It stands still until then.
                return
            self._step()

    def _step(self) -> None:
        model, data = self._model, self._data
        s = min(1.0, max(0.0, (data.time + TIME_STEP - self._began) / max(self._duration, TIME_STEP)))
        way, span = self._goal - self._start, max(self._duration, TIME_STEP)
        wanted = self._start + way * (s**3 * (10.0 - 15.0 * s + 6.0 * s**2))
        speed = way * (30.0 * s**2 * (1.0 - s) ** 2) / span
        push = way * (60.0 * s * (1.0 - s) * (1.0 - 2.0 * s)) / span**2
        push = push + BANDWIDTH**2 * (wanted - data.qpos) + 2.0 * BANDWIDTH * (speed - data.qvel)
        mj.mj_step1(model, data)
        torque = np.zeros(NUM_JOINTS)
        mj.mj_mulM(model, data, torque, push)
        torque += data.qfrc_bias
        data.qfrc_applied[:] = np.clip(torque, -self._arm.torque_limits, self._arm.torque_limits)
        mj.mj_step2(model, data)
