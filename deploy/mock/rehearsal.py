"""The twin's camera on the arm of a loopback controller: a whole run over a real driver without arm or camera."""

from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np

from maniskill_tomato.deploy.capture import CaptureConfig
from maniskill_tomato.deploy.clock import MonotonicClock
from maniskill_tomato.deploy.drivers import DriverContext, make_arm, make_camera
from maniskill_tomato.deploy.guarded_arm import GuardedArm
from maniskill_tomato.deploy.interface import Float64
from maniskill_tomato.deploy.mock.twin_world import twin_options, twin_world
from maniskill_tomato.deploy.profile import Profile, TargetConfig
from maniskill_tomato.deploy.robot_perception import TruthPerception
from maniskill_tomato.deploy.run_records import LoopConfig
from maniskill_tomato.deploy.safety import Safety
from maniskill_tomato.deploy.safety_config import SafetyConfig
from maniskill_tomato.deploy.workcell import Workcell
from maniskill_tomato.robot.d435 import T_flange_camera_color_optical

TWIN: Final = {"width": 160, "height": 120, "depth_noise": 0.0}
"""Small exact pictures."""


class _CarryingArm:
    """In the twin's world, another arm instead of MuJoCo's."""

    moving = False

    def __init__(self, joints: Callable[[], Float64]) -> None:
        self._joints = joints

    @property
    def joint_positions(self) -> Float64:
        return np.array(self._joints())

    @property
    def joint_velocities(self) -> Float64:
        return np.zeros(7)

    def advance(self, time: float) -> None:
        pass


def rehearsal(
    driver: str,
    options: Mapping[str, Any],
    joints: Callable[[], Float64],
    seed: int,
    max_moves: int,
    speed_fraction: float = 0.1,
) -> Workcell:
    """A workcell of a driver whose controller is a loopback, and of the twin's camera. Nothing real moves.

    Args:
        driver: Of the arm.
        options: How it reaches the loopback.
        joints: Where the loopback's arm is, in [rad]; shape (7,).
        seed: The twin's held-out episode, in whose start posture the loopback's arm should stand.
        max_moves: Of a run.
        speed_fraction: Share of the joints' largest speeds.
    """
    clock = MonotonicClock()
    context = DriverContext(clock=clock, seed=seed)
    world: Any = twin_world(twin_options(TWIN), context)
    world.arm = _CarryingArm(joints)
    x, y, z = world.episode.target_position.tolist()
    profile = Profile(
        name="rehearsal",
        text="",
        description="",
        arm_driver=driver,
        arm_options=dict(options),
        camera_driver="mock",
        camera_options=TWIN,
        T_flange_camera=T_flange_camera_color_optical,
        T_drawing=T_flange_camera_color_optical,
        target=TargetConfig(source="given", position=(x, y, z)),
        safety=SafetyConfig(speed_fraction=speed_fraction, max_state_age=10.0, max_frame_age=60.0),
        loop=LoopConfig(max_moves=max_moves),
        capture=CaptureConfig(max_age=5.0),
    )
    arm, camera = make_arm(driver, options, context), make_camera("mock", TWIN, context)
    arm.simulated = True
    return Workcell(
        profile=profile,
        clock=clock,
        arm=arm,
        camera=camera,
        guarded_arm=GuardedArm(arm, Safety(profile.safety, model=arm.model), clock),
        perception=TruthPerception(),
    )
