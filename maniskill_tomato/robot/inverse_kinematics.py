"""Inverse kinematics of an arm, closed form and batched: reachable, neighbour or unreachable.

The arm (`arm_model`; the iiwa 14 unless another is named) is spherical-rotational-spherical, so that its joint
angles follow from a pose and one arm angle, and the arm angles that keep the joint limits form intervals whose ends
are known in closed form: a pose is reachable or not, and nothing can fail to converge. `ik_circle` has the geometry,
`ik_select` the choice among the feasible arm angles, `ik_neighbour` the nearest reachable pose.

It runs as one Warp kernel in double precision, on the CPU and on CUDA, with torch tensors in and out. Written
in torch operations it would need some hundreds of them, so that starting them alone would take milliseconds
for a single pose, where the kernel takes tens of microseconds.
"""

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import torch
import warp as wp

from maniskill_tomato.errors import InvalidInputError, check_ranges
from maniskill_tomato.robot import ik_neighbour, ik_select, ik_solve
from maniskill_tomato.robot.arm_model import NUM_JOINTS, ArmModel
from maniskill_tomato.robot.iiwa14 import IIWA14
from maniskill_tomato.robot.ik_chain import chain_of, vec7d
from maniskill_tomato.warp_runtime import BatchKernel, start_warp


class Reach(IntEnum):
    """What the arm can do about a pose."""

    REACHABLE = 0
    """It reaches the pose."""
    NEIGHBOUR = 1
    """It reaches a pose nearby, which is taken instead."""
    UNREACHABLE = 2
    """It reaches nothing nearby and stays where it is."""


@dataclass(frozen=True, kw_only=True)
class IkConfig:
    """Options of the inverse kinematics."""

    limit_margin: float = 0.25
    """Distance from a joint limit at which it begins to cost, in [rad] (14 degrees)."""
    limit_weight: float = 0.25
    """Cost of a joint that stands at its limit, in [rad^2]: as much as moving one joint by 0.5 rad."""
    tolerance: float = 1e-6
    """How far outside the workspace a pose may be, in [m] and [rad]; poses in single precision need it.

    Poses inside are reached to rounding (1e-14). Of those taken by this tolerance, the ones where several joints
    are singular and on their limits at once are reached to 50 times as much.
    """
    neighbour_distance: float = 0.05
    """Largest distance of a neighbour pose, in [m]."""
    neighbour_angle: float = math.radians(10.0)
    """Largest angle between a neighbour pose and the pose asked for, in [rad]."""

    def __post_init__(self) -> None:
        check_ranges(
            self,
            limit_margin=(1e-6, 1.5),
            limit_weight=(0.0, 1e3),
            tolerance=(1e-10, 1e-3),
            neighbour_distance=(1e-6, 0.5),
            neighbour_angle=(1e-6, 1.5),
        )


@dataclass(frozen=True)
class IkSolution:
    """What the arm can do about a batch of poses."""

    qpos: torch.Tensor
    """Joint angles within the limits, in [rad]; the reference where unreachable. Shape (B, 7), float64."""
    reach: torch.Tensor
    """Values of `Reach`. Shape (B,), int64."""
    T_base_ee: torch.Tensor
    """The pose that `qpos` gives, in the base frame, in [m]. Shape (B, 4, 4), float64."""
    all_reachable: bool
    """Whether all poses are REACHABLE: told here since the solver asks the device once anyway."""


