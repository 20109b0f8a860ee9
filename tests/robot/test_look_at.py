"""The camera that looks at a target: axes worked out by hand, poses through the flange and back."""

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.robot.d435 import T_flange_camera_color_optical
from maniskill_tomato.robot.kinematics import forward_kinematics, viewpoint_transform
from maniskill_tomato.robot.look_at import (
    CAMERA_ROLLS,
    camera_to_flange,
    camera_to_viewpoint,
    flange_to_camera,
    look_at_pose,
    look_frame,
)


def _random_scene(count: int = 200) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(3)
    position = torch.rand(count, 3, generator=generator, dtype=torch.float64) - 0.5
    target = torch.rand(count, 3, generator=generator, dtype=torch.float64) + 0.5
    return position, target, (torch.rand(count, generator=generator, dtype=torch.float64) - 0.5) * 6.0


def test_a_camera_that_faces_x_has_its_right_at_minus_y_and_its_up_at_z() -> None:
    frame = look_frame(torch.tensor([[0.1, 0.2, 0.3]]), torch.tensor([[0.9, 0.2, 0.3]]))
    right, up, forward = frame[0].unbind(-1)
    assert_close(right, torch.tensor([0.0, -1.0, 0.0]))
    assert_close(up, torch.tensor([0.0, 0.0, 1.0]))
    assert_close(forward, torch.tensor([1.0, 0.0, 0.0]))


def test_the_look_frame_is_orthonormal_level_and_upright() -> None:
    position, target, _ = _random_scene()
    frame = look_frame(position, target)
    assert_close(frame.mT @ frame, torch.eye(3, dtype=torch.float64).expand_as(frame))
    assert_close(frame[:, 2, 0], torch.zeros(200, dtype=torch.float64))
    assert bool((frame[:, 2, 1] > 0).all())
    assert_close(frame[:, :, 2], (target - position) / (target - position).norm(dim=-1, keepdim=True))


@pytest.mark.parametrize("height", [-0.4, 0.4])
def test_a_camera_that_looks_straight_up_or_down_has_a_frame_too(height: float) -> None:
    frame = look_frame(torch.tensor([[0.5, 0.0, 1.0]]), torch.tensor([[0.5, 0.0, 1.0 + height]]))
    assert_close(frame[0].T @ frame[0], torch.eye(3))
    assert_close(frame[0, :, 0], torch.tensor([0.0, -1.0, 0.0]))
    assert_close(frame[0, :, 2], torch.tensor([0.0, 0.0, math.copysign(1.0, height)]))


def test_a_camera_at_its_target_gets_finite_axes() -> None:
    frame = look_frame(torch.zeros(1, 3), torch.zeros(1, 3))
    assert_close(frame[0].T @ frame[0], torch.eye(3))


def test_a_look_at_pose_is_rigid_and_sees_the_target_on_its_axis() -> None:
    position, target, roll = _random_scene()
    T_world_camera = look_at_pose(position, target, roll)
    R = T_world_camera[:, :3, :3]
    assert_close(R.mT @ R, torch.eye(3, dtype=torch.float64).expand_as(R))
    assert_close(torch.linalg.det(R), torch.ones(200, dtype=torch.float64))
    homogeneous = torch.cat([target, torch.ones(200, 1, dtype=torch.float64)], dim=-1)
    seen = (torch.linalg.inv(T_world_camera) @ homogeneous[..., None])[..., 0]
    assert_close(seen[:, :2], torch.zeros(200, 2, dtype=torch.float64))
    assert_close(seen[:, 2], (target - position).norm(dim=-1))


def test_roll_turns_the_camera_about_its_axis_from_right_towards_down() -> None:
    position, target, roll = _random_scene()
    upright, turned = look_at_pose(position, target), look_at_pose(position, target, roll)
    relative = upright[:, :3, :3].mT @ turned[:, :3, :3]
    for i in range(200):
        c, s = math.cos(roll[i]), math.sin(roll[i])
        by_hand = torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
        assert_close(relative[i], by_hand)


def test_upright_pictures_have_the_world_up_in_their_upper_half() -> None:
    position, target, _ = _random_scene()
    upright = look_at_pose(position, target)
    # Optical y points down.
    assert bool((upright[:, 2, 1] < 0).all())
    assert_close(upright[:, 2, 0], torch.zeros(200, dtype=torch.float64))


def test_camera_and_viewpoint_are_one_anothers_inverse() -> None:
    position, target, roll = _random_scene()
    T_world_camera = look_at_pose(position, target, roll)
    viewpoint = camera_to_viewpoint(T_world_camera, torch.zeros(200, 3, dtype=torch.float64))
    flange = viewpoint_transform(viewpoint)
    assert_close(flange_to_camera(flange), T_world_camera, atol=1e-9, rtol=0)
    assert_close(flange, camera_to_flange(T_world_camera), atol=1e-9, rtol=0)
    assert_close(flange_to_camera(flange), flange @ torch.from_numpy(np.array(T_flange_camera_color_optical)))


def test_the_rolls_cover_the_circle_evenly_and_begin_upright() -> None:
    assert CAMERA_ROLLS[0] == 0.0
    steps = np.diff(np.sort(np.mod(CAMERA_ROLLS, 2 * math.pi)))
    np.testing.assert_allclose(steps, math.radians(30.0))
    assert np.all(np.diff(np.abs(CAMERA_ROLLS)) >= 0)


@pytest.mark.parametrize("position", [torch.zeros(2, 4), torch.zeros(2, 3, dtype=torch.int64)])
def test_positions_that_are_none_are_refused(position: torch.Tensor) -> None:
    with pytest.raises(InvalidInputError, match=r"position must be a floating-point tensor of shape"):
        look_frame(position, torch.zeros(2, 3))


@pytest.mark.parametrize("move", [flange_to_camera, camera_to_flange])
def test_mounted_cameras_stand_in_a_batch_exactly_where_they_stand_alone(
    move: Callable[[torch.Tensor], torch.Tensor],
) -> None:
    qpos = torch.rand(120, 3, 7, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 2.0 - 1.0
    for some in qpos:
        alone = torch.cat([move(forward_kinematics(row[None])) for row in some])
        assert torch.equal(move(forward_kinematics(some)), alone)
