"""Forward kinematics of the iiwa 14 against plain loops over its Denavit-Hartenberg and joint tables."""

import math

import numpy as np
import numpy.typing as npt
import pytest
import torch
from torch.testing import assert_close

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.robot import iiwa14
from maniskill_tomato.robot.kinematics import forward_kinematics, link_transforms, viewpoint_transform

Array = npt.NDArray[np.float64]


def random_qpos(count: int, seed: int) -> Array:
    return np.random.default_rng(seed).uniform(iiwa14.JOINT_LOWER, iiwa14.JOINT_UPPER, (count, 7))


def transform(rotation: Array, translation: npt.ArrayLike) -> Array:
    result = np.eye(4)
    result[:3, :3] = rotation
    result[:3, 3] = translation
    return result


def rotation_about(axis: Array, angle: float) -> Array:
    """Rodrigues' formula."""
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.asarray(np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross)


def flange_by_modified_dh(q: Array) -> Array:
    # (a, alpha in degrees, d in metres), typed from the data of the KUKA Sunrise Toolbox, not from the package.
    table = [
        (0, 0, 0.36),
        (0, -90, 0),
        (0, 90, 0.42),
        (0, 90, 0),
        (0, -90, 0.40),
        (0, -90, 0),
        (0, 90, 0.126),
    ]
    pose = np.eye(4)
    for (a, alpha_deg, d), theta in zip(table, q, strict=True):
        alpha = math.radians(alpha_deg)
        pose = pose @ transform(rotation_about(np.array([1.0, 0, 0]), alpha), (a, 0, 0))
        pose = pose @ transform(rotation_about(np.array([0, 0, 1.0]), theta), (0, 0, d))
    return pose


def test_the_flange_agrees_with_the_modified_dh_chain() -> None:
    qpos = random_qpos(1000, seed=0)
    poses = forward_kinematics(torch.from_numpy(qpos)).numpy()
    for q, pose in zip(qpos, poses, strict=True):
        assert_close(pose, flange_by_modified_dh(q), rtol=0, atol=1e-12)


def test_every_link_agrees_with_a_loop_over_the_joint_table() -> None:
    qpos = random_qpos(100, seed=1)
    transforms = link_transforms(torch.from_numpy(qpos)).numpy()
    assert transforms.shape == (100, 9, 4, 4)
    for q, links in zip(qpos, transforms, strict=True):
        pose = np.eye(4)
        assert_close(links[0], pose, rtol=0, atol=0)
        for j in range(7):
            rotation = rotation_about(iiwa14.JOINT_AXES[j], q[j])
            pose = pose @ transform(rotation, iiwa14.JOINT_ORIGINS[j])
            assert_close(links[j + 1], pose, rtol=0, atol=1e-12)
        assert_close(links[8], pose @ transform(np.eye(3), iiwa14.EE_ORIGIN), rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("degrees", "position"),
    [
        ((0, 0, 0, 0, 0, 0, 0), (0.0, 0.0, 1.306)),
        ((0, 20, 0, -70, 0, 90, 0), (0.5436, 0.0, 0.6287)),
        ((0, 45, 0, -90, 0, 0, 0), (0.6689, 0.0, 0.2850)),
        ((90, 90, 0, 0, 0, 0, 0), (0.0, 0.946, 0.36)),
    ],
)
def test_the_flange_is_where_other_models_of_the_arm_have_it(
    degrees: tuple[float, ...], position: tuple[float, ...]
) -> None:
    pose = forward_kinematics(torch.tensor(np.deg2rad(degrees)))
    assert_close(pose[:3, 3], torch.tensor(position, dtype=torch.float64), rtol=0, atol=6e-5)


def test_at_home_the_flange_frame_is_the_base_frame_lifted() -> None:
    pose = forward_kinematics(torch.from_numpy(iiwa14.HOME_QPOS.copy()))
    expected = torch.eye(4, dtype=torch.float64)
    expected[2, 3] = 1.306
    assert_close(pose, expected, rtol=0, atol=1e-14)


def test_the_segments_add_up_to_the_joint_table() -> None:
    heights = iiwa14.JOINT_ORIGINS[:, 2]
    assert heights[:2].sum() == pytest.approx(iiwa14.BASE_TO_SHOULDER, abs=1e-12)
    assert heights[2:4].sum() == pytest.approx(iiwa14.SHOULDER_TO_ELBOW, abs=1e-12)
    assert heights[4:6].sum() == pytest.approx(iiwa14.ELBOW_TO_WRIST, abs=1e-12)
    assert heights[6] + iiwa14.EE_ORIGIN[2] == pytest.approx(iiwa14.WRIST_TO_EE, abs=1e-12)
    assert iiwa14.MODIFIED_DH[:, 2].sum() == pytest.approx(1.306, abs=1e-12)


