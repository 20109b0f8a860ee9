"""Takes the views of a calibration: the arm moves around the board; the guard and the operator confirm each move."""

import logging
import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from maniskill_tomato.deploy.calibration.board import CharucoBoard
from maniskill_tomato.deploy.calibration.hand_eye import (
    MIN_CORNERS,
    BoardView,
    CalibrationError,
    board_pose,
)
from maniskill_tomato.deploy.calibration.view_folder import RecordedView, board_view, flange_pose, write_views
from maniskill_tomato.deploy.clock import Clock
from maniskill_tomato.deploy.deploy_errors import StoppedError
from maniskill_tomato.deploy.guarded_arm import GuardedArm
from maniskill_tomato.deploy.interface import ArmState, Camera, Float64, JointMove
from maniskill_tomato.deploy.rest import come_to_rest
from maniskill_tomato.deploy.rigid import transform
from maniskill_tomato.deploy.stops import Stops
from maniskill_tomato.errors import InvalidInputError, check_ranges
from maniskill_tomato.robot.arm_model import ArmModel
from maniskill_tomato.robot.d435 import T_flange_camera_color_optical
from maniskill_tomato.robot.inverse_kinematics import InverseKinematics, Reach
from maniskill_tomato.warp_runtime import load_kernels

logger = logging.getLogger(__name__)

Confirm = Callable[[str], bool]
"""Asks the operator about the next move; True sends it."""


@dataclass(frozen=True, kw_only=True)
class CapturePlan:
    """From where the board is looked at."""

    views: int = 15
    """Pictures to take."""
    distances: tuple[float, float] = (0.30, 0.42)
    """Nearest and farthest camera, in [m] from the middle of the board."""
    largest_tilt: float = 0.6
    """Largest angle between the line of sight and the board's normal, in [rad]."""
    largest_roll: float = 0.8
    """Largest turn of the camera about its line of sight from the first view, in [rad]."""
    turn: float = 0.0
    """Turn of the whole pattern about the board's normal, in [rad]: another one looks from other places."""
    settle_s: float = 0.7
    """Wait after a move until the arm no longer swings, in [s]."""

    def __post_init__(self) -> None:
        check_ranges(
            self,
            views=(5, 100),
            largest_tilt=(0.0, 1.0),
            largest_roll=(0.0, 3.2),
            turn=(-math.pi, math.pi),
            settle_s=(0.0, 10.0),
        )
        if not 0.1 <= self.distances[0] <= self.distances[1] <= 2.0:
            raise InvalidInputError(f"distances must rise from 0.1 to 2 m, got {self.distances}")


def camera_poses(
    board: CharucoBoard, T_base_board: Float64, T_base_camera: Float64, plan: CapturePlan
) -> Float64:
    """Poses of the camera round a board, twice as many as views are wanted: not all can be reached.

    Args:
        board: The print.
        T_base_board: Where it is. Shape (4, 4).
        T_base_camera: The first camera's optical frame, from which the others are turned as little as can be.
            Shape (4, 4).
        plan: How far and how much turned.

    Returns:
        T_base_camera of each. Shape (2 * views, 4, 4).
    """
    middle = T_base_board @ np.array([board.size[0] / 2.0, board.size[1] / 2.0, 0.0, 1.0])
    # The board's z axis goes into the print.
    x, y, normal = T_base_board[:3, 0], T_base_board[:3, 1], -T_base_board[:3, 2]
    count = 2 * plan.views
    first = Rotation.from_matrix(T_base_camera[:3, :3])
    poses = []
    for k in range(count):
        tilt = plan.largest_tilt * math.sqrt((k + 0.5) / count)
        azimuth = plan.turn + k * math.pi * (3.0 - math.sqrt(5.0))  # The golden angle spreads them evenly.
        distance = plan.distances[0] + (plan.distances[1] - plan.distances[0]) * ((k * 0.618) % 1.0)
        roll = plan.largest_roll * (2.0 * ((k * 0.755) % 1.0) - 1.0)
        sideways = math.cos(azimuth) * x + math.sin(azimuth) * y
        away = math.cos(tilt) * normal + math.sin(tilt) * sideways
        # Turned from the first view by the shortest way: "upright" means little for a camera that looks down.
        turn = Rotation.align_vectors(-away, T_base_camera[:3, 2])[0]
        rotation = turn * first * Rotation.from_rotvec([0.0, 0.0, roll])
        poses.append(transform(rotation, middle[:3] + distance * away))
    return np.asarray(poses, dtype=np.float64)


