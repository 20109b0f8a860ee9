"""Gradient-based next-best view: climb the expected visible share of the target in the occlusion map.

Burusa, van Henten and Kootstra, "Gradient-based Local Next-best-view Planning for Improved Perception of Targeted
Plant Nodes", ICRA 2024, arXiv 2311.16759, and the authors' repository `akshaykburusa/gradientnbv`.

Rays from the camera through the target region are sampled in a voxel map by trilinear interpolation, so that the gain
of a view is differentiable in the camera's position; AdamW (learning rate 0.03) climbs its logarithm, the camera looks
at the target and stays within a box around its start.

Deviations:

- The gain is the transmittance to the target's disc, that is the expected V_f, in place of transmittance times the
  entropy of semantic labels: the task asks to see the target, not to reconstruct it. Rays begin at the target, which
  is the same way walked in the other direction.
- Transmittance is exp(-sum of densities) on the densities of `OcclusionMemory` (voxels of 2 cm), not a product over a
  steep sigmoid of occupancies (voxels of 3 mm), which has no gradient at all but on the borders of voxels.
- `STEPS` optimiser steps make one move, theirs is one; a move may be 0.12 m long here. No weight decay, which would
  pull the camera to the origin.
- The box is the reachable workspace: of the moves along the gradient the longest that the arm can take is chosen.
- Where the gradient says nothing, it stays, as theirs does.
"""

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from maniskill_tomato.policies.moves import move_towards
from maniskill_tomato.policies.protocol import Planner
from maniskill_tomato.robot.camera_reach import CameraReach
from maniskill_tomato.robot.look_at import look_frame
from maniskill_tomato.robot.look_at_move import MAX_MOVE, MIN_DISTANCE
from maniskill_tomato.sensing.belief import Belief
from maniskill_tomato.sensing.occlusion_memory import CELL_SIZE, GRID_CELLS, TARGET_RADIUS

LEARNING_RATE = 0.03
"""Of Adam, in [m] a step."""
BETAS = (0.9, 0.999)
STEPS = 4
"""Optimiser steps before each move."""
SAMPLES = 56
"""Points on each ray, a centimetre apart: the grid's half diagonal is 0.55 m."""
SPACING = 0.01

SHORTENED = (1.0, 0.75, 0.5, 0.25)
"""Shares of a move that are tried where the arm cannot take the whole."""


def expected_visible_share(density: Tensor, position: Tensor, target: Tensor) -> Tensor:
    """Expected visible share of the target's disc, differentiable in the camera's position.

    Args:
        density: Expected hits per metre in the voxels around the target. Shape (B, 32, 32, 32).
        position: Of the camera, in the world frame, in [m]. Shape (B, 3).
        target: Centre of the target and of the map. Shape (B, 3).

    Returns:
        Shape (B,).
    """
    b = len(position)
    start = target[:, None] + _disc(position, target)
    ahead = position[:, None] - start
    length = ahead.norm(dim=-1, keepdim=True)
    along = (torch.arange(SAMPLES, device=position.device, dtype=position.dtype) + 0.5) * SPACING
    points = start[:, :, None] + ahead[:, :, None] / length[:, :, None] * along[:, None]
    # What lies behind the camera does not count; the share of a sample fades so that the gradient exists.
    before_camera = ((length - along) / SPACING + 0.5).clamp(0.0, 1.0)
    half = 0.5 * GRID_CELLS * CELL_SIZE
    scaled = ((points - target[:, None, None]) / half).flip(-1)
    # Voxel [x, y, z] is volume [D, H, W], and grid_sample takes coordinates as (W, H, D).
    samples = grid_sample(
        density[:, None], scaled[:, :, :, None], mode="bilinear", padding_mode="zeros", align_corners=False
    ).view(b, -1, SAMPLES)
    depth = (samples * before_camera).sum(dim=-1) * SPACING
    return torch.exp(-depth).mean(dim=-1)


class GradientView(Planner):
    """Climbs the expected visible share."""

    name = "gradient_nbv"

    def __init__(
        self,
        device: str | torch.device = "cpu",
        reachable: Callable[[Tensor, Tensor], Tensor] | None = None,
    ) -> None:
        self._reachable = reachable or CameraReach(device).reachable
        self._mean = torch.zeros(0, 3)
        self._square = torch.zeros(0, 3)
        self._count = torch.zeros(0, 1)

    def begin(self, belief: Belief, rows: Tensor) -> None:
        position = belief.camera_position
        if len(self._mean) != len(position):
            self._mean, self._square = torch.zeros_like(position), torch.zeros_like(position)
            self._count = torch.zeros_like(position[:, :1])
        for state in (self._mean, self._square, self._count):
            state[rows] = 0.0

    def act(self, belief: Belief) -> Tensor:
        """Up the gradient, as far as the arm reaches."""
        position, target = belief.camera_position, belief.target_position
        density = belief.memory.density
        climbed = position
        for _ in range(STEPS):
            climbed = climbed + self._step(density, climbed, target)
        shift = climbed - position
        shift = shift * (MAX_MOVE / shift.norm(dim=-1, keepdim=True).clamp_min(MAX_MOVE))
        return move_towards(position, target, position + self._allowed(position, target, shift))

    def _step(self, density: Tensor, position: Tensor, target: Tensor) -> Tensor:
        """One step of Adam (Kingma and Ba 2015, Algorithm 1) on -log of the gain."""
        with torch.enable_grad():
            place = position.detach().requires_grad_()
            gain = torch.log(expected_visible_share(density, place, target) + 1e-7)
            (gradient,) = torch.autograd.grad(gain.sum(), place)
        self._count = self._count + 1.0
        self._mean = BETAS[0] * self._mean + (1.0 - BETAS[0]) * gradient
        self._square = BETAS[1] * self._square + (1.0 - BETAS[1]) * gradient.square()
        mean = self._mean / (1.0 - BETAS[0] ** self._count)
        square = self._square / (1.0 - BETAS[1] ** self._count)
        return LEARNING_RATE * mean / (square.sqrt() + 1e-8)

    def _allowed(self, position: Tensor, target: Tensor, shift: Tensor) -> Tensor:
        """The longest part of each shift that ends at a reachable place."""
        shares = torch.tensor(SHORTENED, dtype=position.dtype, device=position.device)
        places = position[:, None] + shares[:, None] * shift[:, None]
        allowed = torch.zeros_like(shift)
        for i in range(len(places)):
            good = self._reachable(places[i], target[i]) & (
                (places[i] - target[i]).norm(dim=1) >= MIN_DISTANCE
            )
            if bool(good.any()):
                allowed[i] = shares[int(good.int().argmax())] * shift[i]
        return allowed


def _disc(position: Tensor, target: Tensor) -> Tensor:
    """Points on the target's side towards the camera, relative to its centre, in the world frame. Shape (B, 9, 3)."""
    index = torch.arange(9, device=position.device, dtype=position.dtype)
    radius = TARGET_RADIUS * torch.sqrt((index + 0.5) / 9)
    angle = 2.39996323 * index
    bulge = torch.sqrt(TARGET_RADIUS**2 - radius.square())
    in_frame = torch.stack([radius * torch.cos(angle), radius * torch.sin(angle), -bulge], dim=-1)
    return in_frame @ look_frame(position, target).mT