def test_constants_cannot_be_overwritten() -> None:
    with pytest.raises(ValueError, match="read-only"):
        iiwa14.JOINT_UPPER[0] = 0.0


@pytest.mark.parametrize("shape", [(), (1,), (5,), (2, 3), (2, 0)])
def test_leading_dimensions_are_kept(shape: tuple[int, ...]) -> None:
    assert forward_kinematics(torch.zeros(*shape, 7)).shape == (*shape, 4, 4)


def test_single_precision_comes_back_and_is_computed_in_double() -> None:
    qpos = torch.from_numpy(random_qpos(200, seed=2)).float()
    poses = forward_kinematics(qpos)
    assert poses.dtype == torch.float32
    assert_close(poses, forward_kinematics(qpos.double()).float(), rtol=0, atol=0)


def test_a_batch_too_large_to_keep_buffers_for_gives_the_same() -> None:
    qpos = torch.from_numpy(random_qpos(5000, seed=3))
    # Vector units may round the last bit of a sine otherwise in a batch of another size.
    assert_close(link_transforms(qpos)[:10], link_transforms(qpos[:10]), rtol=0, atol=1e-12)


@pytest.mark.parametrize("count", [1, 3, 5000])
def test_results_are_not_overwritten_by_a_later_call_with_a_batch_of_the_same_size(count: int) -> None:
    for function, size in ((link_transforms, 7), (viewpoint_transform, 6)):
        first = function(torch.zeros(count, size, dtype=torch.float64))
        before = first.clone()
        function(torch.ones(count, size, dtype=torch.float64))
        assert_close(first, before, rtol=0, atol=0)


def test_an_empty_batch_has_no_poses() -> None:
    assert link_transforms(torch.zeros(0, 7)).shape == (0, 9, 4, 4)
    poses = viewpoint_transform(torch.zeros(0, 6))
    assert poses.shape == (0, 4, 4) and poses.dtype == torch.float64


@pytest.mark.parametrize(
    "bad", [torch.zeros(6), torch.zeros(2, 6), torch.zeros(2, 8), torch.zeros(7, dtype=torch.int64)]
)
def test_wrong_shapes_and_integers_are_refused(bad: torch.Tensor) -> None:
    with pytest.raises(InvalidInputError, match="qpos must be"):
        forward_kinematics(bad)
    with pytest.raises(InvalidInputError, match="qpos must be"):
        link_transforms(bad)


def test_a_single_number_and_a_further_dimension_are_refused_in_words() -> None:
    with pytest.raises(InvalidInputError, match="qpos must be"):
        forward_kinematics(torch.tensor(0.0))
    with pytest.raises(InvalidInputError, match="qpos must be"):
        link_transforms(torch.zeros(2, 7, 1))


@pytest.mark.gpu
def test_cuda_gives_the_same_as_the_cpu() -> None:
    qpos = torch.from_numpy(random_qpos(500, seed=4))
    assert_close(link_transforms(qpos.cuda()).cpu(), link_transforms(qpos), rtol=0, atol=1e-12)


def test_viewpoint_transform_turns_about_the_fixed_axes_one_after_the_other() -> None:
    rng = np.random.default_rng(5)
    viewpoints = rng.uniform(-3.0, 3.0, (200, 6))
    poses = viewpoint_transform(torch.as_tensor(viewpoints)).numpy()
    for (x, y, z, roll, pitch, yaw), pose in zip(viewpoints, poses, strict=True):
        turned = (
            rotation_about(np.array([0.0, 0.0, 1.0]), yaw)
            @ rotation_about(np.array([0.0, 1.0, 0.0]), pitch)
            @ rotation_about(np.array([1.0, 0.0, 0.0]), roll)
        )
        np.testing.assert_allclose(pose, transform(turned, [x, y, z]), atol=1e-14)


def test_viewpoint_transform_at_pitch_pi_over_2_looks_along_x() -> None:
    pose = viewpoint_transform(torch.tensor([[0.1, 0.2, 0.3, 0.0, math.pi / 2, 0.0]]))[0]
    assert pose.dtype == torch.float64
    assert_close(pose[:3, 2], torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64), atol=1e-7, rtol=0)


@pytest.mark.parametrize(
    "viewpoint",
    [
        torch.zeros(6),
        torch.zeros(2, 5),
        torch.zeros(2, 7),
        torch.zeros(2, 6, 1),
        torch.zeros(2, 6, dtype=torch.int64),
    ],
)
def test_viewpoint_transform_refuses_other_shapes_and_types(viewpoint: torch.Tensor) -> None:
    with pytest.raises(InvalidInputError, match=r"\(B, 6\)"):
        viewpoint_transform(viewpoint)
