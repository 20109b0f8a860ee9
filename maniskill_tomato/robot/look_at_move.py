"""One move of the camera about its target: a translation in the look frame, then look at the target again.

    mover = LookAtMover()
    move = mover.move(qpos, T_world_camera[:, :3, 3], target_position, action)
    move.qpos, move.reach, move.T_world_camera

The optical axis must point at the target, but the picture may turn about it: of several such rolls the first that the
arm reaches is taken, upright first. Where none is reached the move is shortened, then refused. Simulation and robot
share this module.
"""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import torch
import warp as wp
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.robot import look_at_kernels
from maniskill_tomato.robot.arm_model import NUM_JOINTS, ArmModel
from maniskill_tomato.robot.d435 import T_flange_camera_color_optical
from maniskill_tomato.robot.iiwa14 import IIWA14
from maniskill_tomato.robot.ik_chain import vec7d
from maniskill_tomato.robot.inverse_kinematics import InverseKinematics
from maniskill_tomato.robot.look_at import CAMERA_ROLLS, look_frame
from maniskill_tomato.warp_runtime import BatchKernel

MAX_MOVE: Final = 0.12
"""Length of the move that an action of norm 1 asks for, in [m]."""

MIN_DISTANCE: Final = 0.2
"""The camera is kept this far from its target, in [m]."""

MOVE_SHARES: Final = (1.0, 0.5, 0.25)
"""Shares of a move that are tried, in this order."""

LOWEST_FLANGE: Final = 0.15
"""The flange is kept this high above the floor, in [m] (Eq. 5-4's forbidden zone)."""

BASE_BOX: Final = (0.3, 0.3, 0.25)
"""The flange is kept out of |x|, |y|, z below these around the robot's base, in [m] (Eq. 5-4)."""

LARGEST_JOINT_STEP: Final = 1.5
"""No joint turns farther than this in one move, in [rad]: the arm does not swing to another of its postures."""


@dataclass(frozen=True, eq=False)
class LookAtMove:
    """What comes of a move."""

    qpos: Tensor
    """Joint positions to go to, in [rad]; those given where the move is refused. Shape (B, 7), float64."""
    reach: Tensor
    """`Reach`: REACHABLE in full, NEIGHBOUR shortened, UNREACHABLE refused. Shape (B,), int64."""
    T_world_camera: Tensor
    """Where the optical frame is then. Shape (B, 4, 4), float64."""


def moved_position(position: Tensor, target: Tensor, action: Tensor) -> Tensor:
    """Where an action sends the camera.

    Args:
        position: Where the camera stands, world frame, in [m]. Shape (..., 3).
        target: What it looks at, world frame, in [m]. Shape (..., 3).
        action: Right, up, forward, 1 meaning `MAX_MOVE`; longer ones are cut to norm 1. Shape (..., 3).

    Returns:
        The new position, at least `MIN_DISTANCE` from the target. Shape (..., 3).
    """
    move = action * (MAX_MOVE / action.norm(dim=-1, keepdim=True).clamp_min(1.0))
    frame = look_frame(position, target)
    away = position + (frame @ move[..., None])[..., 0] - target
    distance = away.norm(dim=-1, keepdim=True)
    # A move onto the target itself has no direction; the camera then stays on the side that it comes from.
    outward = torch.where(distance > 1e-6, away / distance.clamp_min(1e-6), -frame[..., 2])
    moved: Tensor = target + outward * distance.clamp_min(MIN_DISTANCE)
    return moved


def keeps_clear(T_world_flange: Tensor) -> Tensor:
    """Whether flange poses keep off the floor and the robot's base. Shape (..., 4, 4) to (...), bool."""
    position = T_world_flange[..., :3, 3]
    near_base = (position.abs() < position.new_tensor(BASE_BOX)).all(-1)
    return (position[..., 2] >= LOWEST_FLANGE) & ~near_base


def look_rules(
    device: str | torch.device,
    T_flange_camera: npt.NDArray[np.float64] = T_flange_camera_color_optical,
    model: ArmModel = IIWA14,
) -> Any:
    """What looks and moves keep, as kernels see it: a `look_at_kernels.Rules`.

    Args:
        device: Where the kernels run.
        T_flange_camera: The camera's optical frame in `link_ee`. Shape (4, 4).
        model: Of the arm.
    """
    rules: Any = look_at_kernels.Rules()
    rules.solver = InverseKinematics(device=device, model=model).solver
    rules.T_camera_flange = wp.mat44d(*np.linalg.inv(T_flange_camera).ravel())
    rules.max_move, rules.min_distance = MAX_MOVE, MIN_DISTANCE
    rules.lowest_flange, rules.base_box = LOWEST_FLANGE, wp.vec3d(*BASE_BOX)
    rules.rolls, rules.largest_joint_step = len(CAMERA_ROLLS), LARGEST_JOINT_STEP
    return rules


