"""Which camera positions the arm can take while the camera looks at a target."""

import numpy as np
import numpy.typing as npt
import torch
import warp as wp
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.robot import look_at_kernels
from maniskill_tomato.robot.arm_model import ArmModel
from maniskill_tomato.robot.d435 import T_flange_camera_color_optical
from maniskill_tomato.robot.iiwa14 import IIWA14
from maniskill_tomato.robot.look_at_move import look_rules
from maniskill_tomato.warp_runtime import BatchKernel


class CameraReach:
    """Asks the inverse kinematics for any joint angles, with any of `CAMERA_ROLLS`; not for several threads at once.

    Exact poses only. Collisions are not asked for, and a single move to such a position may still be refused, because
    the joints would turn too far for it.
    """

    def __init__(
        self,
        device: str | torch.device = "cpu",
        model: ArmModel = IIWA14,
        T_flange_camera: npt.NDArray[np.float64] = T_flange_camera_color_optical,
    ) -> None:
        """Prepares the inverse kinematics.

        Args:
            device: Where tensors live.
            model: Of the arm.
            T_flange_camera: The camera's optical frame in `link_ee`, such as a calibration found it. Shape (4, 4).
        """
        self.device = torch.device(device)
        rules = look_rules(self.device, T_flange_camera, model)
        vector = ((3,), torch.float64, wp.vec3d)
        self._kernels = {
            kept_clear: BatchKernel(
                look_at_kernels.reach_kernel,
                inputs=[vector, vector],
                constants=[rules, int(kept_clear)],
                outputs=[((), torch.int64, wp.int64)],
            )
            for kept_clear in (False, True)
        }

    def reachable(self, positions: Tensor, target: Tensor, kept_clear: bool = True) -> Tensor:
        """Which positions can be taken.

        Args:
            positions: Of the camera, in the robot's base frame, in [m]. Shape (..., 3).
            target: What it looks at from each, in a shape that broadcasts to that of `positions`, in [m].
            kept_clear: Whether the flange must keep off the floor and the base, as moves do (`look_at_move`).

        Returns:
            Shape (...), bool.

        Raises:
            InvalidInputError: A number is not finite.
        """
        rows = positions.reshape(-1, 3)
        if not len(rows):
            return torch.zeros(positions.shape[:-1], dtype=torch.bool, device=self.device)
        (reached,) = self._kernels[kept_clear](rows, target.expand_as(positions).reshape(-1, 3))
        if bool((reached < 0).any()):
            row = int(reached.argmin())
            raise InvalidInputError(f"camera positions and targets must be finite, got {rows[row].tolist()}")
        return (reached == 1).view(positions.shape[:-1])
