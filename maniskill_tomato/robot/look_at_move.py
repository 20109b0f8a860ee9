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
from maniskill_tomato.robot.inverse_kinematics import InverseKinematics, Reach
from maniskill_tomato.robot.look_at import CAMERA_ROLLS, look_at_pose, look_frame
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
        device = self._inverse_kinematics.device
        inverse = np.asarray(np.linalg.inv(T_flange_camera), dtype=np.float64)
        self._T_camera_flange = torch.as_tensor(inverse, dtype=torch.float64, device=device)
        self._rolls = torch.tensor(CAMERA_ROLLS, dtype=torch.float64, device=device)
        # Upright first, then 30 degrees to either side, 60, ...; between the two sides the joints decide.
        self._rank = (self._rolls.abs() * (180.0 / torch.pi / 30.0)).round()
        vector, pose = ((3,), torch.float64, wp.vec3d), ((4, 4), torch.float64, wp.mat44d)
        mount: Any = wp.mat44d(*inverse.ravel())
        self._upright_move = BatchKernel(
            look_at_kernels.upright_move,
            inputs=[vector, vector, vector],
            constants=[wp.float64(MAX_MOVE), wp.float64(MIN_DISTANCE), mount],
            outputs=[pose, pose],
        )
        self._shares = torch.tensor(MOVE_SHARES, dtype=torch.float64, device=device)

    def move(self, qpos: Tensor, position: Tensor, target: Tensor, action: Tensor) -> LookAtMove:
        """Moves the camera and looks at the target.

        Args:
            qpos: Joint positions, in [rad]. Shape (B, 7).
            position: Where the camera stands, world frame, in [m]. Shape (B, 3).
            target: What it looks at, world frame, in [m]. Shape (B, 3).
            action: As for `moved_position`. Shape (B, 3).

        Raises:
            InvalidInputError: A tensor has the wrong shape.
        """
        _check_rows(qpos=(qpos, NUM_JOINTS), position=(position, 3), target=(target, 3), action=(action, 3))
        qpos, position, target = qpos.double(), position.double(), target.double()
        T_world_camera, T_world_flange = (T.clone() for T in self._upright_move(position, target, action))
        solution = self._inverse_kinematics.solve(T_world_flange, qpos, neighbour=False)
        near = (solution.qpos - qpos).abs().amax(-1) <= LARGEST_JOINT_STEP
        fits = (solution.reach == int(Reach.REACHABLE)) & near & keeps_clear(T_world_flange)
        if bool(fits.all()):
            return LookAtMove(solution.qpos, solution.reach, T_world_camera)
        goal = T_world_camera[:, :3, 3]
        upright = self.look_from(qpos, goal, target, rolls=1)
        rows = (upright.reach != Reach.REACHABLE).nonzero()[:, 0]
        shares = self._shares[:, None, None]
        goals = torch.lerp(position[rows], goal[rows], shares)
        away = goals - target[rows]
        # The straight way between two positions outside the smallest distance may lead through it.
        distance = away.norm(dim=-1, keepdim=True).clamp_min(1e-6)
        goals = target[rows] + away / distance * distance.clamp_min(MIN_DISTANCE)
        out, reach, T = upright.qpos.clone(), upright.reach.clone(), upright.T_world_camera.clone()
        open_rows = torch.ones(len(rows), dtype=torch.bool, device=qpos.device)
        for k in range(len(MOVE_SHARES)):
            tried = self.look_from(qpos[rows], goals[k], target[rows])
            new = open_rows & (tried.reach == Reach.REACHABLE)
            out[rows[new]], T[rows[new]] = tried.qpos[new], tried.T_world_camera[new]
            reach[rows[new]] = int(Reach.REACHABLE if k == 0 else Reach.NEIGHBOUR)
            open_rows = open_rows & ~new
            if not bool(open_rows.any()):
                break
        return LookAtMove(out, reach, T)

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
        rolls = len(CAMERA_ROLLS) if rolls is None else rolls
        b = len(qpos)
        T_world_camera = look_at_pose(position[:, None], target[:, None], self._rolls[:rolls])
        T_world_flange = (T_world_camera @ self._T_camera_flange).reshape(-1, 4, 4)
        reference = qpos.double()[:, None].expand(b, rolls, NUM_JOINTS)
        solution = self._inverse_kinematics.solve(
            T_world_flange, reference.reshape(-1, NUM_JOINTS), neighbour=False
        )
        solved = solution.qpos.reshape(b, rolls, NUM_JOINTS)
        step = (solved - reference).abs()
        fits = (solution.reach == int(Reach.REACHABLE)) & keeps_clear(T_world_flange)
        fits = fits.reshape(b, rolls) & (step.amax(-1) <= largest_joint_step)
        # The joints' share of the cost stays below 1, so that it decides between the two sides only.
        cost = self._rank[:rolls] + step.sum(-1) / 100.0
        best = torch.where(fits, cost, torch.inf).argmin(-1)
        every = torch.arange(b, device=qpos.device)
        found = fits[every, best]
        reach = torch.where(found, int(Reach.REACHABLE), int(Reach.UNREACHABLE))
        taken = torch.where(found[:, None], solved[every, best], qpos.double())
        T = torch.where(found[:, None, None], T_world_camera[every, best], T_world_camera[:, 0])
        return LookAtMove(taken, reach, T)


def _check_rows(**tensors: tuple[Tensor, int]) -> None:
    batch = len(next(iter(tensors.values()))[0])
    for name, (tensor, width) in tensors.items():
        if tuple(tensor.shape) != (batch, width):
            raise InvalidInputError(f"{name} must have shape ({batch}, {width}), got {tuple(tensor.shape)}")