class LookAtMover:
    """Solves moves on one device; not for use from several threads at once."""

    def __init__(
        self,
        device: str | torch.device = "cpu",
        T_flange_camera: npt.NDArray[np.float64] = T_flange_camera_color_optical,
        model: ArmModel = IIWA14,
    ) -> None:
        """Prepares the inverse kinematics.

        Args:
            device: Where tensors live.
            T_flange_camera: The camera's optical frame in `link_ee`, such as a calibration found it. Shape (4, 4).
            model: Of the arm.
        """
        self._inverse_kinematics = InverseKinematics(device=device, model=model)
        self.rules = rules = look_rules(device, T_flange_camera, model)
        """The same as kernels see it."""
        joints, vector = ((NUM_JOINTS,), torch.float64, vec7d), ((3,), torch.float64, wp.vec3d)
        whole, pose = ((), torch.int64, wp.int64), ((4, 4), torch.float64, wp.mat44d)
        self._move = BatchKernel(
            look_at_kernels.move_kernel,
            inputs=[joints, vector, vector, vector],
            constants=[rules],
            outputs=[joints, whole, pose],
        )
        self._look = BatchKernel(
            look_at_kernels.look_kernel,
            inputs=[joints, vector, vector, ((), torch.float64, wp.float64), ((), torch.int32, wp.int32)],
            constants=[rules],
            outputs=[joints, whole, pose],
        )

    def move(self, qpos: Tensor, position: Tensor, target: Tensor, action: Tensor) -> LookAtMove:
        """Moves the camera and looks at the target.

        Args:
            qpos: Joint positions, in [rad]. Shape (B, 7).
            position: Where the camera stands, world frame, in [m]. Shape (B, 3).
            target: What it looks at, world frame, in [m]. Shape (B, 3).
            action: As for `moved_position`. Shape (B, 3).

        Raises:
            InvalidInputError: A tensor has the wrong shape, or a number is not finite.
        """
        _check_rows(qpos=(qpos, NUM_JOINTS), position=(position, 3), target=(target, 3), action=(action, 3))
        return self._made(self._move(self.chain_joints(qpos), position, target, action))

    def look_from(
        self,
        qpos: Tensor,
        position: Tensor,
        target: Tensor,
        rolls: int | None = None,
        largest_joint_step: float = LARGEST_JOINT_STEP,
    ) -> LookAtMove:
        """Looks at the target from positions of the camera, without shortening anything.

        Args:
            qpos: Joint positions to stay near to, in [rad]. Shape (B, 7).
            position: Where the camera shall stand, world frame, in [m]. Shape (B, 3).
            target: What it shall look at, world frame, in [m]. Shape (B, 3).
            rolls: How many of `CAMERA_ROLLS` are tried, all if None.
            largest_joint_step: A pose for which a joint would turn farther from `qpos` is not taken, in [rad].

        Returns:
            REACHABLE or UNREACHABLE; where unreachable, `T_world_camera` is the pose asked for, upright.
        """
        _check_rows(qpos=(qpos, NUM_JOINTS), position=(position, 3), target=(target, 3))
        rolls = len(CAMERA_ROLLS) if rolls is None else rolls
        steps = torch.full((len(qpos),), largest_joint_step, dtype=torch.float64, device=qpos.device)
        return self._made(
            self._look(self.chain_joints(qpos), position, target, steps, torch.full_like(steps, rolls))
        )

    def chain_joints(self, qpos: Tensor) -> Tensor:
        """Joint positions as kernels count them, and the reverse. Shape (B, 7)."""
        return self._inverse_kinematics.chain_joints(qpos)

    def _made(self, outputs: tuple[Tensor, ...]) -> LookAtMove:
        qpos, reach, T_world_camera = outputs
        if bool((reach < 0).any()):
            row = int(reach.argmin())
            raise InvalidInputError(
                f"joints, positions and actions must be finite; row {row} holds one that is not"
            )
        return LookAtMove(self.chain_joints(qpos.clone()), reach.clone(), T_world_camera.clone())


def _check_rows(**tensors: tuple[Tensor, int]) -> None:
    batch = len(next(iter(tensors.values()))[0])
    for name, (tensor, width) in tensors.items():
        if tuple(tensor.shape) != (batch, width):
            raise InvalidInputError(f"{name} must have shape ({batch}, {width}), got {tuple(tensor.shape)}")
