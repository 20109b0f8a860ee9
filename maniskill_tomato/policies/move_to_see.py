"""3D Move To See: follow the gradient of the target's size over a camera array.

Lehnert, Tsai, Eriksson and McCool, "3D Move to See: Multi-perspective visual servoing towards the next best view
within unstructured and occluded environments", IROS 2019, arXiv 1809.07896, and the authors' repository
`lehnert/move_to_see`, from which the numbers are.

Nine cameras in a 3x3 array see the target at once. The relative differences of its size in pixels to that of the
middle camera, each divided by the distance of the two cameras, are fitted by a gradient (least squares over the unit
vectors to the outer cameras), and the middle camera moves by step size times gradient. A camera that does not see the
target counts as no difference, and without any difference it stops.

Deviations:

- The outer cameras look at the target, as the control mode does; theirs are tilted inwards by 30 degrees. Their
  places are those of a sphere with that tilt, which puts them 19 mm before the middle one: without this third
  dimension no gradient along the optical axis could be fitted.
- The pixel size is V_f / d^2 up to a constant, for a target that is looked at from the distance d.
- Manipulability has no weight (theirs: 0 in the experiments on the robot, 0.2 in simulation).
- A move is at most `MAX_MOVE` long. They take 0.001 or 0.1 times the gradient in dozens of iterations; here it is
  0.1, so that nearly every move is a full one.
- The array sees the truth (`MoveToSee`): our robot has one camera, and an array of real cameras would see just that.
  `MoveToSeeOnMemory` predicts the nine views from what the one camera has seen so far.
"""

import math
from abc import abstractmethod

import torch
from torch import Tensor

from maniskill_tomato.policies.moves import shortened
from maniskill_tomato.policies.protocol import GroundTruth, Planner
from maniskill_tomato.robot.look_at import look_at_pose, look_frame
from maniskill_tomato.robot.look_at_move import MAX_MOVE
from maniskill_tomato.sensing.belief import Belief

ARRAY_RADIUS = 0.07
"""Distance of neighbouring cameras of the array, in [m]."""
ARRAY_TILT = math.radians(30.0)
"""By how much the outer cameras of a row or column are turned inwards, in [rad]."""
STEP_SIZE = 0.1
"""Metres moved for a gradient of 1 / m."""


def camera_array() -> Tensor:
    """The eight outer cameras relative to the middle one: right, up, forward, in [m]. Shape (8, 3)."""
    steps = torch.tensor([-1.0, 0.0, 1.0])
    sideways = torch.cartesian_prod(steps, steps)
    sideways = ARRAY_RADIUS * sideways[sideways.abs().sum(dim=1) > 0]
    sphere = ARRAY_RADIUS / math.sin(ARRAY_TILT)
    forward = sphere - (sphere**2 - sideways.square().sum(dim=1)).sqrt()
    return torch.cat([sideways, forward[:, None]], dim=1)


def size_gradient(middle: Tensor, outer: Tensor, offsets: Tensor) -> Tensor:
    """The gradient of the relative size, fitted to the array.

    Args:
        middle: Target size that the middle camera sees. Shape (B,).
        outer: What the outer ones see, in the same unit. Shape (B, C).
        offsets: Outer cameras relative to the middle one, in [m]. Shape (C, 3).

    Returns:
        In [1/m], in the frame of the offsets; zero where the middle camera sees nothing. Shape (B, 3).
    """
    both = (outer > 0) & (middle > 0)[:, None]
    relative = torch.where(both, outer / middle.clamp_min(1e-12)[:, None] - 1.0, torch.zeros_like(outer))
    length = offsets.norm(dim=1)
    # derivative_k = g . u_k along every unit vector u_k: g by the pseudo-inverse.
    gradient: Tensor = (relative / length) @ torch.linalg.pinv(offsets / length[:, None]).mT
    return gradient


class _ArrayPlanner(Planner):
    """Gradient steps on what nine cameras see, however that is known."""

    def __init__(self, device: str | torch.device = "cpu") -> None:
        self._offsets = camera_array().to(device)

    @abstractmethod
    def _visible_fraction(self, belief: Belief, positions: Tensor) -> Tensor:
        """V_f from positions of shape (B, 9, 3). Shape (B, 9)."""

    def gradient(self, belief: Belief) -> Tensor:
        """Gradient of the relative size in the look frame, in [1/m]. Shape (B, 3)."""
        position, target = belief.camera_position, belief.target_position
        shifts = self._offsets @ look_frame(position, target).mT
        positions = torch.cat([position[:, None], position[:, None] + shifts], dim=1)
        distance = (positions - target[:, None]).norm(dim=-1)
        size = self._visible_fraction(belief, positions) / distance.square()
        return size_gradient(size[:, 0], size[:, 1:], self._offsets)

    def act(self, belief: Belief) -> Tensor:
        """Along the gradient."""
        return shortened(STEP_SIZE / MAX_MOVE * self.gradient(belief))


class MoveToSee(_ArrayPlanner):
    """3D Move To See with an array that sees the truth."""

    name = "3dmts"
    needs_truth = True

    def __init__(self, ground_truth: GroundTruth, device: str | torch.device = "cpu") -> None:
        super().__init__(device)
        self._truth = ground_truth

    def _visible_fraction(self, belief: Belief, positions: Tensor) -> Tensor:
        rows = [
            self._truth.visible_fraction(look_at_pose(row, belief.target_position[i]), i)
            for i, row in enumerate(positions)
        ]
        return torch.stack(rows)


class MoveToSeeOnMemory(_ArrayPlanner):
    """3D Move To See with an array that is predicted from the occlusion memory."""

    name = "3dmts_memory"

    def _visible_fraction(self, belief: Belief, positions: Tensor) -> Tensor:
        predicted: Tensor = belief.memory.predict(positions)
        return predicted[..., 0]
