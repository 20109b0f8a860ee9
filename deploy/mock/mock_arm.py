"""The twin's arm behind the `Arm` interface, with optional faults."""

import contextlib
from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from maniskill_tomato.deploy.deploy_errors import (
    DeployError,
    DeviceTimeoutError,
    NotConnectedError,
    RefusedError,
)
from maniskill_tomato.deploy.drivers import DriverContext
from maniskill_tomato.deploy.interface import Arm, ArmState, Float64, JointMove
from maniskill_tomato.deploy.mock.dynamics import duration
from maniskill_tomato.deploy.mock.twin_world import ArmFault, Faults, TwinWorld, twin_options, twin_world

TICK: Final = 0.02
"""How often `wait` looks at the arm, in [s]."""

SLOWNESS: Final = 20.0
"""Of a slow arm."""


class MockArm(Arm):
    """An arm that MuJoCo moves."""

    name = "mock"
    simulated = True
    can_stop = True

    def __init__(self, world: TwinWorld, faults: Faults) -> None:
        self.model = world.model
        self._world = world
        self._faults = faults
        self._connected = False
        self._commands = 0

    @property
    def is_connected(self) -> bool:
        return self._connected

    def connect(self) -> None:
        self._connected = True

    def disconnect(self) -> None:
        self._connected = False

    def describe(self) -> dict[str, Any]:
        episode = self._world.episode
        return {
            "driver": self.name,
            "model": self.model.name,
            "plant_seed": episode.plant.seed,
            "target": episode.target,
        }

    def read(self, max_age_s: float = 0.5) -> ArmState:
        self._check()
        now = self._world.advance()
        arm = self._world.arm
        joints, speeds = arm.joint_positions, arm.joint_velocities
        fault = self._fault()
        if fault == "silent":
            self._world.clock.sleep(1.0)
            raise DeviceTimeoutError("the arm did not answer within 1 s")
        if fault == "nan":
            joints[3] = np.nan
        if fault == "jump":
            joints[1] += 0.4
        return ArmState(joint_positions=joints, joint_velocities=speeds, stamp=now)

    def command(self, move: JointMove) -> JointMove:
        self._check()
        self._world.advance()
        if self._world.arm.moving:
            raise RefusedError("busy: the arm is moving")
        self._commands += 1
        fault = self._fault()
        if fault == "refuse":
            raise RefusedError("the controller did not take the move (nak)")
        if fault != "stuck":
            slowness = SLOWNESS if fault == "slow" else 1.0
            self._world.arm.start(move.joint_positions, move.speed_fraction, slowness)
        return move

    def move_seconds(self, turn: Float64, speed_fraction: float) -> float:
        return duration(turn, speed_fraction, self.model)

    def wait(self, timeout_s: float) -> bool:
        self._check()
        clock, arm = self._world.clock, self._world.arm
        deadline = self._world.advance() + timeout_s
        while arm.moving and clock.now() < deadline:
            clock.sleep(TICK)
            self._world.advance()
            if self._fault() == "drop":
                arm.halt()  # As an iiwa does without its client's next move: it ends, here at once.
                self._connected = False
                raise NotConnectedError("the connection to the arm broke during the move")
        return not arm.moving

    def stop(self) -> bool:
        with contextlib.suppress(DeployError):  # A clock that runs backwards.
            self._world.advance()
        if self._world.arm.moving:
            self._world.arm.halt()
        return True

    def _fault(self) -> ArmFault | None:
        return self._faults.arm if self._commands > self._faults.arm_from_move else None

    def _check(self) -> None:
        if not self._connected:
            raise NotConnectedError("the arm is not connected; call connect() first")


def make_arm(options: Mapping[str, Any], context: DriverContext) -> MockArm:
    """The twin's arm; `options` are those of `[twin]`."""
    twin = twin_options(options)
    return MockArm(twin_world(twin, context), twin.faults)
