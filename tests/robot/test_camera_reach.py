"""Where the arm can look from, against the inverse kinematics asked roll by roll."""

import dataclasses
import math

import pytest
import torch

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.robot.arm_model import ArmModel
from maniskill_tomato.robot.camera_reach import CameraReach
from maniskill_tomato.robot.iiwa14 import IIWA14
from maniskill_tomato.robot.inverse_kinematics import InverseKinematics, Reach
from maniskill_tomato.robot.look_at import CAMERA_ROLLS, camera_to_flange, look_at_pose
from maniskill_tomato.robot.look_at_move import keeps_clear

NARROW = dataclasses.replace(
    IIWA14,
    joint_lower=0.8 * IIWA14.joint_lower,
    joint_upper=0.8 * IIWA14.joint_upper,
    ready_qpos=0.8 * IIWA14.ready_qpos,
)
"""An arm whose joints turn less far, so that many poses leave little of the arm angle."""


def looks(count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Targets among a plant's fruits, and positions within and around the arm's reach, shape (count, 3) each."""
    generator = torch.Generator().manual_seed(5)
    targets = torch.rand(count, 3, generator=generator, dtype=torch.float64)
    targets = targets * torch.tensor([0.6, 1.0, 1.1]) + torch.tensor([0.4, -0.5, 0.1])
    away = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    lengths = 0.2 + 0.7 * torch.rand(count, 1, generator=generator, dtype=torch.float64)
    return targets + lengths * away / away.norm(dim=-1, keepdim=True), targets


@pytest.mark.parametrize("model", [IIWA14, NARROW], ids=["iiwa 14", "narrow"])
@pytest.mark.parametrize("kept_clear", [False, True])
def test_reach_is_what_the_inverse_kinematics_says_roll_by_roll(model: ArmModel, kept_clear: bool) -> None:
    positions, targets = looks(3000)
    solver = InverseKinematics(model=model)
    expected = torch.zeros(len(positions), dtype=torch.bool)
    for roll in CAMERA_ROLLS:
        poses = camera_to_flange(look_at_pose(positions, targets, roll))
        solution = solver.solve(poses, torch.zeros(len(poses), 7, dtype=torch.float64), neighbour=False)
        allowed = keeps_clear(poses) if kept_clear else torch.ones_like(expected)
        expected |= (solution.reach == Reach.REACHABLE) & allowed
    assert 0.02 < float(expected.float().mean()) < 0.8
    assert torch.equal(CameraReach(model=model).reachable(positions, targets, kept_clear), expected)


def test_one_target_goes_with_many_positions_in_any_shape() -> None:
    positions, targets = looks(24)
    reach = CameraReach()
    alone = torch.stack([reach.reachable(position, targets[0]) for position in positions])
    assert torch.equal(reach.reachable(positions.view(2, 3, 4, 3), targets[0]), alone.view(2, 3, 4))
    assert reach.reachable(positions[:0], targets[0]).shape == (0,)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_what_is_not_finite_is_refused(value: float) -> None:
    with pytest.raises(InvalidInputError, match="finite"):
        CameraReach().reachable(torch.tensor([[0.5, 0.0, value]]), torch.tensor([0.8, 0.0, 0.5]))