class InverseKinematics:
    """Solves for joint angles on one device; not for use from several threads at once."""

    def __init__(
        self,
        device: str | torch.device = "cpu",
        config: IkConfig | None = None,
        model: ArmModel = IIWA14,
    ) -> None:
        """Keeps the options; the kernel is compiled at the first solve on a machine.

        Args:
            device: The torch device of the inputs and results.
            config: Options, the defaults if None.
            model: Of the arm. Joints are kept within its `symmetric_limits`.
        """
        start_warp()
        self.device = torch.device(device)
        if self.device.type == "cuda" and self.device.index is None:
            self.device = torch.device("cuda", torch.cuda.current_device())
        self.config = config or IkConfig()
        flips = model.flips
        self._flips = None if flips is None else torch.tensor(flips, device=self.device)
        weights: Any = ik_select.Weights()
        weights.margin = self.config.limit_margin
        weights.limit_weight = self.config.limit_weight
        solver: Any = ik_solve.Solver()
        solver.chain, solver.weights = chain_of(model), weights
        solver.tolerance = self.config.tolerance
        self.solver = solver
        """The same as kernels see it. They turn joints as the chain does: see `chain_joints`."""
        allowed: Any = ik_neighbour.Allowed()
        allowed.distance = self.config.neighbour_distance
        allowed.angle = self.config.neighbour_angle
        pose, joints = ((4, 4), torch.float64, wp.mat44d), ((NUM_JOINTS,), torch.float64, vec7d)
        self._kernels = {
            neighbour: BatchKernel(
                ik_solve.solve_kernel,
                inputs=[pose, joints],
                constants=[solver, int(neighbour), allowed],
                outputs=[joints, ((), torch.int64, wp.int64), pose],
            )
            for neighbour in (False, True)
        }

    def solve(self, T_base_ee: torch.Tensor, qpos_ref: torch.Tensor, neighbour: bool = True) -> IkSolution:
        """Joint angles that bring the end effector to a pose, the best ones by the cost of `ik_select`.

        The cost is the squared distance from `qpos_ref`, in [rad^2], plus a penalty within `limit_margin` of
        each joint limit. For the pose that the reference itself takes, away from limits, it is the reference.

        Args:
            T_base_ee: Poses of `link_ee` in the base frame, in [m], float32 or float64; rotations off by
                rounding are put right. Shape (B, 4, 4).
            qpos_ref: Joint angles to stay near to, usually where the arm stands, in [rad]. Shape (B, 7).
            neighbour: Whether to take the nearest reachable pose within `neighbour_distance` and
                `neighbour_angle` for one that is not reachable.

        Returns:
            Joint angles, what kind of solution each is, and the poses they give.

        Raises:
            InvalidInputError: A shape, type or device does not fit, a value is not finite, or a pose is not
                rigid.
        """
        batch = T_base_ee.shape[0] if T_base_ee.dim() == 3 else 0
        if T_base_ee.shape != (batch, 4, 4) or not T_base_ee.is_floating_point():
            raise InvalidInputError(
                "T_base_ee must be a floating-point tensor of shape (B, 4, 4); "
                f"got {T_base_ee.dtype} of shape {tuple(T_base_ee.shape)}"
            )
        if qpos_ref.shape != (batch, NUM_JOINTS) or not qpos_ref.is_floating_point():
            raise InvalidInputError(
                f"qpos_ref must be a floating-point tensor of shape ({batch}, {NUM_JOINTS}), a row per pose; "
                f"got {qpos_ref.dtype} of shape {tuple(qpos_ref.shape)}"
            )
        if T_base_ee.device != self.device or qpos_ref.device != self.device:
            raise InvalidInputError(
                f"T_base_ee and qpos_ref must be on {self.device}; "
                f"got {T_base_ee.device} and {qpos_ref.device}"
            )
        if batch == 0:
            reach = torch.zeros(0, dtype=torch.int64, device=self.device)
            return IkSolution(qpos_ref.double(), reach, T_base_ee.double(), all_reachable=True)
        qpos, reach, reached = self._kernels[neighbour](T_base_ee, self.chain_joints(qpos_ref))
        lowest, highest = torch.stack(reach.aminmax()).tolist()
        if lowest < 0:
            row = int(reach.argmin())
            raise InvalidInputError(
                "T_base_ee must hold finite rigid transforms (rotation, position, last row 0 0 0 1) and "
                f"qpos_ref finite angles; row {row} has T_base_ee = {T_base_ee[row].tolist()}, "
                f"qpos_ref = {qpos_ref[row].tolist()}"
            )
        return IkSolution(
            self.chain_joints(qpos.clone()),
            reach.clone(),
            reached.clone(),
            all_reachable=highest == Reach.REACHABLE,
        )

    def chain_joints(self, qpos: torch.Tensor) -> torch.Tensor:
        """Joint angles of the arm as the chain counts them, and the reverse. Shape (B, 7)."""
        return qpos if self._flips is None else qpos * self._flips