def capture_views(
    arm: GuardedArm,
    camera: Camera,
    board: CharucoBoard,
    folder: Path,
    clock: Clock,
    confirm: Confirm,
    plan: CapturePlan | None = None,
    T_flange_camera: Float64 = T_flange_camera_color_optical,
    serial: str = "",
    stops: Stops | None = None,
) -> list[RecordedView]:
    """Moves the arm round the board and takes pictures, which it writes as they come.

    Args:
        arm: Connected; the board must be in the picture.
        camera: Connected.
        board: The print.
        folder: Where pictures and `views.json` go.
        clock: The one of arm and camera.
        confirm: Asked before every move.
        plan: From where to look.
        T_flange_camera: A first guess of what is looked for. Shape (4, 4).
        serial: Of the camera.
        stops: Asked before and during every move.

    Returns:
        The views in which the board was found.

    Raises:
        CalibrationError: The board is not in the first picture.
        StoppedError: Somebody asked to stop; what was taken so far is written.
        DeployError: A device fails; what was taken so far is written.
    """
    plan, stops = plan or CapturePlan(), stops or Stops()
    kinematics = InverseKinematics(model=arm.model)
    # Compiled before the first beat, from which on the heartbeat is watched.
    load_kernels()
    views: list[RecordedView] = []

    arm.begin_run(stops.asked)

    def check_stops() -> None:
        reason = stops.beat()
        if reason is not None:
            if arm.is_under_way:
                arm.stop()
            raise StoppedError(f"stopped ({reason}) after {len(views)} views; {come_to_rest(arm)}")

    def look() -> BoardView | None:
        check_stops()
        clock.sleep(plan.settle_s)
        camera.begin_view()
        frame = camera.read(after=clock.now())
        joints = arm.read().joint_positions
        view = RecordedView(
            name=f"view_{len(views):03d}.png",
            color=frame.color,
            joint_positions=joints,
            taken=datetime.now(UTC).isoformat(timespec="seconds"),
            model=arm.model,
        )
        seen = board_view(board, view)
        if len(seen.corner_ids) < MIN_CORNERS:
            return None
        views.append(view)
        write_views(folder, views, camera.intrinsics, serial)
        return seen

    first = look()
    if first is None:
        raise CalibrationError(
            "the board is not in the picture; bring the arm to where the camera sees all of it, about 0.35 m away, "
            "and check the board's columns, rows and dictionary"
        )
    T_base_camera = first.T_base_flange @ T_flange_camera
    T_base_board = T_base_camera @ board_pose(board, first, camera.intrinsics)
    left = list(camera_poses(board, T_base_board, T_base_camera, plan) @ np.linalg.inv(T_flange_camera))
    start, at_start = views[0].joint_positions, True
    while left and len(views) < plan.views:
        k, move = _next_move(arm, kinematics, left)
        going_back = move is None and not at_start
        if going_back:
            # Poses that are out of reach of one move from here may be within one from the start.
            move = JointMove(joint_positions=start, speed_fraction=arm.safety.config.speed_fraction)
        elif move is not None:
            del left[k]
        if move is None or arm.safety.check(move, state := arm.read(), state.stamp) is not None:
            logger.warning("%d views; the other %d poses are not safe to go to", len(views), len(left))
            break
        at_start = going_back
        what = "back to the start" if going_back else f"view {len(views) + 1} of {plan.views}"
        confirmed = False
        with suppress(StoppedError), stops.waiting_for_a_person():
            confirmed = confirm(f"{what}: {_in_words(move, state, arm.model)}")
        check_stops()
        if not confirmed:
            if going_back:
                break
            continue
        with suppress(StoppedError):
            arm.command(move)
            while not arm.wait(0.2):
                check_stops()
        check_stops()
        if not going_back and look() is None:
            logger.info("the board is not in this picture; it is left out")
    return views


def _in_words(move: JointMove, state: ArmState, model: ArmModel) -> str:
    x, y, z = flange_pose(move.joint_positions, model)[:3, 3]
    turn = np.degrees(np.abs(move.joint_positions - state.joint_positions).max())
    return (
        f"flange to x {x:.3f}, y {y:.3f}, z {z:.3f} m, largest joint turn {turn:.0f} degrees, "
        f"speed {move.speed_fraction:.0%}"
    )


def _next_move(
    arm: GuardedArm, kinematics: InverseKinematics, flanges: list[Float64]
) -> tuple[int, JointMove | None]:
    """The nearest pose by joint turns that can be reached and is safe to go to, and its place in the list."""
    state = arm.read()
    solution = kinematics.solve(
        torch.from_numpy(np.array(flanges)),
        torch.from_numpy(np.tile(state.joint_positions, (len(flanges), 1))),
        neighbour=False,
    )
    turns = np.abs(solution.qpos.numpy() - state.joint_positions).max(axis=1)
    for k in np.argsort(turns).tolist():
        if int(solution.reach[k]) != Reach.REACHABLE:
            continue
        move = JointMove(
            joint_positions=solution.qpos[k].numpy(), speed_fraction=arm.safety.config.speed_fraction
        )
        if arm.safety.check(move, state, state.stamp) is None:
            return k, move
    return 0, None
